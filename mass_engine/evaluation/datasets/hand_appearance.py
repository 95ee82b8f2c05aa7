"""Hand Appearance (Karunratanakul et al. 2023, HARP): 448x448 crops of one hand with its arm.

``<seq>/unscreen_cropped/%04d.jpg``, ``mask/%04d_mask.jpg`` and ``metro_mano/%04d_mano.pkl``; what the poses
mean is in :mod:`mass_engine.tracking.imports.harp`. HARP's own code scores the frames it trains on, and the
split of 3D-PSHR that the paper follows is not public: here every fifth frame is held out.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.avatar import row_pose
from mass_engine.camera import Camera
from mass_engine.evaluation.datasets.outcome import (
    DatasetResult,
    EvalOptions,
    OurRow,
    Tell,
    missing,
    needs_mano,
    save_fit,
)
from mass_engine.evaluation.datasets.paper import HAND_APPEARANCE
from mass_engine.evaluation.heldout import score_clip
from mass_engine.evaluation.lossless import write_lossless
from mass_engine.evaluation.mesh_raster import mesh_mask
from mass_engine.evaluation.refine import RefineOptions
from mass_engine.hand.template import Template, load_template
from mass_engine.options import FitOptions
from mass_engine.pipeline import fit
from mass_engine.template_spec import parse_template
from mass_engine.tracking.imports.harp import FOCAL, SIZE
from mass_engine.tracking.imports.load import load_tracks
from mass_engine.tracking.tracks import Tracks, write_tracks
from mass_engine.tracks_spec import TracksSpec
from mass_engine.video.reader import VideoInfo

HOLDOUT = 5
FPS = 30.0
#: How far over the wrist a masked pixel belongs to the arm, in lengths of the palm.
_WRIST = 0.25
_LAYOUT = "SEQ/unscreen_cropped/0000.jpg, SEQ/mask/0000_mask.jpg, SEQ/metro_mano/0000_mano.pkl"

_PROTOCOL = (
    "448x448, focal length 2000, the data set's poses and masks.",
    "Every fifth frame is held out. The split the paper follows is not public, and HARP scores frames it "
    "trains on: this split is ours.",
    "The masks include the arm, which this program does not model: what lies behind the wrist is ignored.",
)


def evaluate(options: EvalOptions, tell: Tell) -> DatasetResult:
    """Fit and score every sequence asked for. Raises EngineError ``eval.*``."""
    if options.mano is None:
        raise needs_mano("Hand Appearance")
    template = load_template(parse_template(f"mano:{options.mano}"))
    rows = []
    for name in sequences(options.root, options.sequences):
        tell(name)
        source, folder = options.root / name, options.out / name.replace("/", "-")
        (folder / "masks").mkdir(parents=True, exist_ok=True)
        numbers = frames(source)
        settings = FitOptions(
            template=f"mano:{options.mano}",
            masks=folder / "masks",
            side="right",
            preset=options.preset,
            holdout=HOLDOUT,
            seed=options.seed,
            max_frames=options.max_frames,
        )
        tracks = _tracks(source, numbers, template, settings)
        write_tracks([tracks], folder / "given.json")
        _write_masks(source, numbers, tracks, template, folder / "masks")
        video = folder / "pictures.mkv"
        write_lossless(
            video, (_picture(source / "unscreen_cropped" / f"{number:04d}.jpg") for number in numbers), FPS
        )
        outcome = fit(
            video,
            FitOptions(**{**vars(settings), "tracks": folder / "given.json"}),
            warn=lambda code, message, _: tell(f"  note: {code}: {message}"),
        )
        save_fit(outcome, folder)
        video.unlink()
        scores = score_clip(
            outcome.avatar, outcome.clip, options.lpips, RefineOptions() if options.refine else None
        )
        scores.write(folder)
        rows.append(OurRow(name, len(outcome.report.frames["fitted"]), scores))
    columns = {"psnr": "psnr_in_mask", "ssim": "ssim_hand_on_black", "lpips": "lpips_alex_01_hand_on_black"}
    return DatasetResult("Hand Appearance", _PROTOCOL, columns, HAND_APPEARANCE, rows)


def sequences(root: Path, wanted: tuple[str, ...]) -> list[str]:
    """Folders under ``root`` that hold a sequence, or those ``wanted``."""
    found = sorted(
        path.parent.relative_to(root).as_posix() for path in root.rglob("metro_mano") if path.is_dir()
    )
    if wanted:
        lacking = [name for name in wanted if name not in found]
        if lacking:
            raise missing("Hand Appearance", f"there is no sequence {lacking[0]}", _LAYOUT)
        return [name for name in found if name in wanted]
    if not found:
        raise missing("Hand Appearance", f"{root} holds no metro_mano", _LAYOUT)
    return found


def frames(source: Path) -> list[int]:
    """Numbers of the frames that have picture, mask and pose."""

    def numbers(folder: str, pattern: str) -> set[int]:
        names = (re.fullmatch(pattern, path.name) for path in (source / folder).glob("*"))
        return {int(found[1]) for found in names if found}

    both = numbers("unscreen_cropped", r"(\d{4})\.jpg") & numbers("mask", r"(\d{4})_mask\.jpg")
    both &= numbers("metro_mano", r"(\d{4})_mano\.pkl")
    if len(both) < 2 * HOLDOUT:
        raise missing("Hand Appearance", f"{source.name} has {len(both)} whole frames", _LAYOUT)
    return sorted(both)


def _tracks(source: Path, numbers: list[int], template: Template, options: FitOptions) -> Tracks:
    """The data set's poses, rows in the order of the video's frames."""
    side = round(SIZE)
    info = VideoInfo(side, side, None, FPS, None, "ffv1", 0, None)
    camera = Camera.from_fov(side, side, math.degrees(2 * math.atan(SIZE / 2 / FOCAL)))
    place = {number: index for index, number in enumerate(numbers)}
    loaded = load_tracks(
        TracksSpec("harp", source, offset=0),
        template,
        info,
        "right",
        camera,
        False,
        lambda number: number not in place or options.is_heldout(place[number]),
    )
    known = loaded.tracks
    rows = [row for row, number in enumerate(known.indices) if number in place]
    index = torch.tensor(rows)
    pose = known.pose
    return Tracks(
        source.name,
        FPS,
        known.size,
        known.K,
        [place[known.indices[row]] for row in rows],
        [place[known.indices[row]] / FPS for row in rows],
        type(pose)(
            pose.betas[index], pose.global_orient[index], pose.hand_pose[index], pose.transl[index], pose.side
        ),
        known.joints3d[rows],
        known.landmarks2d[rows],
        [known.scores[row] for row in rows],
        known.template,
        known.at_joints,
        known.rotations,
    )


def _picture(path: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None or picture.shape[:2] != (round(SIZE), round(SIZE)):
        raise missing("Hand Appearance", f"{path.name} is no picture of 448x448", _LAYOUT)
    return np.ascontiguousarray(picture[..., ::-1], np.uint8)


def _write_masks(
    source: Path, numbers: list[int], tracks: Tracks, template: Template, out: Path
) -> None:  # fmt: skip
    """The data set's masks as ours (OUT/%06d.png): the arm behind the wrist is ignored."""
    rows = {index: row for row, index in enumerate(tracks.indices)}
    model = template.model("right")
    camera = Camera(tracks.K, torch.eye(4), *tracks.size)
    for index, number in enumerate(numbers):
        mask = _picture(source / "mask" / f"{number:04d}_mask.jpg")[..., 0] > 127
        labels = np.where(mask, 255, 0).astype(np.uint8)
        if index in rows:
            row = rows[index]
            with torch.no_grad():
                vertices = model(row_pose(tracks.pose, row))[0][0].double().numpy()
            hand = mesh_mask(vertices, model.faces.numpy(), camera).astype(np.uint8)
            wrist, knuckle = tracks.landmarks2d[row, 0], tracks.landmarks2d[row, 4]
            palm = max(float(np.linalg.norm(wrist - knuckle)), 1.0)
            reach = 2 * max(1, round(0.15 * palm)) + 1
            near = cv2.dilate(hand, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))) > 0
            y, x = np.mgrid[0 : mask.shape[0], 0 : mask.shape[1]] + 0.5
            over = (
                (x - wrist[0]) * (wrist[0] - knuckle[0]) + (y - wrist[1]) * (wrist[1] - knuckle[1])
            ) / palm
            labels[mask & (over > _WRIST * palm) & ~near] = 128
        cv2.imwrite(str(out / f"{index:06d}.png"), labels)
