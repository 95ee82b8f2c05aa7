"""Splats bound to the faces of a posed mesh, each free to move: the baselines' surfels and 3-D Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting import losses
from mass_engine.fitting.subject import START_OPACITY, Shape, mesh_edges
from mass_engine.fitting.views import Level
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions, RenderOutput, rasterize
from mass_engine.surfel.inellipse import quat_to_matrix
from mass_engine.surfel.shading import shade
from mass_engine.surfel.subdivision import Subdivision, loop_subdivision

SplatKind = Literal["random", "vertices", "gaussians"]

#: Splats from random places: about as many as the others have.
_RANDOM_COUNT = 12_000
#: How far from the surface they may begin, and how large, metres.
_SHELL, _RANDOM_SCALE = 0.006, 0.002
#: What 3DGS adds to every projected variance, pixels squared.
_DILATION = 0.3
#: Learning rates: metres, quaternions, logarithms, logits, colour.
_RATES = {"offsets": 1e-4, "quats": 0.01, "log_scales": 0.01, "opacity_logits": 0.03, "albedo": 0.02}
#: (longer side in pixels, visits of every frame), and the least steps of each: few frames are no excuse.
_PASSES = ((160, 5.0), (320, 5.0), (640, 3.0))
_LEAST_STEPS = 120


@dataclass
class BoundSplats:
    """N splats: ``faces`` [N] of the refined mesh they move with; in the face's frame ``offsets`` [N,3]
    (metres) and ``quats`` [N,4]; ``log_scales`` [N,2] (surfels) or [N,3] (Gaussians)."""

    kind: SplatKind
    shape: Shape
    fine: Subdivision
    faces: Tensor
    offsets: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    albedo: Tensor
    light: Tensor
    camera: Camera

    @staticmethod
    def make(kind: SplatKind, shape: Shape, light: Tensor, camera: Camera, seed: int) -> BoundSplats:
        """Splats before training, grey, on the mesh refined once."""
        random = torch.Generator().manual_seed(seed)
        model = shape.model
        fine = loop_subdivision(model.faces, len(model.template), 1)
        rest = fine.apply(model.template + shape.displacement)
        corners = rest[fine.faces]
        edges = mesh_edges(fine.faces)
        length = float((rest[edges[:, 0]] - rest[edges[:, 1]]).norm(dim=-1).mean())
        turns, centers = face_frames(rest, fine.faces)
        if kind == "random":
            area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(
                dim=-1
            )
            faces = torch.multinomial(area, _RANDOM_COUNT, replacement=True, generator=random)
            weights = torch.rand(_RANDOM_COUNT, 3, generator=random).log().neg()
            weights = weights / weights.sum(-1, keepdim=True)
            places = (corners[faces] * weights.unsqueeze(-1)).sum(1)
            local = ((places - centers[faces]).unsqueeze(1) @ turns[faces])[:, 0]
            local[:, 2] += (2 * torch.rand(_RANDOM_COUNT, generator=random) - 1) * _SHELL
            quats = torch.randn(_RANDOM_COUNT, 4, generator=random)
            scales = torch.full((_RANDOM_COUNT, 2), _RANDOM_SCALE)
        elif kind == "vertices":
            faces = torch.zeros(fine.n_vertices, dtype=torch.long)
            owner = torch.arange(len(fine.faces))
            for corner in range(3):
                faces[fine.faces[:, corner]] = owner
            local = ((rest - centers[faces]).unsqueeze(1) @ turns[faces])[:, 0]
            quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(faces), 1)
            scales = torch.full((len(faces), 2), 0.5 * length)
        else:
            faces = torch.arange(len(fine.faces))
            local = torch.zeros(len(faces), 3)
            quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(faces), 1)
            scales = torch.tensor([0.4, 0.4, 0.1]).repeat(len(faces), 1) * length
        count = len(faces)
        opacity = 0.5 if kind == "random" else START_OPACITY
        logit = float(torch.logit(torch.tensor(opacity)))
        return BoundSplats(
            kind, shape, fine, faces, local, quats, scales.log(), torch.full((count,), logit),
            torch.full((count, 3), 0.5), light.clone(), camera,
        )  # fmt: skip

    @property
    def size_bytes(self) -> int:
        """Every splat's numbers and its face."""
        parts = (*self.parameters().values(), self.faces)
        return 4 * sum(part.numel() for part in parts)

    def parameters(self) -> dict[str, Tensor]:
        """What is learnt, by name."""
        return {name: getattr(self, name) for name in _RATES}

    def render_pose(self, pose: HandPose, camera: Camera) -> RenderOutput:
        """One pose (a batch of one) over black."""
        with torch.no_grad():
            return self.draw(self.vertices(pose), camera, None)

    def vertices(self, pose: HandPose) -> Tensor:
        """Refined vertices [V',3]."""
        with torch.no_grad():
            return self.fine.apply(self.shape.model.posed(pose, self.shape.displacement).vertices)[0]

    def draw(self, vertices: Tensor, camera: Camera, background: Tensor | None) -> RenderOutput:
        """Differentiable in the parameters."""
        turns, centers = face_frames(vertices, self.fine.faces)
        turn = turns[self.faces]
        means = centers[self.faces] + (turn @ self.offsets.unsqueeze(-1)).squeeze(-1)
        quats = torch.nn.functional.normalize(self.quats, dim=-1)
        axes = turn @ quat_to_matrix(quats)
        scaled = axes[..., : self.log_scales.shape[1]] * self.log_scales.exp().unsqueeze(-2)
        tangents = scaled.mT if self.kind != "gaussians" else projected_tangents(means, scaled, camera)
        return rasterize(
            means,
            tangents,
            torch.sigmoid(self.opacity_logits),
            shade(self.albedo, self.light, turn[..., 2]).clamp_min(0),
            camera,
            background=background,
            options=RasterOptions(cull_backfaces=self.kind == "vertices"),
        )


def face_frames(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations [F,3,3], columns along an edge, across it and outward, and centroids [F,3]."""
    corners = vertices[faces]
    a, b, c = corners.unbind(1)
    along = torch.nn.functional.normalize(b - a, dim=-1)
    outward = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    return torch.stack([along, torch.linalg.cross(outward, along), outward], -1), corners.mean(1)


def projected_tangents(means: Tensor, axes: Tensor, camera: Camera) -> Tensor:
    """A disc [N,2,3] that the surfel rasteriser draws as 3DGS draws a Gaussian.

    ``axes`` [N,3,3] (columns: axis times standard deviation). The projection is 3DGS's: the Jacobian of the
    perspective at the centre (Zwicker et al. 2001) and 0.3 pixels squared more. A disc parallel to the
    picture at the centre's depth is projected by a plain scale: its footprint is that very ellipse.
    """
    rotation = camera.world_to_camera[:3, :3]
    at = means @ rotation.T + camera.world_to_camera[:3, 3]
    z = at[:, 2:].clamp_min(1e-3)
    # Rows: the axes in the camera, then how the pixel moves along each.
    turned = (axes.mT.reshape(-1, 3) @ rotation.T).view(-1, 3, 3)
    ray = (at[:, :2] / z).unsqueeze(1)
    moved = (turned[..., :2] - turned[..., 2:] * ray) / z.unsqueeze(1)
    flat = (moved.reshape(-1, 2) @ camera.K[:2, :2].T).view(-1, 3, 2)
    u, v = flat.unbind(-1)
    xx, xy, yy = u.square().sum(-1) + _DILATION, (u * v).sum(-1), v.square().sum(-1) + _DILATION
    first = xx.sqrt()
    second = xy / first
    third = (yy - second.square()).clamp_min(1e-6).sqrt()
    pixels = torch.stack(
        [torch.stack([first, second], -1), torch.stack([torch.zeros_like(third), third], -1)], 1
    )
    inverse = torch.linalg.inv(camera.K[:2, :2]).T
    in_plane = (pixels.reshape(-1, 2) @ inverse).view(-1, 2, 2) * z.unsqueeze(1)
    disc = torch.cat([in_plane, torch.zeros_like(in_plane[..., :1])], -1)
    return (disc.reshape(-1, 3) @ rotation).view(-1, 2, 3)


def steps_of(visits: float, frames: int, effort: float) -> int:
    """Steps of a pass of so many ``visits`` a frame, scaled by ``effort``; few frames are seen more often."""
    return max(1, round(effort * max(visits * frames, _LEAST_STEPS)))


def train_splats(
    model: BoundSplats,
    level_of: Callable[[int, int], Level],
    trained: list[int],
    pose_of: Callable[[int], HandPose],
    seed: int,
    effort: float = 1.0,
) -> None:
    """Adam on every parameter, coarse to fine, with the losses of our own stage two.

    ``level_of`` gives the pixels of a row at a side, ``pose_of`` its pose.
    """
    random = torch.Generator().manual_seed(seed + 2)
    posed = {row: model.vertices(pose_of(row)) for row in trained}
    parameters = {name: value.requires_grad_(True) for name, value in model.parameters().items()}
    optimizer = torch.optim.Adam(
        [{"params": [value], "lr": _RATES[name]} for name, value in parameters.items()],
        betas=(0.9, 0.98),
        eps=1e-15,
    )
    plan = [side for side, visits in _PASSES for _ in range(steps_of(visits, len(trained), effort))]
    queue: list[int] = []
    for step, side in enumerate(plan):
        if not queue:
            queue = [trained[int(place)] for place in torch.randperm(len(trained), generator=random)]
        row = queue.pop()
        for group, name in zip(optimizer.param_groups, parameters, strict=True):
            group["lr"] = _RATES[name] * 0.05 ** (step / len(plan))
        optimizer.zero_grad(set_to_none=True)
        loss = _loss(model, level_of(row, side), posed[row], random)
        loss.backward()
        if all(value.grad is None or bool(value.grad.isfinite().all()) for value in parameters.values()):
            optimizer.step()
    for value in parameters.values():
        value.requires_grad_(False)


def _loss(model: BoundSplats, level: Level, vertices: Tensor, random: torch.Generator) -> Tensor:
    background = torch.rand(3, generator=random)
    out = model.draw(vertices, level.camera, background)
    area = level.hand.sum().clamp_min(16.0)
    cover = level.hand.unsqueeze(-1)
    target = level.rgb * cover + background * (1 - cover)
    loss = losses.photometric(out.rgb, target, level.colored, area)
    window = level.hand_window()
    inside = (level.colored * (level.hand > 0))[window]
    structure = losses.dssim(out.rgb[window], target[window], inside)
    return 0.8 * loss + 0.4 * structure + 0.5 * losses.silhouette(out.alpha, level.hand, level.valid, area)
