"""How good preprocessing is, against rendered clips with exact truth.

``python benchmarks/preprocessing_truth.py CLIP_DIR... [--noise 0 0.05 0.1 0.2]`` tracks, masks and aligns
CLIP_DIR/video.mp4 and prints, before and after silhouette refinement: 2-D landmark error, 3-D joint error
and surface distance after a similarity alignment per frame (one view fixes no scale), and the silhouette IoU
of the posed built-in hand; once: tracked frames and mask IoU. Where some tracked frames are not trusted, so
not fitted, all of it once more with them, aligned and refined like the others. With ``--noise`` also the 3-D
joint error when Gaussian noise of so many radians is added to every joint angle of the aligned poses, which
are then aligned and refined again.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from hand_truth import load_truth, rest_kept, wrist_place
from numpy.typing import NDArray

from mass_engine.avatar import row_pose
from mass_engine.camera import Camera
from mass_engine.evaluation.surfaces import similarity, surface_distance
from mass_engine.fitting.geometry import GeometryFit
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.schedule import schedule_for
from mass_engine.fitting.subject import Appearance, Shape, draw, pose_surfels
from mass_engine.fitting.views import View
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.options import FitOptions
from mass_engine.preprocess import Clip, prepare, prepare_hand
from mass_engine.progress import ProgressMeter
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.surfel.subdivision import loop_subdivision
from mass_engine.survey import survey
from mass_engine.tracking.alignment import align_landmarks
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.segmentation import HAND, IGNORE
from mass_engine.tracking.track import track_main_hand
from mass_engine.video.reader import read_frames

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TruthClip:
    """Truth of every frame: 21 points [T,21,3], vertices [T,V,3] in camera metres, faces, masks."""

    points: Array
    vertices: Array
    faces: NDArray[np.int64]
    pixels: Array
    masks: Path

    @staticmethod
    def load(folder: Path) -> TruthClip:
        with np.load(folder / "truth.npz") as data:
            pose, K = data["world_to_camera"].astype(np.float64), data["K"].astype(np.float64)
            count = len(data["vertices"])
        truth = load_truth(folder, count)

        def seen(world: torch.Tensor) -> Array:
            turned = world.double().numpy() @ pose[:, :3, :3].transpose(0, 2, 1)
            return np.asarray(turned + pose[:, None, :3, 3])

        points = seen(truth.points)
        pixels = points[..., :2] / points[..., 2:] @ K[:2, :2].T + K[:2, 2]
        return TruthClip(points, seen(truth.vertices), truth.faces.numpy(), pixels, folder / "masks")

    def mask(self, index: int) -> NDArray[np.uint8]:
        """0 background, 80 hand, 160 worn, 240 held."""
        mask = cv2.imread(str(self.masks / f"{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        return np.asarray(mask, np.uint8)


@dataclass(frozen=True)
class Errors:
    """Means over frames: of hand size, millimetres, millimetres, ratio."""

    landmarks: float
    joints: float
    surface: float
    silhouette: float

    def __str__(self) -> str:
        return (
            f"landmarks {self.landmarks:.1%}, joints {self.joints:.1f} mm, surface {self.surface:.1f} mm, "
            f"silhouette IoU {self.silhouette:.3f}"
        )


def joint_error(model: HandModel, shape: Shape, pose: HandPose, clip: Clip, truth: TruthClip) -> float:
    """Mean 3-D error of the 21 points after a similarity alignment per frame, millimetres."""
    with torch.no_grad():
        joints = model.joints(replace(pose, betas=shape.betas.expand_as(pose.betas))).double().numpy()
    found = []
    for view, mine in zip(clip.views, joints, strict=True):
        s, R, t = similarity(mine, truth.points[view.index])
        found.append(np.linalg.norm(s * mine @ R.T + t - truth.points[view.index], axis=-1).mean())
    return float(np.mean(found)) * 1e3


def measure(shape: Shape, pose: HandPose, clip: Clip, truth: TruthClip) -> Errors:
    """Everything about posed hands in every frame."""
    model = clip.model
    fine = loop_subdivision(model.faces, len(model.template), 1)
    pose = replace(pose, betas=shape.betas.expand_as(pose.betas))
    binding = MeshBinding.build(model, 1, 1)
    with torch.no_grad():
        posed = model.posed(pose, shape.displacement)
        refined = fine.apply(posed.vertices).double().numpy()
        joints = posed.joints
        projected = clip.camera.project(joints).numpy()
    kept, faces = rest_kept(model, fine), fine.faces.numpy()
    landmarks, surface, silhouettes = [], [], []
    for row, view in enumerate(clip.views):
        true_points, true_pixels = truth.points[view.index], truth.pixels[view.index]
        size = float(np.ptp(true_pixels, axis=0).max())
        landmarks.append(np.linalg.norm(projected[row] - true_pixels, axis=-1).mean() / size)
        s, R, t = similarity(joints[row].double().numpy(), true_points)
        # The truth in our frame; distances are scaled back.
        theirs = ((truth.vertices[view.index] - t) @ R) / s
        one = row_pose(pose, row)
        place = wrist_place(model, one, torch.from_numpy(theirs)[None].float())[0].numpy()
        forth = surface_distance(theirs[place < 0], refined[row], faces)
        back = surface_distance(refined[row][kept], theirs, truth.faces)
        surface.append(s * float(np.concatenate([forth, back]).mean()))
        silhouettes.append(_silhouette_iou(shape, binding, one, view, truth, clip.camera))
    return Errors(
        float(np.mean(landmarks)),
        joint_error(model, shape, pose, clip, truth),
        float(np.mean(surface)) * 1e3,
        float(np.mean(silhouettes)),
    )


def whole(view: View, camera: Camera) -> NDArray[np.uint8]:
    """The view's labels in the whole picture; around its crop nothing is known: ignored."""
    scale = float(view.camera.K[0, 0] / camera.K[0, 0])
    x, y = (round(float(camera.K[k, 2] - view.camera.K[k, 2] / scale)) for k in (0, 1))
    h, w = (round(n / scale) for n in view.labels.shape)
    labels = np.full((camera.height, camera.width), IGNORE, np.uint8)
    crop = cv2.resize(view.labels, (w, h), interpolation=cv2.INTER_NEAREST)
    labels[y : y + h, x : x + w] = crop[: camera.height - y, : camera.width - x]
    return labels


def _silhouette_iou(
    shape: Shape, binding: MeshBinding, pose: HandPose, view: View, truth: TruthClip, camera: Camera
) -> float:
    """Against the true mask; forearm and sleeve (ignored by ours, no hand in the truth) do not count."""
    with torch.no_grad():
        surfels = pose_surfels(shape, binding, pose).row(0)
        count = binding.count
        options = RasterOptions(cull_backfaces=True)
        out = draw(surfels, torch.full((count,), 0.99), torch.ones(count, 3), camera, options)
    drawn, true = out.alpha.numpy() > 0.5, truth.mask(view.index)
    hand = (true == 80) | (true == 160)
    counted = ~((whole(view, camera) == IGNORE) & ~hand) & (true != 240)
    return float((drawn & hand & counted).sum() / max(1, ((drawn | hand) & counted).sum()))


def mask_iou(clip: Clip, truth: TruthClip) -> float:
    """Mean IoU of the hand label with the true hand, where ours ignores nothing and nothing is worn."""
    found = []
    for view in clip.views:
        true, mine = truth.mask(view.index), whole(view, clip.camera)
        counted = (mine != IGNORE) & (true != 160)
        a, b = (mine == HAND) & counted, (true == 80) & counted
        found.append((a & b).sum() / max(1, (a | b).sum()))
    return float(np.mean(found))


def refine(clip: Clip, start: HandPose, seed: int = 0) -> tuple[Shape, HandPose]:
    """The silhouette passes of the fit's first stage."""
    table, shape = PoseTable(start), Shape.mean(clip.model, start.betas[0])
    fit = GeometryFit(clip.views, table, shape, clip.camera, seed, RasterOptions(cull_backfaces=True))
    for stage in schedule_for("auto").geometry:
        if stage.color:
            break
        binding = MeshBinding.build(clip.model, stage.levels, stage.depth)
        count = binding.count
        grey, logits = torch.full((count, 3), 0.5), torch.full((count,), 3.0)
        look = Appearance(grey, logits, torch.zeros(count, 0, 3), white_light())
        fit.run(stage, binding, look)
    return shape, table.pose(shape.betas)


def noisy(pose: HandPose, sigma: float, seed: int) -> HandPose:
    """Gaussian noise on every joint angle."""
    generator = torch.Generator().manual_seed(seed)

    def shaken(angles: torch.Tensor) -> torch.Tensor:
        return angles + sigma * torch.randn(angles.shape, generator=generator)

    return replace(pose, global_orient=shaken(pose.global_orient), hand_pose=shaken(pose.hand_pose))


def noise_test(folder: Path, clip: Clip, truth: TruthClip, sigmas: Sequence[float]) -> None:
    """Print the 3-D error of start, alignment and refinement for every strength of noise."""
    track = track_main_hand(read_frames(folder / "video.mp4"), HandNetworks.load(), lambda _: False)
    marks = [track.hands[view.index] for view in clip.views]
    times = [view.time for view in clip.views]
    mean = Shape.mean(clip.model, clip.start.betas[0])
    for sigma in sigmas:
        start = noisy(clip.start, sigma, 1)
        aligned = align_landmarks(clip.model, marks, times, clip.camera, start=start).pose
        shape, refined = refine(clip, aligned)
        steps = ((mean, start), (Shape.mean(clip.model, aligned.betas[0]), aligned), (shape, refined))
        errors = [joint_error(clip.model, s, pose, clip, truth) for s, pose in steps]
        print(f"  noise {sigma} rad: joints {errors[0]:.1f} -> {errors[1]:.2f} -> {errors[2]:.2f} mm")


def prepare_all(folder: Path) -> Clip:
    """Every tracked frame as if it were trusted."""
    options, meter = FitOptions(holdout=0), ProgressMeter(lambda *_: None)
    found = survey(folder / "video.mp4", options, meter, lambda *_: None)
    track = track_main_hand(read_frames(folder / "video.mp4"), HandNetworks.load(), lambda _: False)
    hand = found.hands[0]
    some = next(iter(hand.quality.values()))  # only chooses frames, and all are taken
    marks = list(track.hands.values())
    quality = {mark.index: hand.quality.get(mark.index, some) for mark in marks}
    options = replace(options, max_frames=len(marks))
    whole_hand = replace(hand, marks=marks, quality=quality, doubted=[])
    return prepare_hand(folder / "video.mp4", found, whole_hand, options, meter)


def report(clip: Clip, truth: TruthClip) -> None:
    """Print all errors, before and after refinement."""
    print(f"  mask IoU {mask_iou(clip, truth):.3f}")
    mean = Shape.mean(clip.model, clip.start.betas[0])
    print(f"  aligned: {measure(mean, clip.start, clip, truth)}")
    shape, pose = refine(clip, clip.start)
    print(f"  refined: {measure(shape, pose, clip, truth)}", flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--noise", type=float, nargs="*", default=[])
    arguments = parser.parse_args(argv)
    for folder in arguments.clips:
        truth = TruthClip.load(folder)
        started = time.perf_counter()
        meter = ProgressMeter(lambda *_: None)
        clip = prepare(folder / "video.mp4", FitOptions(holdout=0), meter, lambda *_: None)
        each = 1e3 * (time.perf_counter() - started) / clip.frames_read
        trusted = f"{clip.tracked - len(clip.doubted)} trusted"
        print(f"{folder.name}: {clip.tracked} of {clip.frames_read} frames tracked, {trusted}", end=", ")
        print(f"{each:.0f} ms a frame")
        report(clip, truth)
        if clip.doubted:
            print(f"  all {clip.tracked} tracked frames:")
            report(prepare_all(folder), truth)
        if arguments.noise:
            noise_test(folder, clip, truth, arguments.noise)
    return 0


if __name__ == "__main__":
    sys.exit(main())
