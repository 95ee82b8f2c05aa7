"""``mass-engine bench render``: pose to pixels, milliseconds a picture on this machine.

On a GPU batches of poses are one graph, launched again and again; times are the device's own, between events,
and the floor is what must be moved at least, over what the memory moves in a copy on the same device.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.deform.network import Deformation, DeformationConfig, UnitCube
from mass_engine.deform.posing import CompiledSurfels, MeshPose, PosableSurfels, ShadedSurfels
from mass_engine.device import DEVICES, choose_device
from mass_engine.evaluation.device_timing import copy_bandwidth, device_times
from mass_engine.evaluation.raster_scene import framing_camera
from mass_engine.fitting.subject import Shape
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import named_pose
from mass_engine.many_poses import BATCH, ManyPoses
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
    parser.add_argument("--device", choices=DEVICES, default="cpu")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, BATCH], help="poses a launch, on a GPU")
    arguments = parser.parse_args(argv)
    repeat: int = arguments.repeat
    device = choose_device(arguments.device)
    if device.type == "cuda":
        _on_gpu(device, repeat, arguments.batch)
        return
    model, pose = load_builtin("right"), _pose()
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


def _pose() -> HandPose:
    """Fingers up, back of the hand to the camera."""
    point = named_pose("point", "right")
    orient = torch.tensor([-1.2092, -1.2092, 1.2092])
    return HandPose(point.betas, orient, point.hand_pose, torch.zeros(3), "right")


def _on_gpu(device: torch.device, repeat: int, batches: Sequence[int]) -> None:
    """The same table for a GPU, for several numbers of poses a launch."""
    model, pose = load_builtin("right"), _pose()
    shape = Shape.mean(model, torch.zeros(10))
    vertices = model.posed(pose).vertices
    copied = copy_bandwidth(device)
    print(f"{torch.cuda.get_device_name(device)}, {copied / 1e9:.0f} GB/s in a copy, median of {repeat}\n")
    print(
        "| surfels | deformed | size | batch | pose to pixels, ms | frames a second | floor, ms | peak, MiB |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for case in MODELS:
        surfels = _surfels(model, MeshBinding.build(model, case.levels, case.depth), case)
        for width, height in SIZES:
            camera = framing_camera(vertices, width, height)
            for batch in batches:
                torch.cuda.reset_peak_memory_stats(device)
                many = ManyPoses(shape, surfels, width, height, device, batch)
                poses = HandPose(
                    pose.betas.expand(batch, -1),
                    pose.global_orient.expand(batch, -1),
                    pose.hand_pose.expand(batch, -1),
                    pose.transl.expand(batch, -1),
                    pose.side,
                )
                cameras = [camera] * batch
                while many.lacked_room(many.draw(poses, cameras)):
                    pass
                spent, _, _ = device_times(partial(many.draw, poses, cameras), repeat)
                # Read every surfel's constants, write and read it posed, write the picture: not less.
                least = 4.0 * (len(surfels.sources) * (17 + 2 * 15) + width * height * 5)
                print(
                    f"| {len(surfels.sources)} | {case.deformed} | {width}x{height} | {batch} "
                    f"| {spent / batch:.3f} | {1000 * batch / spent:.0f} | {1000 * least / copied:.4f} "
                    f"| {torch.cuda.max_memory_allocated(device) / 2**20:.0f} |",
                    flush=True,
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
