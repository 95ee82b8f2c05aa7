"""SAM-HQ on a stand-in package of the same interface: the real one needs torchvision, and weights."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.options import FitOptions
from mass_engine.tracking.sam_hq import SamHqSegmenter, load_predictor
from mass_engine.tracking.segmentation import HAND, IGNORE, HandSegmenter
from tests.engine.tracking.clips import landmarks, open_hand
from tests.engine.tracking.test_segmentation import SKIN, painted


class Network(nn.Module):
    """Names and sizes of the tensors that tell the kinds apart."""

    def __init__(self, width: int | None) -> None:
        super().__init__()
        self.image_encoder = nn.Module()
        if width is not None:
            self.image_encoder.pos_embed = nn.Parameter(torch.zeros(1, 64, 64, width))
        self.mask_decoder = nn.Module()
        self.mask_decoder.hf_token = nn.Embedding(1, 256)


class Predictor:
    """Answers every prompt with the box's ellipse; remembers what it was asked."""

    asked: dict[str, Any]

    def __init__(self, network: Network) -> None:
        self.network = network

    def set_image(self, image: NDArray[np.uint8]) -> None:
        assert image.dtype == np.uint8
        self.size = image.shape[:2]

    def predict(self, **prompts: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], None]:
        self.asked = prompts
        assert prompts["return_logits"]
        x0, y0, x1, y1 = prompts["box"]
        drawn = np.full(self.size, -8.0, np.float32)
        centre, half = (int(x0 + x1) // 2, int(y0 + y1) // 2), (int(x1 - x0) // 2, int(y1 - y0) // 2)
        cv2.ellipse(drawn, centre, half, 0, 0, 360, 8.0, -1)
        return drawn[None], np.ones(1, np.float32), None


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in: Any = ModuleType("segment_anything_hq")
    widths = {"vit_b": 768, "vit_l": 1024, "vit_h": 1280, "vit_tiny": None}
    stand_in.sam_model_registry = {
        kind: (lambda checkpoint=None, width=width: Network(width)) for kind, width in widths.items()
    }
    stand_in.SamPredictor = Predictor
    monkeypatch.setitem(sys.modules, "segment_anything_hq", stand_in)


def checkpoint(folder: Path, state: object) -> Path:
    path = folder / "weights.pth"
    torch.save(state, path)
    return path


@pytest.mark.parametrize("width", [768, 1024, 1280, None])
def test_the_kind_of_network_is_read_from_the_checkpoint(
    package: None, tmp_path: Path, width: int | None
) -> None:
    network: Any = Network(width)
    loaded: Any = load_predictor(checkpoint(tmp_path, network.state_dict()))
    token = loaded._predictor.network.mask_decoder.hf_token.weight
    assert torch.equal(token, network.mask_decoder.hf_token.weight)


def test_files_that_do_not_fit_are_refused(package: None, tmp_path: Path) -> None:
    good = Network(768).state_dict()
    without = {key: value for key, value in good.items() if "hf_token" not in key}
    shape = {**good, "mask_decoder.hf_token.weight": torch.zeros(2, 256)}
    width = {**good, "image_encoder.pos_embed": torch.zeros(1, 64, 64, 99)}
    for state in (without, shape, width, [torch.zeros(3)], {"a": 3}):
        with pytest.raises(EngineError, match=r"sam_hq\.wrong_file"):
            load_predictor(checkpoint(tmp_path, state))
    with pytest.raises(EngineError, match=r"sam_hq\.missing"):
        load_predictor(tmp_path / "nothing.pth")
    (tmp_path / "text.pth").write_text("no tensors")
    with pytest.raises(EngineError, match=r"sam_hq\.unreadable"):
        load_predictor(tmp_path / "text.pth")


def test_code_in_a_checkpoint_is_not_run(package: None, tmp_path: Path) -> None:
    mark = tmp_path / "ran"

    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (mark,)

    with pytest.raises(EngineError, match=r"sam_hq\.unreadable"):
        load_predictor(checkpoint(tmp_path, {"mask_decoder.hf_token.weight": Evil()}))
    assert not mark.exists()


def test_a_missing_package_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "segment_anything_hq", None)
    with pytest.raises(EngineError, match=r"sam_hq\.not_installed.*pip install"):
        load_predictor(checkpoint(tmp_path, Network(768).state_dict()))


def test_the_network_decides_the_edge_and_the_colours_what_to_ignore() -> None:
    points = open_hand(160, 260)
    image, _ = painted(points, SKIN, SKIN)
    hand = landmarks(points)
    first = HandSegmenter.train([(image, hand)])
    predictor = Predictor(Network(768))
    before, after = first(image, hand), SamHqSegmenter(first, predictor)(image, hand)
    assert before.box == after.box
    np.testing.assert_array_equal(before.labels == IGNORE, after.labels == IGNORE)
    np.testing.assert_array_equal(after.coverage > 0.5, after.labels == HAND)
    assert (after.labels != before.labels).any()
    assert len(predictor.asked["point_coords"]) > 10
    found = np.argwhere(before.labels == HAND)
    np.testing.assert_array_equal(predictor.asked["box"], [*found.min(0)[::-1], *(found.max(0)[::-1] + 1)])


def test_another_thing_than_the_hand_is_not_taken() -> None:
    class Elsewhere(Predictor):
        def predict(self, **prompts: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], None]:
            drawn = np.full(self.size, -8.0, np.float32)
            drawn[:30] = 8.0
            return drawn[None], np.ones(1, np.float32), None

    points = open_hand(160, 260)
    image, _ = painted(points, SKIN)
    first = HandSegmenter.train([(image, landmarks(points))])
    after = SamHqSegmenter(first, Elsewhere(Network(768)))(image, landmarks(points))
    np.testing.assert_array_equal(after.labels, first(image, landmarks(points)).labels)


def test_weights_and_segmenter_come_together() -> None:
    for options in ({"segmenter": "sam-hq"}, {"segmenter_weights": Path("a.pth")}, {"segmenter": "other"}):
        with pytest.raises(BadArgumentError):
            FitOptions(**options)
