"""Descent over the surfels at fixed poses: how they leave the mesh, then what they look like."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mass_engine.deform.network import Deformation
from mass_engine.fitting import losses, regularisers
from mass_engine.fitting.evidence import Scene
from mass_engine.fitting.guard import Guard
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, PosedSurfels, render_row
from mass_engine.fitting.views import Level
from mass_engine.raster import RasterOptions, RenderOutput

#: Learning rates: colour, logit, harmonic coefficients, light; of the deformation, tables and layers.
RATES = {"albedo": 0.01, "opacity_logits": 0.03, "sh": 0.002, "light": 0.001}
TABLE_RATE, LAYER_RATE = 0.01, 0.002
#: The mask's place among the deformation's outputs.
MASK = 8
#: The validation frames' mean PSNR must rise by this much in a visit of all frames, or the pass ends, dB.
LEAST_GAIN = 0.02
#: What is left of the learning rates after each visit of all frames.
DECAY = 0.4
#: The hand's usual length, metres: the unit of depth distortion.
HAND_SIZE = 0.18


@dataclass(frozen=True)
class SurfelPass:
    """One resolution. ``visits`` of all frames at most; ``geometry`` moves the detached surfels, otherwise
    their opacity mask is free; ``harmonics`` frees the view-dependent colour."""

    side: int
    visits: int
    rate: float = 1.0
    dssim: float = 0.2
    geometry: bool = False
    harmonics: bool = False

    def folded(self) -> SurfelPass:
        """One more visit at the rates the pass ends with."""
        return replace(self, visits=1, rate=self.rate * DECAY ** (self.visits - 1))


@dataclass(frozen=True)
class SurfelWeights:
    """What the terms weigh. ``binding`` names the loss; ``delta`` metres is how far a detached surfel may be
    from its face for nothing; ``still`` holds the residuals (in their units) towards none."""

    silhouette: float = 0.5
    binding: str = "additive"
    binding_weight: float = 1.0
    delta: float = 5e-4
    normal: float = 0.02
    distortion: float = 10.0
    still: float = 0.01


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
    """Passes over the rows of ``scene``; ``undone`` counts the steps that the guard took back."""

    def __init__(self, scene: Scene, weights: SurfelWeights | None = None, shading: bool = True) -> None:
        self.scene = scene
        self.weights = weights or SurfelWeights()
        self.shading = shading
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
        """Until validation stops gaining, or ``stage.visits``; ``rows``: these instead, one visit, whatever
        validation says."""
        random = torch.Generator().manual_seed(seed)
        trained = rows or self.scene.trained
        groups = list(_groups(skin, appearance, stage, self.shading))
        parameters = [value for _, value in groups]
        for value in parameters:
            value.requires_grad_(True)
        optimizer = torch.optim.Adam(
            [{"params": [value], "lr": rate} for rate, value in groups], betas=(0.9, 0.98), eps=1e-15
        )
        guard = Guard(parameters)
        before = latest = self.validation(skin, appearance, stage.side)
        visits = 1 if rows else stage.visits
        kept = [value.detach().clone() for value in parameters]
        visit = 0
        while visit < visits:
            order = torch.randperm(len(trained), generator=random).tolist()
            for step, place in enumerate(order):
                factor = stage.rate * guard.rate * DECAY ** (visit + step / len(order))
                for group, (rate, _) in zip(optimizer.param_groups, groups, strict=True):
                    group["lr"] = rate * factor
                optimizer.zero_grad(set_to_none=True)
                loss = self._loss(skin, appearance, stage, trained[place], random)
                loss.backward()
                if skin.deformation is not None:
                    _freeze_part(skin.deformation, stage.geometry)
                if guard.good(loss):
                    optimizer.step()
                if progress is not None:
                    progress((visit + (step + 1) / len(order)) / visits)
            visit += 1
            reached = self.validation(skin, appearance, stage.side)
            if rows is None and reached < latest + LEAST_GAIN:
                if reached < latest:
                    with torch.no_grad():  # back to where validation was best
                        for value, good in zip(parameters, kept, strict=True):
                            value.copy_(good)
                latest = max(latest, reached)
                break
            latest = reached
            kept = [value.detach().clone() for value in parameters]
        self.undone += guard.undone
        for value in parameters:
            value.requires_grad_(False)
            value.grad = None
        return PassResult(visit, before, latest)

    def validation(self, skin: Skin, appearance: Appearance, side: int) -> float:
        """Mean PSNR of the validation frames (NaN: there are none), hand over black.

        The error is summed over all valid pixels and divided by the hand's area: what sticks out costs as
        much as a hole. Inside the mask alone, a fatter hand would always be a better one.
        """
        values = []
        for row in self.scene.validation:
            with torch.no_grad():
                level = self.scene.views[row].level(side)
                rgb = self._render(skin, appearance, level, row)[1]
                usable = torch.where(level.hand > 0.5, level.colored, level.valid)
                squared = (rgb.clamp(0, 1) - level.rgb * level.hand.unsqueeze(-1)).square().mean(-1) * usable
                area = (level.hand * level.colored).sum().clamp_min(1)
                values.append(float(-10 * (squared.sum() / area).clamp_min(1e-8).log10()))
        return sum(values) / len(values) if values else float("nan")

    def _render(
        self,
        skin: Skin,
        appearance: Appearance,
        level: Level,
        row: int,
        background: Tensor | None = None,
        options: RasterOptions | None = None,
    ) -> tuple[RenderOutput, Tensor, PosedSurfels]:
        """The frame's hand before ``background``, its colours with the frame's gain, and the surfels."""
        surfels = self.scene.surfels(skin, row)
        out = render_row(
            appearance, surfels, 0, skin.bones, level.camera, options or self.scene.raster, background
        )
        gain = self.scene.gains[row]
        rgb = out.rgb
        if bool((gain != 1).any()):
            behind = torch.zeros(3) if background is None else background
            through = (1 - out.alpha).unsqueeze(-1) * behind
            rgb = (rgb - through) * gain + through
        return out, rgb, surfels

    def _loss(
        self, skin: Skin, appearance: Appearance, stage: SurfelPass, row: int, random: torch.Generator
    ) -> Tensor:
        w = self.weights
        level = self.scene.views[row].level(stage.side)
        background = torch.rand(3, generator=random)
        shaped = stage.geometry and (w.normal > 0 or w.distortion > 0)
        options = self._shaped_options(row) if shaped else None
        out, rgb, surfels = self._render(skin, appearance, level, row, background, options)
        area = level.hand.sum().clamp_min(16.0)
        cover = level.hand.unsqueeze(-1)
        target = level.rgb * cover + background * (1 - cover)
        loss = losses.photometric(rgb, target, level.colored, area)
        if stage.dssim > 0:
            inside = level.colored * (level.hand > 0)
            window = level.hand_window()
            structure = losses.dssim(rgb[window], target[window], inside[window])
            loss = (1 - stage.dssim) * loss + stage.dssim * 2 * structure
        loss = loss + w.silhouette * losses.silhouette(out.alpha, level.hand, level.valid, area, holes=0.0)
        if not stage.geometry:
            return loss
        if options is not None:
            depth = self.scene.table.values["transl"][row, 2]
            loss = loss + w.distortion * regularisers.depth_distortion(
                out.distortion, level.valid, area, options, depth, HAND_SIZE
            )
            loss = loss + w.normal * regularisers.normal_consistency(
                out.median_depth, out.normal, out.alpha, level.camera.K, level.valid, area
            )
        return loss + self._held(skin, surfels)

    def _held(self, skin: Skin, surfels: PosedSurfels) -> Tensor:
        """What binds the detached surfels to the mesh."""
        w = self.weights
        if surfels.residuals is None:
            return torch.zeros(())
        attached, start = surfels.attached, skin.detached_from
        means, normals = attached.means[:, start:], attached.normals[:, start:]
        residuals = surfels.residuals
        config = skin.deformation.config if skin.deformation is not None else None
        assert config is not None
        still = (residuals.offset / config.offset_unit).square().mean() + residuals.log_scale.square().mean()
        loss = w.still * (still + (residuals.rotation / config.rotation_unit).square().mean())
        if w.binding == "none":
            return loss * 0.0
        triangles = skin.triangles(surfels.outline_vertices)
        if w.binding == "paper":
            return loss + w.binding_weight * regularisers.binding_paper(means, normals, triangles, w.delta)
        return loss + w.binding_weight * regularisers.binding_additive(means, normals, triangles, w.delta)

    def _shaped_options(self, row: int) -> RasterOptions:
        depth = float(self.scene.table.values["transl"][row, 2].abs().clamp_min(0.05))
        return RasterOptions(
            outputs="all",
            cull_backfaces=self.scene.raster.cull_backfaces,
            distortion_range=(0.5 * depth, 2.0 * depth),
        )


def _groups(
    skin: Skin, appearance: Appearance, stage: SurfelPass, shading: bool
) -> Iterator[tuple[float, Tensor]]:
    """Learning rate and tensor of everything that the pass moves."""
    names = ["albedo", "opacity_logits"] + (["light"] if shading else [])
    if stage.harmonics and appearance.sh.shape[1] > 0:
        names.append("sh")
    for name in names:
        yield RATES[name], getattr(appearance, name)
    moving = skin.deformation
    if moving is None:
        return
    if stage.geometry:
        for name, value in moving.named_parameters():
            yield (TABLE_RATE if "table" in name else LAYER_RATE), value
    else:
        yield LAYER_RATE, moving.head
        yield LAYER_RATE, moving.head_bias


def _freeze_part(moving: Deformation, geometry: bool) -> None:
    """Take away the gradient of the mask (stage one) or of everything but the mask (stage two)."""
    frozen = slice(MASK, MASK + 1) if geometry else slice(0, MASK)
    for value in (moving.head, moving.head_bias):
        if value.grad is not None:
            value.grad[..., frozen] = 0
