"""What the frames say of every surfel's colour, gathered under the blending weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mass_engine.fitting.exposure import between, without
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.registration import overlap
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import START_OPACITY, Appearance, PosedSurfels, Shape, draw, render_row
from mass_engine.fitting.views import Level, View
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import irradiance_basis, white_light


@dataclass
class Scene:
    """The frames with their poses and one shape, as stage one left them.

    ``gains`` [F,3] multiply the colours of each frame (exposure and white balance). ``compute`` is where
    passes over the frames run; their results come back to where the scene is.
    """

    views: list[View]
    table: PoseTable
    shape: Shape
    raster: RasterOptions
    gains: Tensor
    validation: list[int] = field(default_factory=list)
    compute: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def device(self) -> torch.device:
        """Where the scene is."""
        return self.gains.device

    def to(self, device: torch.device | str) -> Scene:
        """The same scene elsewhere, as it is now (itself if it is there)."""
        if self.device == torch.device(device):
            return self
        return Scene(
            self.views,
            self.table.to(device),
            self.shape.to(device),
            self.raster,
            self.gains.to(device),
            self.validation,
            self.compute,
        )

    def at_work(self) -> Scene:
        """The scene where passes over it run (itself on a CPU)."""
        return self.to(self.compute)

    def level(self, row: int, side: int) -> Level:
        """The pixels of one row where the scene is."""
        level = self.views[row].level(side)
        return level if self.device.type == "cpu" else level.to(self.device)

    @property
    def trained(self) -> list[int]:
        """Rows that are neither held out nor kept for validation."""
        kept = set(self.validation)
        return [row for row, view in enumerate(self.views) if not view.heldout and row not in kept]

    def surfels(self, skin: Skin, row: int) -> PosedSurfels:
        """One row's surfels (a batch of one)."""
        leaves = {name: value[row : row + 1] for name, value in self.table.values.items()}
        return skin.pose(self.shape, self.table.pose(self.shape.betas, leaves))

    def overlaps(self, skin: Skin, appearance: Appearance, rows: Sequence[int], side: int = 160) -> Tensor:
        """How well the silhouettes of rows overlap as they stand [B], in pictures of ``side`` pixels."""
        covered = []
        for row in rows:
            level = self.views[row].level(side)
            with torch.no_grad():
                surfels = self.surfels(skin, row)
                out = render_row(appearance, surfels, 0, skin.bones, level.camera, self.raster)
            covered.append(overlap(level, out.alpha))
        return torch.tensor(covered)


@dataclass(frozen=True)
class Evidence:
    """What the video says of each surfel, as summed blending weights [N] on hand, ignored and background
    pixels, and its least-squares albedo [N,3] (zero where it was never seen as hand)."""

    hand: Tensor
    ignored: Tensor
    background: Tensor
    albedo: Tensor

    def to(self, device: torch.device | str) -> Evidence:
        """The same elsewhere."""
        return Evidence(*(v.to(device) for v in (self.hand, self.ignored, self.background, self.albedo)))


def spread(rows: Sequence[int], count: int) -> list[int]:
    """Up to ``count`` of the rows, evenly."""
    picked = torch.linspace(0, len(rows) - 1, min(count, len(rows))).round().long()
    return [rows[int(place)] for place in picked.unique()]


def gather(
    scene: Scene,
    skin: Skin,
    light: Tensor,
    side: int,
    rows: Sequence[int],
    progress: Callable[[float], None] | None = None,
) -> Evidence:
    """Blend-weighted averages over ``rows``.

    The gradient of ``sum(render * picture)`` with respect to the colours is, surfel by surfel, the sum
    of the picture under its blending weights: one backward pass gathers a whole frame.
    """
    home, scene = scene.device, scene.at_work()
    size, device = skin.count, scene.device
    skin, light = skin.to(device), light.to(device)
    hand, ignored, background = (torch.zeros(size, device=device) for _ in range(3))
    numerator, denominator = torch.zeros(size, 3, device=device), torch.zeros(size, 3, device=device)
    opacities = torch.full((size,), START_OPACITY, device=device)
    for done, row in enumerate(rows):
        with torch.no_grad():
            level, surfels = without(scene.level(row, side), scene.gains[row]), scene.surfels(skin, row)
        colors = torch.zeros(size, 3, device=device, requires_grad=True)
        out = draw(surfels.row(0), opacities, colors, level.camera, scene.raster)
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
    return Evidence(hand, ignored, background, albedo).to(home)


def colors_of(scene: Scene, skin: Skin, row: int) -> Tensor:
    """Of one row: colour times weight, and weight, of every surfel [N,4], under white light."""
    found = gather(scene, skin, white_light(), 640, [row])
    return torch.cat([found.albedo * found.hand.unsqueeze(-1), found.hand.unsqueeze(-1)], -1)


def frame_gains(scene: Scene, skin: Skin, appearance: Appearance, side: int) -> Tensor:
    """Gains [F,3], beside the scene's, by which each frame's hand is brighter than the rendered one.

    Their geometric mean is 1. Held-out rows lie between their neighbours in time: their own colours are not
    looked at.
    """
    known = [row for row, view in enumerate(scene.views) if not view.heldout]
    home, scene = scene.device, scene.at_work()
    skin, appearance = skin.to(scene.device), appearance.to(scene.device)
    logs = torch.zeros(len(scene.views), 3, device=scene.device)
    for row in known:
        with torch.no_grad():
            level = without(scene.level(row, side), scene.gains[row])
            out = render_row(appearance, scene.surfels(skin, row), 0, skin.bones, level.camera, scene.raster)
        inner = (level.hand * level.colored * (out.alpha > 0.95)).unsqueeze(-1)
        top, bottom = (inner * level.rgb * out.rgb).sum((0, 1)), (inner * out.rgb.square()).sum((0, 1))
        hold = 0.02 * bottom.mean() + 1e-6
        logs[row] = ((top + hold) / (bottom + hold)).log()
    return between(logs[known] - logs[known].mean(0), scene.views, known).exp().to(home)


def fill_unseen(evidence: Evidence, skin: Skin, least: float) -> Tensor:
    """Albedo [N,3] with surfels under ``least`` evidence coloured like the nearest seen faces.

    Colour spreads over the base mesh from face to face until every face has one.
    """
    faces, binding = skin.faces, skin.binding
    count = int(binding.base_faces.shape[0])
    weight = torch.where(evidence.hand > least, evidence.hand, 0.0)
    total = torch.zeros(count).index_add(0, faces, weight)
    color = torch.zeros(count, 3).index_add(0, faces, evidence.albedo * weight.unsqueeze(-1))
    known = total > 0
    color = torch.where(known.unsqueeze(-1), color / total.clamp_min(1e-9).unsqueeze(-1), 0.0)
    pairs = _face_pairs(binding)
    for _ in range(count):
        if bool(known.all()) or not bool(known.any()):
            break
        reach = torch.zeros(count).index_add(0, pairs[:, 0], known[pairs[:, 1]].float())
        summed = torch.zeros(count, 3).index_add(0, pairs[:, 0], color[pairs[:, 1]])
        grown = ~known & (reach > 0)
        if not bool(grown.any()):
            break
        color[grown] = summed[grown] / reach[grown].unsqueeze(-1)
        known = known | grown
    seen = (evidence.hand > least).unsqueeze(-1)
    return torch.where(seen, evidence.albedo, color[faces])


def _face_pairs(binding: MeshBinding) -> Tensor:
    """Ordered pairs [P,2] of base faces that share an edge."""
    faces = binding.base_faces
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(dim=1).values
    owner = torch.arange(len(faces)).repeat(3)
    _, edge_id = torch.unique(edges, dim=0, return_inverse=True)
    order = edge_id.argsort(stable=True)
    same = edge_id[order][1:] == edge_id[order][:-1]
    left, right = owner[order][:-1][same], owner[order][1:][same]
    return torch.cat([torch.stack([left, right], 1), torch.stack([right, left], 1)])
