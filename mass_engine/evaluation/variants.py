"""What ``mass-engine bench pareto`` compares: presets, and one thing of ``auto`` changed at a time."""

from __future__ import annotations

from dataclasses import replace

from mass_engine.fitting.schedule import Schedule, schedule_for, unsettled
from mass_engine.options import PRESETS

DEFAULT = "auto"


def variants(quick: bool) -> dict[str, dict[str, Schedule]]:
    """Schedules by group and name. Some are equal to others: each group has all of its axis."""
    base = schedule_for("draft" if quick else DEFAULT)
    groups: dict[str, dict[str, Schedule]] = {
        "preset": {name: schedule_for(name) for name in (("draft",) if quick else PRESETS)}
    }
    budgets = ((1, 0), (0, 1)) if quick else ((0, 1), (1, 0), (1, 1), (2, 0), (2, 1))
    groups["levels and depth"] = {
        f"L{levels} D{depth}": replace(base, levels=levels, depth=depth) for levels, depth in budgets
    }
    if quick:
        return groups
    # As needed, auto would take the same count for most of these: none of the choices is left to it.
    plain = replace(base, adaptive=False, detached=False, deforming=())
    groups["harmonics, every surfel"] = {
        f"{count} harmonics": replace(plain, harmonics=count) for count in (0, 3, 8, 15)
    }
    groups["resolution"] = {
        f"{side} px": replace(
            base,
            gather_side=side,
            appearance=tuple(replace(step, side=min(step.side, side)) for step in base.appearance),
        )
        for side in (160, 320, 640)
    }
    groups["iterations"] = {
        f"visits x{factor:g}": replace(
            base,
            appearance=tuple(
                replace(step, visits=max(1, round(factor * step.visits))) for step in base.appearance
            ),
        )
        for factor in (0.5, 2.0)
    }
    groups["capacity"] = {
        "every surfel, deformation": replace(base, adaptive=False),
        "every surfel, no deformation": plain,
        "as needed, no deformation": replace(base, detached=False, deforming=()),
    }
    groups["parts"] = {
        "attached surfels stay": unsettled(base),
        "no corners filled": replace(base, depth=0),
        "one colour from every side": replace(base, harmonics=0),
    }
    groups["registration"] = {
        "no texture rounds": replace(base, texture=()),
        "half the texture rounds": replace(base, texture=base.texture[::2]),
    }
    return groups
