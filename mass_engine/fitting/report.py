"""FitReport: what a fit measured about itself, as written to report.json."""

from __future__ import annotations

import json
import os
import platform
import resource
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

FILE_NAME = "report.json"
#: Stages that both hands of a clip share.
SHARED_STAGES = ("read", "track")
_PACKAGES = ("mass-hand", "torch", "numpy", "opencv-contrib-python-headless", "av", "ai-edge-litert")


@dataclass
class FitReport:
    """``metrics`` are means over the scored frames, ``scored_frames`` says which kind those were. The second
    figure, ``after_test_time_pose_refinement``, is of a few held-out ``frames``: their ``metrics``, and the
    same frames' ``as_fitted``; empty where none were asked for."""

    video: dict[str, Any]
    options: dict[str, Any]
    side: str
    fov: dict[str, Any]
    frames: dict[str, Any]
    surfels: dict[str, Any]
    metrics: dict[str, float | None] = field(default_factory=dict)
    scored_frames: dict[str, Any] = field(default_factory=dict)
    per_frame: list[dict[str, Any]] = field(default_factory=list)
    after_test_time_pose_refinement: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_bytes: int = 0
    fit: dict[str, Any] = field(default_factory=dict)
    curves: dict[str, list[float]] = field(default_factory=dict)
    seed: int = 0
    versions: dict[str, str] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=dict)
    warnings: list[dict[str, str]] = field(default_factory=list)

    def write(self, directory: Path) -> None:
        """Write report.json in one step."""
        _write_json(asdict(self), directory)

    def summary(self) -> str:
        """A few lines for a person."""
        total = sum(self.seconds.values())
        lines = [
            f"{self.side} hand, {self.surfels['kept']} surfels, {total:.0f} s, "
            f"{self.peak_memory_bytes / 2**20:.0f} MiB at most",
            f"  {len(self.frames['fitted'])} frames fitted of {self.frames['tracked']} that show the hand",
        ]
        kind = self.scored_frames.get("kind", "")
        for name, value in self.metrics.items():
            lines.append(f"  {kind} {name}: " + ("not computed" if value is None else f"{value:.3f}"))
        again = self.after_test_time_pose_refinement
        for name, value in again.get("metrics", {}).items():
            first = again["as_fitted"][name]
            if value is not None and first is not None:
                lines.append(
                    f"  {len(again['frames'])} heldout frames, after test-time pose refinement {name}: "
                    f"{value:.3f} (as fitted {first:.3f})"
                )
        return "\n".join(lines)


@dataclass
class HandsReport:
    """What a fit of both hands measured: the report of each by side, which also lies in the side's folder.

    ``seconds`` of the whole, the shared passes counted once; ``warnings`` of either hand, each once.
    """

    hands: dict[str, FitReport]
    seconds: dict[str, float]
    peak_memory_bytes: int
    warnings: list[dict[str, str]]

    @staticmethod
    def of(reports: Sequence[FitReport]) -> HandsReport:
        """Put the reports of the hands of one clip together."""
        seconds: dict[str, float] = {}
        for number, report in enumerate(reports):
            for name, value in report.seconds.items():
                if number == 0 or name not in SHARED_STAGES:
                    seconds[name] = round(seconds.get(name, 0.0) + value, 3)
        warnings: list[dict[str, str]] = []
        for report in reports:
            warnings += [warning for warning in report.warnings if warning not in warnings]
        peak = max(report.peak_memory_bytes for report in reports)
        return HandsReport({report.side: report for report in reports}, seconds, peak, warnings)

    def write(self, directory: Path) -> None:
        """Write report.json in one step."""
        _write_json(asdict(self), directory)

    def summary(self) -> str:
        """A few lines for a person."""
        return "\n".join(report.summary() for report in self.hands.values())


def curves(notes: dict[str, Any]) -> dict[str, list[float]]:
    """What fell and rose during a fit, by name, from the fit's own notes (``FitState.notes``)."""
    pulls: list[dict[str, float]] = notes.get("pull_pixels", [])
    passes: list[dict[str, float | None]] = notes.get("stage_two", [])
    reached = [turn[f"validation_{when}"] for turn in passes for when in ("before", "after")]
    found = {
        "pull of the training frames, pixels": [turn["training"] for turn in pulls],
        "pull of the validation frames, pixels": [turn["validation"] for turn in pulls],
        "validation PSNR before and after each pass of stage two, dB": [
            value for value in reached if value is not None
        ],
    }
    return {name: values for name, values in found.items() if values}


def _write_json(data: dict[str, Any], directory: Path) -> None:
    target = directory / FILE_NAME
    partial = target.with_name(FILE_NAME + ".partial")
    partial.write_text(json.dumps(data, indent=2) + "\n")
    os.replace(partial, target)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages whose numbers a result may depend on."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, Any]:
    """Processor and cores."""
    return {"processor": platform.machine(), "system": platform.system(), "cores": os.cpu_count()}


def peak_memory_bytes() -> int:
    """Largest resident size of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
