"""A small avatar without a fit: the built-in hand in grey, one frame, made in a moment."""

from __future__ import annotations

import torch

from mass_engine.avatar import Avatar, SourceFrames
from mass_engine.camera import Camera
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, Shape
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light


def small_avatar() -> Avatar:
    """A right hand, fingers up, back to the camera, 0.4 m away; frame 0 is the flat hand."""
    model = load_builtin("right")
    binding = MeshBinding.build(model, 0, 1)
    count = binding.count
    appearance = Appearance(
        torch.full((count, 3), 0.6), torch.full((count,), 4.0), torch.zeros(count, 0, 3), white_light()
    )
    pose = HandPose(
        torch.zeros(1, 10),
        torch.tensor([[1.2092, -1.2092, -1.2092]]),
        torch.zeros(1, 45),
        torch.tensor([[0.0, 0.08, 0.4]]),
        "right",
    )
    frames = SourceFrames(torch.tensor([0]), torch.tensor([False]), pose, torch.ones(1, 3))
    camera = Camera.from_fov(160, 120, 50.0)
    skin = Skin.attached(binding)
    return Avatar(Shape.mean(model, torch.zeros(10)), skin, appearance, camera, frames, 0)
