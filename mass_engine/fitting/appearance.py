"""Stage two: geometry is frozen; opacity and the fine, then view-dependent, colour of every surfel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.fitting import losses
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.subject import (
    START_OPACITY,
    Appearance,
    PosedSurfels,
    Shape,
    draw,
    pose_surfels,
    render_row,
)
from mass_engine.fitting.views import Level, View
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import irradiance_basis, white_light


@dataclass(frozen=True)
class AppearancePass:
    """One resolution of stage two."""

    side: int
    visits: float
    rate: float = 1.0
    dssim: float = 0.2
    view_dependent: bool = False


#: Learning rates: colour, logit, harmonic coefficients, light.
APPEARANCE_RATES = {"albedo": 0.01, "opacity_logits": 0.03, "sh": 0.002, "light": 0.001}


@dataclass(frozen=True)
class Evidence:
    """What the video says of each surfel, as summed blending weights [N] on hand, ignored and background
    pixels, and its least-squares albedo [N,3] (zero where it was never seen as hand)."""

    hand: Tensor
    ignored: Tensor
    background: Tensor
    albedo: Tensor


class AppearanceFit:
    """Stage two over the training rows of ``views``."""

    def __init__(
        self,
        views: list[View],
        table: PoseTable,
        shape: Shape,
        binding: MeshBinding,
        seed: int,
        raster: RasterOptions,
    ) -> None:
        self.views, self.table, self.shape = views, table, shape
        self.binding, self.raster = binding, raster
        self.rejected_steps = 0
        self._random = torch.Generator().manual_seed(seed + 1)
        self._trained = [row for row, view in enumerate(views) if not view.heldout]

    def surfels(self, row: int) -> PosedSurfels:
        """The frozen geometry of one row (batch of one)."""
        only = torch.tensor([row])
        leaves = {name: value[only] for name, value in self.table.values.items()}
        with torch.no_grad():
            return pose_surfels(self.shape, self.binding, self.table.pose(self.shape.betas, leaves))

    def gather(
        self, light: Tensor, side: int, count: int, progress: Callable[[float], None] | None = None
    ) -> Evidence:
        """Blend-weighted averages over up to ``count`` frames spread over the clip.

        The gradient of ``sum(render * picture)`` with respect to the colours is, surfel by surfel, the sum
        of the picture under its blending weights: one backward pass gathers a whole frame.
        """
        picked = torch.linspace(0, len(self._trained) - 1, min(count, len(self._trained))).round().long()
        rows = [self._trained[int(place)] for place in picked.unique()]
        return self._gather(light, side, rows, progress)

    def colors_of(self, row: int) -> Tensor:
        """Of one row: colour times weight, and weight, of every surfel [N,4], under white light."""
        found = self._gather(white_light(), 640, [row], None)
        return torch.cat([found.albedo * found.hand.unsqueeze(-1), found.hand.unsqueeze(-1)], -1)

    def _gather(
        self, light: Tensor, side: int, rows: list[int], progress: Callable[[float], None] | None
    ) -> Evidence:
        size = self.binding.count
        hand, ignored, background = torch.zeros(size), torch.zeros(size), torch.zeros(size)
        numerator, denominator = torch.zeros(size, 3), torch.zeros(size, 3)
        opacities = torch.full((size,), START_OPACITY)
        for done, row in enumerate(rows):
            level, surfels = self.views[row].level(side), self.surfels(row)
            colors = torch.zeros(size, 3, requires_grad=True)
            out = draw(surfels.row(0), opacities, colors, level.camera, self.raster)
            cover, usable = level.hand.unsqueeze(-1), level.colored.unsqueeze(-1)
            (seen,) = torch.autograd.grad(out.rgb, colors, level.rgb * cover * usable, retain_graph=True)
            forearm = 1 - level.valid
            kinds = torch.stack([level.hand * level.colored, forearm, (1 - level.hand) * level.valid], -1)
            (weights,) = torch.autograd.grad(out.rgb, colors, kinds)
            shading = (irradiance_basis(surfels.attached.normals[0]) @ light).clamp_min(0.05)
            hand, ignored, background = (
                hand + weights[:, 0],
                ignored + weights[:, 1],
                background + weights[:, 2],
            )
            numerator += shading * seen
            denominator += shading.square() * weights[:, :1]
            if progress is not None:
                progress((done + 1) / len(rows))
        albedo = torch.where(denominator > 1e-3, numerator / denominator.clamp_min(1e-3), 0.0)
        return Evidence(hand, ignored, background, albedo)

    def run(
        self, appearance: Appearance, stage: AppearancePass, progress: Callable[[float], None] | None = None
    ) -> None:
        """One pass: Adam on colour, opacity and (when asked) the harmonics."""
        names = ["albedo", "opacity_logits", "light"]
        if stage.view_dependent and appearance.sh.shape[1] > 0:
            names.append("sh")
        parameters = {name: getattr(appearance, name).requires_grad_(True) for name in names}
        optimizer = torch.optim.Adam(
            [{"params": [value], "lr": APPEARANCE_RATES[name]} for name, value in parameters.items()],
            betas=(0.9, 0.98),
            eps=1e-15,
        )
        steps = max(1, round(stage.visits * len(self._trained)))
        queue: list[int] = []
        for step in range(steps):
            if not queue:
                order = torch.randperm(len(self._trained), generator=self._random)
                queue = [self._trained[int(place)] for place in order]
            row = queue.pop()
            decay = 0.05 ** (step / steps)
            for group, name in zip(optimizer.param_groups, names, strict=True):
                group["lr"] = APPEARANCE_RATES[name] * stage.rate * decay
            optimizer.zero_grad(set_to_none=True)
            loss = self._loss(appearance, stage, self.views[row].level(stage.side), row)
            loss.backward()
            if not all(bool(torch.isfinite(value.grad).all()) for value in parameters.values()):
                self.rejected_steps += 1
                continue
            optimizer.step()
            if progress is not None:
                progress((step + 1) / steps)
        for value in parameters.values():
            value.requires_grad_(False)

    def _loss(self, appearance: Appearance, stage: AppearancePass, level: Level, row: int) -> Tensor:
        background = torch.rand(3, generator=self._random)
        out = render_row(
            appearance, self.surfels(row), 0, self.binding.bones, level.camera, self.raster, background
        )
        area = level.hand.sum().clamp_min(16.0)
        cover = level.hand.unsqueeze(-1)
        target = level.rgb * cover + background * (1 - cover)
        loss = losses.photometric(out.rgb, target, level.colored, area)
        if stage.dssim > 0:
            inside = level.colored * (level.hand > 0)
            window = level.hand_window()
            structure = losses.dssim(out.rgb[window], target[window], inside[window])
            loss = (1 - stage.dssim) * loss + stage.dssim * 2 * structure
        return loss + 0.5 * losses.silhouette(out.alpha, level.hand, level.valid, area)


def fill_unseen(evidence: Evidence, binding: MeshBinding, least: float) -> Tensor:
    """Albedo [N,3] with surfels under ``least`` evidence coloured like the nearest seen faces.

    Colour spreads over the base mesh from face to face until every face has one.
    """
    faces = binding.surfel_faces
    count = int(binding.base_faces.shape[0])
    weight = torch.where(evidence.hand > least, evidence.hand, 0.0)
    total = torch.zeros(count).index_add(0, faces, weight)
    color = torch.zeros(count, 3).index_add(0, faces, evidence.albedo * weight.unsqueeze(-1))
    known = total > 0
    color = torch.where(known.unsqueeze(-1), color / total.clamp_min(1e-9).unsqueeze(-1), 0.0)
    pairs = _face_pairs(binding.base_faces)
    for _ in range(count):
        if bool(known.all()) or not bool(known.any()):
            break
        spread = torch.zeros(count).index_add(0, pairs[:, 0], known[pairs[:, 1]].float())
        summed = torch.zeros(count, 3).index_add(0, pairs[:, 0], color[pairs[:, 1]])
        grown = ~known & (spread > 0)
        if not bool(grown.any()):
            break
        color[grown] = summed[grown] / spread[grown].unsqueeze(-1)
        known = known | grown
    seen = (evidence.hand > least).unsqueeze(-1)
    return torch.where(seen, evidence.albedo, color[faces])


def _face_pairs(faces: Tensor) -> Tensor:
    """Ordered pairs [P,2] of faces that share an edge."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(dim=1).values
    owner = torch.arange(len(faces)).repeat(3)
    _, edge_id = torch.unique(edges, dim=0, return_inverse=True)
    order = edge_id.argsort(stable=True)
    same = edge_id[order][1:] == edge_id[order][:-1]
    left, right = owner[order][:-1][same], owner[order][1:][same]
    return torch.cat([torch.stack([left, right], 1), torch.stack([right, left], 1)])
