"""Descent over the surfels at fixed poses: how they leave the mesh, then what they look like."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.device import Precision
from mass_engine.fitting.evidence import Scene
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.static_pass import StaticSteps
from mass_engine.fitting.subject import Appearance
from mass_engine.fitting.surfel_loss import (
    Frame,
    render_frame,
    shaped_options,
    surfel_loss,
)
from mass_engine.fitting.surfel_loss import SurfelWeights as SurfelWeights
from mass_engine.fitting.surfel_steps import DECAY, EagerSteps, Visit, groups_of
from mass_engine.fitting.surfel_steps import SurfelPass as SurfelPass

#: The validation frames' mean PSNR must rise by this much in a visit of all frames, or the pass ends, dB.
LEAST_GAIN = 0.02


@dataclass(frozen=True)
class PassResult:
    """Visits made, validation PSNR before and after (dB; NaN without validation frames)."""

    visits: int
    before: float
    after: float

    def summary(self, side: int) -> dict[str, float | None]:
        """For the report; None where nothing was validated (JSON has no NaN)."""
        return {
            "side": side,
            "visits": self.visits,
            "validation_before": rounded(self.before),
            "validation_after": rounded(self.after),
        }


def rounded(decibels: float) -> float | None:
    """To three digits, None for NaN."""
    return round(decibels, 3) if math.isfinite(decibels) else None


class SurfelFit:
    """Passes over the rows of ``scene``, where it is at work; ``undone`` counts the steps that the guard
    took back.

    ``static``: by steps of fixed shapes that do not wait for the device (None: on a GPU). ``precision`` of
    the deformation's matrix products on a GPU.
    """

    def __init__(
        self,
        scene: Scene,
        weights: SurfelWeights | None = None,
        shading: bool = True,
        static: bool | None = None,
        precision: Precision = "float32",
    ) -> None:
        self.scene = scene.at_work()
        self.static = self.scene.device.type == "cuda" if static is None else static
        self.weights = weights or SurfelWeights()
        self.shading = shading
        self.precision = precision
        self.undone = 0

    def run(
        self,
        skin: Skin,
        appearance: Appearance,
        stage: SurfelPass,
        seed: int,
        progress: Callable[[float], None] | None = None,
        rows: list[int] | None = None,
    ) -> PassResult:
        """Until validation stops gaining, or ``stage.visits``; ``rows``: these instead, one visit. Whatever
        validation says where surfels settle or ``rows`` are given."""
        random = torch.Generator().manual_seed(seed)
        trained = rows or self.scene.trained
        given, (skin, appearance) = (skin, appearance), self._here(skin, appearance)
        groups = list(groups_of(skin, appearance, stage, self.shading))
        parameters = [value for _, value in groups]
        for value in parameters:
            value.requires_grad_(True)
        steps = self._steps(skin, appearance, stage, groups, trained)
        before = latest = self.validation(skin, appearance, stage.side)
        visits = 1 if rows else stage.visits
        kept = [value.detach().clone() for value in parameters]
        free, visit = bool(rows) or stage.settle, 0
        while visit < visits:
            order = torch.randperm(len(trained), generator=random).tolist()
            plan = Visit(
                [trained[place] for place in order],
                [torch.rand(3, generator=random) for _ in order],
                [stage.rate * DECAY ** (visit + step / len(order)) for step in range(len(order))],
            )

            def report(done: int, visit: int = visit, steps: int = len(order)) -> None:
                if progress is not None:
                    progress((visit + done / steps) / visits)

            steps.visit(plan, report)
            visit += 1
            _hand_back(given, (skin, appearance))
            reached = self.validation(skin, appearance, stage.side)
            if not free and reached < latest + LEAST_GAIN:
                if reached < latest:
                    with torch.no_grad():  # back to where validation was best
                        for value, good in zip(parameters, kept, strict=True):
                            value.copy_(good)
                latest = max(latest, reached)
                break
            latest = reached
            kept = [value.detach().clone() for value in parameters]
        self.undone += steps.undone
        for value in parameters:
            value.requires_grad_(False)
            value.grad = None
        _hand_back(given, (skin, appearance))
        return PassResult(visit, before, latest)

    def _steps(
        self,
        skin: Skin,
        appearance: Appearance,
        stage: SurfelPass,
        groups: list[tuple[float, Tensor]],
        rows: list[int],
    ) -> EagerSteps | StaticSteps:
        if self.static:
            return StaticSteps(self.scene, skin, appearance, stage, self.weights, groups, rows)

        def loss(row: int, background: Tensor) -> Tensor:
            options = self.scene.raster
            if stage.shaped(self.weights):
                depth = float(self.scene.table.values["transl"][row, 2].abs().clamp_min(0.05))
                options = shaped_options(options, depth)
            surfels = self.scene.surfels(skin, row)
            frame, weights = self.frame(row, stage.side), self.weights
            background = background.to(self.scene.device)
            return surfel_loss(
                appearance, skin, frame, surfels, background, options, weights, stage.dssim, stage.geometry
            )[0]

        return EagerSteps(skin, groups, stage.geometry, loss)

    def validation(self, skin: Skin, appearance: Appearance, side: int) -> float:
        """Mean PSNR of the validation frames (NaN: there are none), hand over black.

        The error is summed over all valid pixels and divided by the hand's area: what sticks out costs as
        much as a hole. Inside the mask alone, a fatter hand would always be a better one.
        """
        skin, appearance = self._here(skin, appearance)
        values = []
        for row in self.scene.validation:
            with torch.no_grad():
                frame = self.frame(row, side, windowed=False)
                level, surfels = frame.level, self.scene.surfels(skin, row)
                rgb = render_frame(appearance, skin.bones, frame, surfels, self.scene.raster)[1]
                usable = torch.where(level.hand > 0.5, level.colored, level.valid)
                squared = (rgb.clamp(0, 1) - level.rgb * level.hand.unsqueeze(-1)).square().mean(-1) * usable
                area = (level.hand * level.colored).sum().clamp_min(1)
                values.append(float(-10 * (squared.sum() / area).clamp_min(1e-8).log10()))
        return sum(values) / len(values) if values else float("nan")

    def _here(self, skin: Skin, appearance: Appearance) -> tuple[Skin, Appearance]:
        """Where the scene is (themselves if they are there)."""
        skin, appearance = skin.to(self.scene.device), appearance.to(self.scene.device)
        if skin.deformation is not None and self.scene.device.type == "cuda":
            skin.deformation.precision = self.precision
        return skin, appearance

    def frame(self, row: int, side: int, windowed: bool = True) -> Frame:
        """One row's frame where the scene is; ``windowed``: with the window around the hand."""
        level, gain = self.scene.level(row, side), self.scene.gains[row]
        depth = self.scene.table.values["transl"][row, 2]
        window = level.hand_window() if windowed else None
        return Frame(level, depth, gain if bool((gain != 1).any()) else None, window)


def _hand_back(given: tuple[Skin, Appearance], here: tuple[Skin, Appearance]) -> None:
    """What a pass has reached, to where its caller has it."""
    given[0].take(here[0])
    given[1].take(here[1])
