"""Steps of a pass over the surfels of one frame after the other: what they move, and how they are taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mass_engine.deform.network import Deformation
from mass_engine.fitting.guard import Guard
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance
from mass_engine.fitting.surfel_loss import SurfelWeights

#: Learning rates: colour, logit, harmonic coefficients, light; of the deformation, tables and layers.
RATES = {"albedo": 0.01, "opacity_logits": 0.03, "sh": 0.002, "light": 0.001}
TABLE_RATE, LAYER_RATE = 0.01, 0.002
#: Of static residuals: millimetres, logarithms, radians.
STATIC_RATES = {"offset": 0.1, "log_scale": 0.02, "rotation": 0.02}
#: The mask's place among the deformation's outputs.
MASK = 8
#: What is left of the learning rates after each visit of all frames.
DECAY = 0.4
#: Adam's decay of the mean gradient and of its square, and what keeps it from dividing by zero.
BETAS, EPSILON = (0.9, 0.98), 1e-15


@dataclass(frozen=True)
class SurfelPass:
    """One resolution. ``visits`` of all frames at most; ``geometry`` moves the detached surfels, otherwise
    their opacity mask is free; ``harmonics`` frees the view-dependent colour. ``settle`` frees the static
    residuals of attached surfels, and all visits are made: validation may fall on the way to closed holes."""

    side: int
    visits: int
    rate: float = 1.0
    dssim: float = 0.2
    geometry: bool = False
    harmonics: bool = False
    settle: bool = False

    def shaped(self, weights: SurfelWeights) -> bool:
        """Whether the rasteriser's further outputs weigh anything."""
        return self.geometry and (weights.normal > 0 or weights.distortion > 0)

    def folded(self) -> SurfelPass:
        """One more visit at the rates the pass ends with."""
        return replace(self, visits=1, rate=self.rate * DECAY ** (self.visits - 1))


@dataclass(frozen=True)
class Visit:
    """A plan: each frame once. ``rows`` in their order, ``backgrounds`` [3] and ``rates`` of their steps."""

    rows: Sequence[int]
    backgrounds: Sequence[Tensor]
    rates: Sequence[float]


class EagerSteps:
    """Operator by operator, as the losses say; ``loss`` gives that of a row before a background [3]."""

    def __init__(
        self,
        skin: Skin,
        groups: Sequence[tuple[float, Tensor]],
        geometry: bool,
        loss: Callable[[int, Tensor], Tensor],
    ) -> None:
        self._skin, self._groups, self._geometry, self._loss = skin, groups, geometry, loss
        self._optimizer = torch.optim.Adam(
            [{"params": [value], "lr": rate} for rate, value in groups], betas=BETAS, eps=EPSILON
        )
        self._guard = Guard([value for _, value in groups])

    @property
    def undone(self) -> int:
        """How often the guard went back."""
        return self._guard.undone

    def visit(self, plan: Visit, progress: Callable[[int], None]) -> None:
        """Take the plan's steps; ``progress`` is told how many are done."""
        optimizer, guard = self._optimizer, self._guard
        for step, (row, background) in enumerate(zip(plan.rows, plan.backgrounds, strict=True)):
            for group, (rate, _) in zip(optimizer.param_groups, self._groups, strict=True):
                group["lr"] = rate * (plan.rates[step] * guard.rate)
            optimizer.zero_grad(set_to_none=True)
            loss = self._loss(row, background)
            loss.backward()
            if self._skin.deformation is not None:
                freeze_part(self._skin.deformation, self._geometry)
            if guard.good(loss):
                optimizer.step()
            progress(step + 1)


def groups_of(
    skin: Skin, appearance: Appearance, stage: SurfelPass, shading: bool
) -> Iterator[tuple[float, Tensor]]:
    """Learning rate and tensor of everything that the pass moves."""
    names = ["albedo", "opacity_logits"] + (["light"] if shading else [])
    if stage.harmonics and appearance.sh.shape[1] > 0:
        names.append("sh")
    for name in names:
        yield RATES[name], getattr(appearance, name)
    if stage.settle and skin.static is not None:
        for name, value in skin.static.parameters().items():
            yield STATIC_RATES[name], value
    moving = skin.deformation
    if moving is None:
        return
    if stage.geometry:
        for name, value in moving.named_parameters():
            yield (TABLE_RATE if "table" in name else LAYER_RATE), value
    else:
        yield LAYER_RATE, moving.head
        yield LAYER_RATE, moving.head_bias


def freeze_part(moving: Deformation, geometry: bool) -> None:
    """Take away the gradient of the mask (stage one) or of everything but the mask (stage two)."""
    frozen = slice(MASK, MASK + 1) if geometry else slice(0, MASK)
    for value in (moving.head, moving.head_bias):
        if value.grad is not None:
            value.grad[..., frozen] = 0
