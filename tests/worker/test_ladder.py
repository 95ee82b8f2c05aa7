"""The settings that are tried one after the other when a device's memory does not suffice."""

from __future__ import annotations

import subprocess
import sys

import pytest

from mass_engine.cli import EXIT_OUT_OF_MEMORY as ENGINE_EXIT
from mass_engine.errors import OUT_OF_MEMORY as ENGINE_CODE
from mass_engine.options import PRESETS, FitOptions
from service.jobs.model import JobKind
from tests.worker.harness import REPOSITORY
from worker import ladder
from worker.ladder import EXIT_OUT_OF_MEMORY, OUT_OF_MEMORY, Setting

DRAFT = {"preset": "draft"}


@pytest.mark.parametrize(
    ("asked", "steps"),
    [
        ({"preset": "full", "seed": 3}, [{"preset": "auto", "seed": 3}, {"preset": "draft", "seed": 3}]),
        ({}, [{"preset": "draft"}, {"preset": "draft", "max_frames": 80}]),
        ({"preset": None, "max_frames": 60}, [{**DRAFT, "max_frames": 60}, {**DRAFT, "max_frames": 30}]),
        ({"preset": "draft", "max_frames": 50}, [{"preset": "draft", "max_frames": 25}]),
        ({"preset": "draft", "max_frames": 30}, []),
        ({"preset": "unknown", "max_frames": 30}, []),
    ],
)  # fmt: skip
def test_a_fit_goes_down_one_preset_at_a_time_then_to_half_the_frames(
    asked: dict[str, object], steps: list[dict[str, object]]
) -> None:
    setting: Setting | None = Setting(asked)
    found = []
    while setting is not None:
        found.append(dict(setting.options))
        setting = setting.smaller(JobKind.FIT)
    assert found == [asked, *steps]
    assert len(found) <= 1 + ladder.MOST_RETRIES


def test_a_motion_is_rendered_as_it_is_on_the_processor() -> None:
    motion = {"width": 512}
    first = Setting(motion)
    second = first.smaller(JobKind.RENDER)
    assert second is not None
    assert (first.device, second.device, second.options) == (None, "cpu", motion)
    assert second.smaller(JobKind.RENDER) is None


def test_engine_and_worker_speak_of_the_same_failure() -> None:
    assert (OUT_OF_MEMORY, EXIT_OUT_OF_MEMORY) == (ENGINE_CODE, ENGINE_EXIT)
    assert {*ladder._PRESETS} == {*PRESETS}
    assert (FitOptions.preset, FitOptions.max_frames) == (ladder._DEFAULT_PRESET, ladder._DEFAULT_FRAMES)


def test_a_worker_holds_nothing_of_a_device() -> None:
    """Whatever is on a device belongs to the engine's process and goes with it."""
    code = (
        "import sys, worker.app, worker.supervisor, worker.__main__\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('torch', 'mass_engine', 'numpy')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
