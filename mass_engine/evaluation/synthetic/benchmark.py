"""``mass-engine eval synthetic``: clips of another hand, fitted from the video alone; exact truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.avatar import Avatar
from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError
from mass_engine.evaluation.datasets.outcome import save_fit
from mass_engine.evaluation.demo_clip import ClipOptions
from mass_engine.evaluation.heldout import REFINED, HeldoutScores, number, score_frames
from mass_engine.evaluation.lpips import LpipsSet
from mass_engine.evaluation.refine import RefineOptions
from mass_engine.evaluation.scores import mean_scores
from mass_engine.evaluation.surfaces import depth_error, normal_error, similarity, surface_distance
from mass_engine.evaluation.synthetic.scene import FOV, Scene, SceneOptions, TrueFrame
from mass_engine.fitting.views import View
from mass_engine.hand.pose import HandPose
from mass_engine.options import FitOptions
from mass_engine.pipeline import fit
from mass_engine.raster import RasterOptions
from mass_engine.video.writer import write_video

HOLDOUT = 8

#: What is in the clip of each case.
CASES: dict[str, dict[str, Any]] = {
    "plain": {},
    "moving-light": {"moving_light": True},
    "worn-and-held": {"ring": True, "held": True, "forearm": True},
    "blurred": {"blur": 4, "forearm": True},
    "all": {"moving_light": True, "ring": True, "held": True, "forearm": True, "blur": 2},
}

_PROTOCOL = (
    "Clips of a hand that the fitted model cannot become (other proportions, weights, bending; wrinkles and "
    "pores), rendered by a z-buffer with sensor noise and H.264, 640x480, 96 frames; no cast shadows.",
    "The whole way is scored: tracker, masks, fit. Only the field of view is given. Every eighth frame is "
    "held out and scored against the true picture inside the true mask; worn and held things and the forearm "
    "are ignored.",
    "One view fixes no scale: surfaces and joints after a similarity on the 21 points of each frame, depth "
    "after its median ratio.",
)
GEOMETRY = ("joints_mm", "surface_mm", "surface_95_mm", "depth_mm", "normal_degrees")


@dataclass(frozen=True)
class SyntheticOptions:
    """``cases`` of :data:`CASES` (none: all); ``quick``: 320x240, 32 frames, one case, the draft preset."""

    out: Path
    cases: tuple[str, ...] = ()
    preset: str = "auto"
    seed: int = 0
    quick: bool = False
    lpips: LpipsSet = field(default_factory=lambda: LpipsSet({}))
    refine: bool = True

    def __post_init__(self) -> None:
        for case in self.cases:
            if case not in CASES:
                raise BadArgumentError("eval.case", f"There is no case {case!r}.", f"Use {', '.join(CASES)}.")


@dataclass(frozen=True)
class CaseResult:
    """Scores of the pictures and of the geometry (one row a held-out frame) of one case."""

    case: str
    scores: HeldoutScores
    geometry: list[dict[str, Any]]
    seconds: float


def run(options: SyntheticOptions, tell: Callable[[str], None]) -> list[CaseResult]:
    """Render, fit, score; OUT/results.json and OUT/results.md. Raises what a fit raises."""
    cases = options.cases or (("all",) if options.quick else tuple(CASES))
    results = []
    for case in cases:
        tell(case)
        results.append(_case(case, options))
        write(results, options)
    return results


def scene_of(case: str, seed: int, quick: bool) -> Scene:
    """The scene of a case."""
    clip = ClipOptions(320, 240, 16, 2.0, seed) if quick else ClipOptions(640, 480, 30, 3.2, seed)
    return Scene.make(SceneOptions(clip, **CASES[case]))


def _case(case: str, options: SyntheticOptions) -> CaseResult:
    scene = scene_of(case, options.seed, options.quick)
    folder = options.out / case
    folder.mkdir(parents=True, exist_ok=True)
    settings = FitOptions(
        preset="draft" if options.quick else options.preset, holdout=HOLDOUT, seed=options.seed, fov=FOV
    )
    truth: dict[int, TrueFrame] = {}

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for index, frame in enumerate(scene.frames()):
            if settings.is_heldout(index):
                truth[index] = frame
            yield frame.rgb

    video = folder / "video.mp4"
    write_video(video, pictures(), scene.options.clip.fps, crf=16)
    outcome = fit(video, settings)
    save_fit(outcome, folder)
    held = [view for view in outcome.clip.views if view.heldout]
    views = [true_view(view, truth[view.index], outcome.avatar.camera) for view in held]
    poses = [outcome.avatar.frames.pose_of(view.index) for view in held]
    scores = score_frames(
        outcome.avatar,
        views,
        poses,
        options.lpips,
        RefineOptions() if options.refine else None,
        gains=[outcome.avatar.frames.gain_of(view.index) for view in held],
    )
    geometry = [
        {"index": view.index, **geometry_errors(outcome.avatar, pose, truth[view.index], scene)}
        for view, pose in zip(views, poses, strict=True)
    ]
    return CaseResult(case, scores, geometry, outcome.report.seconds.get("fit", 0.0))


def true_view(view: View, frame: TrueFrame, whole: Camera) -> View:
    """The crop of ``view`` with the true picture and the true mask. Crops are not reduced at this size."""
    x, y = (max(0, round(float(whole.K[k, 2] - view.camera.K[k, 2]))) for k in (0, 1))
    h, w = view.labels.shape
    window = slice(y, y + h), slice(x, x + w)
    return replace(
        view,
        rgb=np.ascontiguousarray(frame.rgb[window]),
        labels=frame.labels[window].copy(),
        coverage=frame.coverage[window].copy(),
        _levels={},
        _outline=None,
    )


def geometry_errors(avatar: Avatar, pose: HandPose, frame: TrueFrame, scene: Scene) -> dict[str, float]:
    """Distances in millimetres and degrees between the posed avatar and the truth of one frame."""
    model, binding = avatar.shape.model, avatar.skin.binding
    with torch.no_grad():
        hand = model.posed(pose, avatar.shape.displacement)
        mesh = binding.subdivision.apply(hand.vertices)[0].double().numpy()
        joints = hand.joints[0].double().numpy()
        places = avatar.posed(pose).row(0).means.double().numpy()
        ahead = (binding.surfels(model.template).means[avatar.skin.sources, 0] < 0).numpy()
        true_ahead = (scene.hand.fine.apply(scene.hand.model.template)[:, 0] < 0).numpy()
    s, R, t = similarity(joints, frame.points)
    mesh, places, joints = (s * part @ R.T + t for part in (mesh, places[ahead], joints))
    forth = surface_distance(frame.vertices[true_ahead][::7], mesh, binding.subdivision.faces.numpy())
    back = surface_distance(places[::5], frame.vertices, scene.hand.fine.faces.numpy())
    both = 1000 * np.concatenate([forth, back])
    out = avatar.render_pose(pose, avatar.camera, RasterOptions(cull_backfaces=True, outputs="all"))
    depth, normals = torch.from_numpy(frame.depth), torch.from_numpy(frame.normals)
    mask = (out.alpha > 0.5) & (depth > 0)
    ratio = float((depth[mask] / out.depth[mask]).median()) if bool(mask.any()) else 1.0
    return {
        "joints_mm": 1000 * float(np.linalg.norm(joints - frame.points, axis=-1).mean()),
        "surface_mm": float(both.mean()),
        "surface_95_mm": float(np.percentile(both, 95)),
        "depth_mm": 1000 * depth_error(out.depth.double() * ratio, depth, mask),
        "normal_degrees": normal_error(out.normal, normals, mask),
    }


def markdown(results: Sequence[CaseResult], options: SyntheticOptions) -> str:
    """One row a case and kind of figure."""
    names = [*(f"{name}_hand_on_black" for name in ("psnr", "ms_ssim", "flip"))]
    names = ["psnr_in_mask", *names, "silhouette_iou", "boundary_f_2px"]
    lines = ["# Synthetic clips with exact truth", "", *[f"- {sentence}" for sentence in _PROTOCOL]]
    if options.quick:
        lines.append("- Quick run: 320x240, 32 frames, draft preset; not a figure to report.")
    lines += ["", "| case | poses | " + " | ".join((*names, *GEOMETRY)) + " |"]
    lines.append("|---|---|" + "---|" * (len(names) + len(GEOMETRY)))
    for result in results:
        for label, rows in (("held out", result.scores.as_fitted), (REFINED, result.scores.refined)):
            if rows:
                means = mean_scores(rows)
                shapes = mean_scores(result.geometry) if label == "held out" else {}
                cells = [number(means.get(name)) for name in names]
                cells += [number(shapes[name], 2) if name in shapes else "" for name in GEOMETRY]
                lines.append(f"| {result.case} | {label.replace('_', ' ')} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def write(results: Sequence[CaseResult], options: SyntheticOptions) -> None:
    """OUT/results.json and OUT/results.md."""
    data = {
        "protocol": list(_PROTOCOL),
        "quick": options.quick,
        "preset": "draft" if options.quick else options.preset,
        "seed": options.seed,
        "cases": [
            {
                "case": result.case,
                "fit_seconds": result.seconds,
                **result.scores.summary(),
                "geometry": {"metrics": mean_scores(result.geometry), "per_frame": result.geometry},
            }
            for result in results
        ],
    }
    (options.out / "results.json").write_text(json.dumps(data, indent=2) + "\n")
    (options.out / "results.md").write_text(markdown(results, options))
