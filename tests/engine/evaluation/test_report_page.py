"""The page of a fit: complete, whole in itself, and escaped."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from mass_engine.cli import main
from mass_engine.evaluation.heldout import REFINED
from tests.engine.avatars import small_avatar


class Page(HTMLParser):
    """Collects what a page refers to and how many of each tag it has."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.tags: dict[str, int] = {}
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] = self.tags.get(tag, 0) + 1
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def page_of(run: Path) -> Page:
    page = Page()
    page.feed((run / "report.html").read_text())
    return page


@pytest.fixture
def run(tmp_path: Path) -> Path:
    small_avatar().save(tmp_path)
    frames = [{"index": i, "psnr_in_mask": 20.0 + i, "silhouette_iou": 0.9} for i in (7, 15, 23)]
    report = {
        "video": {"name": "<script>alert(1)</script>.mp4", "width": 160},
        "options": {"preset": "draft", "seed": 3},
        "side": "right",
        "frames": {"tracked": 30, "fitted": [0, 1], "heldout": [7, 15, 23]},
        "surfels": {"kept": 100},
        "metrics": {"psnr_in_mask": 27.0, "ms_ssim_hand_on_black": None},
        "scored_frames": {"kind": "heldout", "count": 3},
        "per_frame": frames,
        "seconds": {"fit": 12.5},
        "warnings": [{"code": "video.too_dark", "message": "It is dark.", "advice": ""}],
    }
    (tmp_path / "report.json").write_text(json.dumps(report))
    return tmp_path


def test_the_page_is_whole_in_itself_and_escapes_names(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(run)]) == 0
    assert "report.html" in capsys.readouterr().out
    page = page_of(run)
    assert page.tags.get("script", 0) == 0
    assert page.tags["img"] == 11
    assert all(re.match(r"data:image/(png|jpeg);base64,", source) for source in page.sources)
    for text in ("27.000", "not computed", "video.too_dark", "preset", "draft", "no curves", "12.5"):
        assert text in page.text
    assert page.tags["svg"] == 2  # no frame has psnr_hand_on_black


def test_curves_and_the_second_figure_are_shown_where_they_are(run: Path) -> None:
    report = json.loads((run / "report.json").read_text())
    report["curves"] = {"loss": [[0, 0.5], [10, 0.2], [20, None]], "psnr": [20.0, 21.5]}
    (run / "report.json").write_text(json.dumps(report))
    rows = [{"index": i, "psnr_in_mask": 20.0 + i} for i in (7, 15)]
    evaluation = {
        "frames": 2,
        "metrics": {"psnr_in_mask": 31.0},
        "per_frame": rows,
        REFINED: {"metrics": {"psnr_in_mask": 35.25}, "per_frame": rows},
    }
    (run / "evaluation.json").write_text(json.dumps(evaluation))
    assert main(["report", str(run), "--out", str(run / "other.html")]) == 0
    page = Page()
    page.feed((run / "other.html").read_text())
    assert page.tags["svg"] == 3
    assert page.tags["polyline"] == 4
    for text in ("31.000", "35.250", "after test-time pose refinement", "loss"):
        assert text in page.text


def test_the_second_figure_of_the_fit_itself_is_shown(run: Path) -> None:
    report = json.loads((run / "report.json").read_text())
    report[REFINED] = {
        "frames": [7, 15],
        "metrics": dict.fromkeys(report["metrics"], 29.25),
        "as_fitted": dict.fromkeys(report["metrics"], 28.75),
    }
    (run / "report.json").write_text(json.dumps(report))
    assert main(["report", str(run)]) == 0
    for text in ("27.000", "28.750 to 29.250", "2 of them, after test-time pose refinement"):
        assert text in page_of(run).text


def test_a_folder_without_a_run_is_told(tmp_path: Path) -> None:
    assert main(["report", str(tmp_path)]) == 2
