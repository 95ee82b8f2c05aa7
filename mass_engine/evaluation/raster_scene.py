"""The scene rasteriser benchmarks draw: the built-in hand in a pose, covered by two layers of surfels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import named_pose
from mass_engine.surfel.binding import MeshBinding


@dataclass(frozen=True)
class Scene:
    """The tensors ``rasterize`` takes, in its order."""

    means: Tensor
    tangents: Tensor
    opacities: Tensor
    colors: Tensor

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.means, self.tangents, self.opacities, self.colors

    def to(self, device: torch.device) -> Scene:
        """The same on ``device``."""
        return Scene(*(t.to(device) for t in self.tensors()))


def hand_scene(count: int, pose_name: str = "point", seed: int = 0) -> Scene:
    """``count`` surfels in two layers on the posed hand, back of the hand towards -z, fingers up.

    Each layer takes the surfels of an even choice of the refined mesh's faces, widened so that together they
    have the area of all. The second layer lies up to 0.5 mm off and is a little tilted, as detached surfels
    are.
    """
    generator = torch.Generator().manual_seed(seed)
    model = load_builtin("right")
    named = named_pose(pose_name, "right")
    # Fingers up, back of the hand to the camera.
    orient = torch.tensor([[1.2092, -1.2092, -1.2092]])
    pose = HandPose(named.betas[None], orient, named.hand_pose[None], torch.zeros(1, 3), "right")
    vertices = model.posed(pose).vertices[0]
    half = count // 2
    levels = next(level for level in range(4) if len(model.faces) * 4**level >= count - half)
    surfels = MeshBinding.build(model, levels, 0).surfels(vertices)
    parts = []
    for layer, size in enumerate((half, count - half)):
        every = len(surfels.means)
        chosen = torch.randperm(every, generator=generator)[:size].sort().values
        means, tangents, normals = (t[chosen] for t in (surfels.means, surfels.tangents, surfels.normals))
        tangents = tangents * (every / size) ** 0.5
        if layer == 1:
            means = means + 0.0005 * (torch.rand(size, 1, generator=generator) - 0.5) * normals
            slope = 0.3 * (torch.rand(size, 2, 1, generator=generator) - 0.5)
            tangents = tangents + slope * tangents.norm(dim=-1, keepdim=True) * normals[:, None]
        parts.append((means, tangents))
    means, tangents = (torch.cat(x) for x in zip(*parts, strict=True))
    colors = torch.tensor([0.8, 0.6, 0.5]) * (0.6 + 0.4 * torch.rand(count, 3, generator=generator))
    return Scene(means, tangents, 0.5 + 0.49 * torch.rand(count, generator=generator), colors)


def hand_camera(scene: Scene, width: int, height: int) -> Camera:
    """Half a metre in front of the hand, which fills nine tenths of the picture."""
    return framing_camera(scene.means, width, height)


def framing_camera(points: Tensor, width: int, height: int) -> Camera:
    """Half a metre in front of ``points`` [N,3], which fill nine tenths of the picture one way."""
    low, high = points.amin(0), points.amax(0)
    center, size = (low + high) / 2, high - low
    distance = 0.5
    focal = 0.9 * distance * min(width / float(size[0]), height / float(size[1]))
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.0, 0.0, distance]) - center
    return Camera(K, pose, width, height)
