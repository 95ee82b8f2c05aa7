"""FitReport: what a fit measured about itself, as written to report.json."""

from __future__ import annotations

import json
import os
import platform
import resource
import sys
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

FILE_NAME = "report.json"
_PACKAGES = ("mass-hand", "torch", "numpy", "opencv-contrib-python-headless", "av", "ai-edge-litert")


@dataclass
class FitReport:
    """``metrics`` are means over the scored frames, ``scored_frames`` says which kind those were."""

    video: dict[str, Any]
    options: dict[str, Any]
    side: str
    fov: dict[str, Any]
    frames: dict[str, Any]
    surfels: dict[str, Any]
    metrics: dict[str, float | None] = field(default_factory=dict)
    scored_frames: dict[str, Any] = field(default_factory=dict)
    per_frame: list[dict[str, Any]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_bytes: int = 0
    rejected_steps: int = 0
    seed: int = 0
    versions: dict[str, str] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=dict)
    warnings: list[dict[str, str]] = field(default_factory=list)

    def write(self, directory: Path) -> None:
        """Write report.json in one step."""
        target = directory / FILE_NAME
        partial = target.with_name(FILE_NAME + ".partial")
        partial.write_text(json.dumps(asdict(self), indent=2) + "\n")
        os.replace(partial, target)

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
        return "\n".join(lines)


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
