"""``mass-engine bench render``: pose to pixels, milliseconds a picture on this machine."""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.deform.network import Deformation, DeformationConfig, UnitCube
from mass_engine.deform.posing import CompiledSurfels, MeshPose, PosableSurfels, ShadedSurfels
from mass_engine.evaluation.raster_scene import framing_camera
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import named_pose
from mass_engine.raster import RasterOptions, RenderOutput, rasterize
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.threads import one_thread

SIZES = ((256, 256), (512, 334), (512, 512), (1400, 1000))


@dataclass(frozen=True)
class Model:
    """``detached`` copies of attached surfels come on top; ``deformed``: none, detached or all of them."""

    levels: int
    depth: int
    detached: int
    deformed: str


MODELS = (
    Model(1, 0, 0, "none"),
    Model(1, 1, 0, "none"),
    Model(1, 1, 8064, "detached"),
    Model(2, 1, 0, "none"),
    # The paper's full model has 196,864 surfels.
    Model(2, 1, 32256, "none"),
    Model(2, 1, 32256, "detached"),
    Model(2, 1, 32256, "all"),
)


def run(argv: Sequence[str]) -> None:
    """Print a Markdown table of medians: posing, deforming and rasterising the built-in hand."""
    parser = argparse.ArgumentParser(prog="mass-engine bench render")
    parser.add_argument("--repeat", type=int, default=20)
    repeat: int = parser.parse_args(argv).repeat
    model = load_builtin("right")
    point = named_pose("point", "right")
    # Fingers up, back of the hand to the camera, filling the picture's height.
    orient = torch.tensor([-1.2092, -1.2092, 1.2092])
    pose = HandPose(point.betas, orient, point.hand_pose, torch.zeros(3), "right")
    vertices = model.posed(pose).vertices
    print(f"{platform.machine()}, {os.cpu_count()} cores, median of {repeat} (least to greatest), ms\n")
    print("| surfels | deformed | size | pose to surfels | pose to pixels | frames a second |")
    print("|---|---|---|---|---|---|")
    for case in MODELS:
        binding = MeshBinding.build(model, case.levels, case.depth)
        surfels = _surfels(model, binding, case)
        compiled = surfels.compiled()

        for width, height in SIZES:
            camera = framing_camera(vertices, width, height)

            def posed(
                binding: MeshBinding = binding, compiled: CompiledSurfels = compiled, camera: Camera = camera
            ) -> ShadedSurfels:
                with one_thread():
                    hand = model.posed(pose)
                    refined = binding.subdivision.apply(hand.vertices)
                bones, center = hand.bone_transforms[:, :3, :3], -camera.world_to_camera[:3, 3]
                return compiled.posed(MeshPose(refined, bones, center, pose.hand_pose, pose.betas))

            def drawn(posed: Callable[[], ShadedSurfels] = posed, camera: Camera = camera) -> RenderOutput:
                s = posed()
                options = RasterOptions(cull_backfaces=True)
                return rasterize(s.means, s.tangents, s.opacities, s.colors, camera, options=options)

            with torch.no_grad():
                first, _, _ = _times(posed, repeat)
                median, least, most = _times(drawn, repeat)
            print(
                f"| {len(surfels.sources)} | {case.deformed} | {width}x{height} | {first:.1f} "
                f"| {median:.1f} ({least:.1f} to {most:.1f}) | {1000 / median:.0f} |"
            )


def _surfels(model: HandModel, binding: MeshBinding, case: Model) -> PosableSurfels:
    """Attached surfels and, spread over them, detached ones; degree 1 harmonics; a random deformation."""
    copies = torch.linspace(0, binding.count - 1, case.detached).long()
    sources: Tensor = torch.cat([torch.arange(binding.count), copies])
    start = {"none": len(sources), "detached": binding.count, "all": 0}[case.deformed]
    deformation = None
    if start < len(sources):
        module = Deformation(
            DeformationConfig(),
            binding.surfels(model.template).means[sources[start:]],
            binding.surfel_faces[sources[start:]],
            len(model.faces),
            UnitCube.around(model.template),
            torch.Generator().manual_seed(0),
        )
        with torch.no_grad():
            # As if trained: tenths of a millimetre, a mask that changes.
            module.head.uniform_(-0.1, 0.1, generator=torch.Generator().manual_seed(1))
        deformation = module.freeze()
    count = len(sources)
    return PosableSurfels(
        binding,
        sources,
        torch.full((count, 3), 0.6),
        torch.full((count,), 0.95),
        torch.full((count, 3, 3), 0.01),
        white_light(),
        deformation,
        start if deformation is not None else 0,
    )


def _times(action: Callable[[], object], repeat: int) -> tuple[float, float, float]:
    action()
    spent = []
    for _ in range(repeat):
        start = time.perf_counter()
        action()
        spent.append((time.perf_counter() - start) * 1000)
    return statistics.median(spent), min(spent), max(spent)
