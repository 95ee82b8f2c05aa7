"""What is tried when a device's memory did not suffice: the same job at a smaller setting, step by step.

The engine says ``device.out_of_memory`` and ends with its own exit code; its process, and with it every byte
it had on the device, is gone before the next one starts. A fit goes down one preset at a time (smaller
pictures, fewer surfels), then to half the frames. A motion is asked for at its size, so it is rendered as it
is, on the processor. Nothing else about the job changes, and what was changed is told to its owner.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from service.jobs.model import JobKind

#: The engine's word and exit code for it.
OUT_OF_MEMORY = "device.out_of_memory"
EXIT_OUT_OF_MEMORY = 5
#: Its word for a GPU that is asked for and not there.
DEVICE_UNAVAILABLE = "device.unavailable"
#: How often a job is tried again in one attempt.
MOST_RETRIES = 2

#: Presets from the largest on; the engine's own default among them, and its default number of frames.
_PRESETS = ("full", "auto", "draft")
_DEFAULT_PRESET, _DEFAULT_FRAMES = "auto", 160
#: Fewer frames than this are no avatar.
_LEAST_FRAMES = 20


@dataclass(frozen=True)
class Setting:
    """What the engine is started with: a fit's ``options``, or a motion (also ``options``) and where it is
    rendered; ``changed`` says in words what differs from what was asked for, the last change last."""

    options: Mapping[str, Any]
    device: str | None = None
    changed: tuple[str, ...] = field(default=())

    def smaller(self, kind: str) -> Setting | None:
        """The next step down; None when there is none, or when enough was tried."""
        if len(self.changed) >= MOST_RETRIES:
            return None
        if kind == JobKind.RENDER:
            return None if self.device == "cpu" else self._with("on the processor", self.options, "cpu")
        preset = self.options.get("preset") or _DEFAULT_PRESET
        below = _PRESETS[_PRESETS.index(preset) + 1 :] if preset in _PRESETS else ()
        if below:
            return self._with(f"with the preset {below[0]}", {**self.options, "preset": below[0]})
        frames = int(self.options.get("max_frames") or _DEFAULT_FRAMES) // 2
        if frames < _LEAST_FRAMES:
            return None
        return self._with(f"with {frames} frames at most", {**self.options, "max_frames": frames})

    def warning(self) -> dict[str, str]:
        """What the job's owner is told about the last change."""
        return {
            "code": "device.smaller_setting",
            "message": f"The GPU's memory did not suffice: the job goes on {self.changed[-1]}.",
            "advice": "For the setting you asked for, submit it with the device cpu, or a smaller video.",
        }

    def _with(self, words: str, options: Mapping[str, Any], device: str | None = None) -> Setting:
        return Setting(options, device or self.device, (*self.changed, words))
