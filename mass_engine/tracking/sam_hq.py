"""Masks by SAM-HQ (Ke et al. 2023), an optional extra: the package and the user's own checkpoint.

The clip's colour segmenter says where the hand is and what to ignore; the network, prompted with that and the
landmarks, says where the edge runs.
"""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.errors import EngineError
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE, HandMask, HandSegmenter

_PACKAGE = "segment_anything_hq"
_HQ_KEY = "mask_decoder.hf_token.weight"  # what HQ adds to SAM
_POSITION_KEY = "image_encoder.pos_embed"  # [1,64,64,C]; the small encoder has none
_KINDS = {768: "vit_b", 1024: "vit_l", 1280: "vit_h"}
_AGREE = 0.5  # least IoU with the colour mask; below it the network took another thing


class Predictor(Protocol):
    """The part of the package's ``SamPredictor`` that is used here."""

    def set_image(self, image: NDArray[np.uint8]) -> None:
        """Encode an RGB picture uint8 [h,w,3]."""

    def predict(self, **prompts: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], Any]:
        """Masks (logits) [C,h,w], their expected IoU [C], and small logits."""


class SamHqSegmenter:
    """Refines the masks of a :class:`HandSegmenter` of the same clip."""

    def __init__(self, first: HandSegmenter, predictor: Predictor) -> None:
        self._first = first
        self._predictor = predictor
        self._lock = Lock()  # a predictor holds one picture

    def __call__(self, rgb: NDArray[np.uint8], landmarks: HandLandmarks) -> HandMask:
        """As :meth:`HandSegmenter.__call__`; its own mask where the network finds something else."""
        mask = self._first(rgb, landmarks)
        x, y, w, h = mask.box
        hand = mask.labels == HAND
        if not hand.any():
            return mask
        rows, columns = np.flatnonzero(hand.any(1)), np.flatnonzero(hand.any(0))
        points = landmarks.points - (x, y)
        cells = np.floor(points).astype(int)
        inside = ((cells >= 0) & (cells < (w, h))).all(1)
        points, cells = points[inside], cells[inside]
        points = points[hand[cells[:, 1], cells[:, 0]]]  # a landmark on a sleeve or a ring says nothing
        with self._lock:
            self._predictor.set_image(np.ascontiguousarray(rgb[y : y + h, x : x + w]))
            logits, _, _ = self._predictor.predict(
                point_coords=points.astype(np.float32) if len(points) else None,
                point_labels=np.ones(len(points), np.int32) if len(points) else None,
                box=np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float32),
                multimask_output=False,
                return_logits=True,
            )
        coverage = 1 / (1 + np.exp(-np.clip(np.asarray(logits[0], np.float32), -30, 30)))
        ignored = mask.labels == IGNORE
        coverage[ignored] = 0.0
        found = coverage > 0.5
        if (found & hand).sum() < _AGREE * (found | hand).sum():
            return mask
        labels = np.where(found, HAND, np.where(ignored, IGNORE, BACKGROUND)).astype(np.uint8)
        return HandMask(mask.box, labels, coverage.astype(np.float32))


def load_predictor(weights: Path) -> Predictor:
    """The network with the user's checkpoint ``weights``.

    Raises EngineError: ``sam_hq.not_installed``, ``sam_hq.missing``, ``sam_hq.unreadable``,
    ``sam_hq.wrong_file``. Nothing in the file is executed: only tensors are read.
    """
    state = _read_state(weights)
    try:
        package = importlib.import_module(_PACKAGE)
    except ImportError as error:
        raise EngineError(
            "sam_hq.not_installed",
            f"SAM-HQ cannot be loaded: {error}.",
            "Install the extra: pip install 'mass-hand[sam-hq]'.",
        ) from error
    network = package.sam_model_registry[_kind(state, weights)]()
    missing = set(network.state_dict()) - set(state)
    if missing:
        raise _wrong(weights, f"it lacks {len(missing)} tensors, {min(missing)} among them")
    try:
        network.load_state_dict(state, strict=False)
    except RuntimeError as error:
        raise _wrong(weights, "a tensor has another shape") from error
    network.eval()
    predictor: Predictor = package.SamPredictor(network)
    return _WithoutGradients(predictor)


class _WithoutGradients:
    def __init__(self, predictor: Predictor) -> None:
        self._predictor = predictor

    def set_image(self, image: NDArray[np.uint8]) -> None:
        with torch.no_grad():
            self._predictor.set_image(image)

    def predict(self, **prompts: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], Any]:
        with torch.no_grad():
            return self._predictor.predict(**prompts)


def _read_state(weights: Path) -> Mapping[str, Tensor]:
    if not weights.is_file():
        raise EngineError(
            "sam_hq.missing",
            f"There is no file {weights}.",
            "Give a SAM-HQ checkpoint with --segmenter-weights.",
        )
    try:
        state = torch.load(weights, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError) as error:
        raise EngineError(
            "sam_hq.unreadable",
            f"{weights.name} is not a file of tensors.",
            "Give a SAM-HQ checkpoint (.pth) as its authors publish it; files with code in them are refused.",
        ) from error
    if not isinstance(state, Mapping) or not all(isinstance(value, Tensor) for value in state.values()):
        raise _wrong(weights, "it holds no table of tensors")
    return state


def _kind(state: Mapping[str, Tensor], weights: Path) -> str:
    """The registry's name of the network in ``state``."""
    if _HQ_KEY not in state:
        raise _wrong(weights, f"it has no {_HQ_KEY}")
    if _POSITION_KEY not in state:
        return "vit_tiny"
    width = int(state[_POSITION_KEY].shape[-1])
    if width not in _KINDS:
        raise _wrong(weights, f"no encoder is {width} wide")
    return _KINDS[width]


def _wrong(weights: Path, why: str) -> EngineError:
    return EngineError(
        "sam_hq.wrong_file",
        f"{weights.name} is no SAM-HQ checkpoint: {why}.",
        "Give sam_hq_vit_b, _l, _h or _tiny; plain SAM checkpoints do not fit.",
    )
