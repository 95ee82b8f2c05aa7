"""ARCTIC (Fan et al. 2023), the egocentric view, as far as the method's paper says what it did with it.

``images/<sid>/<seq>/0/%05d.jpg`` (2800x2000), ``raw_seqs/<sid>/<seq>.mano.npy`` and ``.egocam.dist.npy``, and
``meta/misc.json``. Pictures are undistorted with the data set's own lens and halved to 1400x1000, the paper's
size. The paper trains on 80 % and does not say which: here every fifth frame is held out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.evaluation.datasets.outcome import (
    DatasetResult,
    EvalOptions,
    OurRow,
    Tell,
    missing,
    needs_mano,
    save_fit,
)
from mass_engine.evaluation.datasets.paper import ARCTIC
from mass_engine.evaluation.heldout import score_clip
from mass_engine.evaluation.lossless import write_lossless
from mass_engine.evaluation.refine import RefineOptions
from mass_engine.options import FitOptions
from mass_engine.pipeline import fit
from mass_engine.tracking.imports.values import read_values

#: Every so many frames one is held out: 80 % are for training.
HOLDOUT = 5
#: Pictures as distributed, and as the paper renders them.
FULL, HALF = (2800, 2000), (1400, 1000)
FPS = 30.0
_LAYOUT = "images/SID/SEQ/0/00001.jpg, raw_seqs/SID/SEQ.mano.npy and .egocam.dist.npy, meta/misc.json"

_PROTOCOL = (
    "Egocentric view, lens taken out, 1400x1000. Poses and shape are the data set's unless others are given.",
    "Every fifth frame is held out (20 %). The paper trains on 80 % and does not say which: this split is "
    "ours.",
    "The data set has no hand masks: they are this program's own unless a folder was given, objects and "
    "forearm ignored. Crops over 640 pixels are compared at 640.",
    "Held-out frames beyond 160 are thinned out evenly; at most --max-frames are fitted.",
)


def evaluate(options: EvalOptions, tell: Tell) -> DatasetResult:
    """Fit and score every sequence asked for. Raises EngineError ``eval.*``."""
    if options.mano is None:
        raise needs_mano("ARCTIC")
    rows = []
    for sid, name in sequences(options.root, options.sequences):
        tell(f"{sid}/{name}")
        folder = options.out / f"{sid}-{name}"
        folder.mkdir(parents=True, exist_ok=True)
        video = folder / "pictures.mkv"
        write_lossless(video, pictures(options.root, sid, name), FPS)
        poses = options.tracks or f"arctic:{options.root / 'raw_seqs' / sid / (name + '.mano.npy')}"
        outcome = fit(
            video,
            FitOptions(
                template=f"mano:{options.mano}",
                tracks=poses if ",undistorted=" in poses else f"{poses},undistorted=yes",
                masks=options.masks,
                side=options.side,
                preset=options.preset,
                holdout=HOLDOUT,
                seed=options.seed,
                max_frames=options.max_frames,
            ),
            warn=lambda code, message, _: tell(f"  note: {code}: {message}"),
        )
        save_fit(outcome, folder)
        video.unlink()
        scores = score_clip(
            outcome.avatar, outcome.clip, options.lpips, RefineOptions() if options.refine else None
        )
        scores.write(folder)
        rows.append(OurRow(f"{sid}/{name}", len(outcome.report.frames["fitted"]), scores))
    columns = {
        "psnr": "psnr_hand_on_black",
        "ms_ssim": "ms_ssim_hand_on_black",
        "lpips": "lpips_alex_01_hand_on_black",
    }
    return DatasetResult("ARCTIC, egocentric", _PROTOCOL, columns, ARCTIC, rows)


def sequences(root: Path, wanted: tuple[str, ...]) -> list[tuple[str, str]]:
    """(sid, sequence) of those that have poses and pictures, or of those ``wanted`` as SID/SEQ."""
    found = [
        (path.parent.name, path.name.removesuffix(".mano.npy"))
        for path in sorted((root / "raw_seqs").glob("*/*.mano.npy"))
    ]
    found = [(sid, name) for sid, name in found if (root / "images" / sid / name / "0").is_dir()]
    if wanted:
        lacking = [one for one in wanted if tuple(one.split("/")) not in found]
        if lacking:
            raise missing("ARCTIC", f"there is no sequence {lacking[0]}", _LAYOUT)
        found = [(sid, name) for sid, name in found if f"{sid}/{name}" in wanted]
    if not found:
        raise missing("ARCTIC", f"{root} has no sequence with poses and pictures", _LAYOUT)
    return found


def pictures(root: Path, sid: str, name: str) -> Iterator[NDArray[np.uint8]]:
    """The pictures of a sequence in order, undistorted, 1400x1000. Raises EngineError ``eval.dataset``."""
    folder = root / "images" / sid / name / "0"
    numbers = sorted(int(path.stem) for path in folder.glob("*.jpg") if re.fullmatch(r"\d+", path.stem))
    if not numbers or numbers != list(range(numbers[0], numbers[-1] + 1)):
        raise missing("ARCTIC", f"pictures of {sid}/{name} are missing", _LAYOUT)
    K, lens = _lens(root / "raw_seqs" / sid / f"{name}.egocam.dist.npy")
    for number in numbers:
        picture = cv2.imread(str(folder / f"{number:05d}.jpg"), cv2.IMREAD_COLOR)
        if picture is None or picture.shape[1::-1] not in (FULL, HALF):
            raise missing("ARCTIC", f"picture {number:05d}.jpg is not 2800x2000", _LAYOUT)
        # Somebody may have halved them already; OpenCV counts from the first pixel's centre.
        zoom = np.diag([picture.shape[1] / FULL[0], picture.shape[0] / FULL[1], 1.0])
        scaled = zoom @ K
        scaled[:2, 2] += 0.5 * (zoom[0, 0] - 1)
        straight = cv2.undistort(picture, scaled, lens)
        half = cv2.resize(straight, HALF, interpolation=cv2.INTER_AREA)
        yield np.ascontiguousarray(half[..., ::-1], np.uint8)


def _lens(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    try:
        values: Any = read_values(path)
        K = np.asarray(values["intrinsics"], np.float64).reshape(3, 3)
        lens = np.asarray(values["dist8"], np.float64).ravel()
    except (EngineError, KeyError, TypeError, ValueError) as error:
        raise missing("ARCTIC", f"{path.name} holds no intrinsics and dist8", _LAYOUT) from error
    return K, lens
