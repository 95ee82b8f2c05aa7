"""The report's curves."""

from __future__ import annotations

from mass_engine.fitting.report import curves


def test_curves_come_from_the_notes_and_leave_out_what_is_not_there() -> None:
    notes = {
        "pull_pixels": [
            {"side": 320, "training": 2.0, "validation": 2.5},
            {"side": 640, "training": 1.0, "validation": 1.5},
        ],
        "stage_two": [{"validation_before": None, "validation_after": None}],
    }
    found = curves(notes)
    assert list(found.values()) == [[2.0, 1.0], [2.5, 1.5]]
    assert curves({}) == {}
