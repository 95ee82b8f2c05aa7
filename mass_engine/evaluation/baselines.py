"""Other representations on the same registered hand, to measure what ours is worth.

All begin with stage one of our own fit: the same poses, shape, personal surface and light. Then the geometry
is frozen and each representation learns the look from the same frames with the same losses, so a difference
is the representation's. They are of the class of published methods, not these methods themselves.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal, Protocol, get_args

import numpy as np
import scipy.sparse as sp
import torch
from scipy.sparse.linalg import cg
from torch import Tensor

from mass_engine.avatar import SourceFrames
from mass_engine.camera import Camera
from mass_engine.evaluation.mesh_raster import mesh_mask, rasterize_mesh
from mass_engine.evaluation.outlines import iou
from mass_engine.evaluation.registrations import Registrations
from mass_engine.evaluation.scores import Renderable
from mass_engine.evaluation.splats import BoundSplats, SplatKind, steps_of, train_splats
from mass_engine.fitting.evidence import spread
from mass_engine.fitting.exposure import without
from mass_engine.fitting.schedule import Schedule
from mass_engine.fitting.subject import Shape, mesh_edges, vertex_normals
from mass_engine.fitting.trainer import REGISTERED
from mass_engine.fitting.views import Level, View
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RenderOutput
from mass_engine.surfel.shading import irradiance_basis
from mass_engine.surfel.subdivision import Subdivision, loop_subdivision
from mass_engine.threads import one_thread

BaselineName = Literal["mesh", "surfels-random", "surfels-vertices", "gaussians-3d"]
BASELINES: tuple[BaselineName, ...] = get_args(BaselineName)

#: What each is, for tables.
DESCRIPTIONS: dict[BaselineName, str] = {
    "mesh": "mesh with vertex displacements and a colour at every vertex of the surface refined three times "
    "(HARP's class, without its normal map and its shadows)",
    "surfels-random": "surfels bound to the mesh from random places, turns and sizes",
    "surfels-vertices": "one surfel at every vertex of the refined mesh, along its surface",
    "gaussians-3d": "3-D Gaussians bound to the mesh's faces, projected as 3DGS projects them",
}


class Baseline(Renderable, Protocol):
    """Something to score, with a size."""

    @property
    def size_bytes(self) -> int:
        """What its numbers take in float32, the hand model apart."""
        ...


@dataclass(frozen=True)
class Registered:
    """The hand after stage one: ``frames`` hold every view's pose, ``seconds`` is what it took."""

    views: list[View]
    shape: Shape
    light: Tensor
    camera: Camera
    frames: SourceFrames
    seconds: float

    @property
    def trained(self) -> list[int]:
        """Rows that may be learnt from."""
        return [row for row, view in enumerate(self.views) if not view.heldout]

    def level(self, row: int, side: int) -> Level:
        """One row's pixels, without the frame's gain."""
        return without(self.views[row].level(side), self.frames.gains[row])

    def pose(self, row: int) -> HandPose:
        """One row's pose (a batch of one)."""
        return self.frames.pose_of(self.views[row].index)


def register(registrations: Registrations, schedule: Schedule) -> Registered:
    """Stage one alone (and the poses of held-out frames)."""
    levels, depth = REGISTERED  # no settling under other surfels; and nobody asks what these ones look like
    bare = replace(
        schedule, levels=levels, depth=depth, harmonics=0, detached=False, deforming=(), appearance=(),
        adaptive=False, gather_frames=4, gather_side=160,
    )  # fmt: skip
    result, seconds = registrations.fit(bare)
    avatar = result.avatar
    return Registered(
        result.views,
        avatar.shape,
        avatar.appearance.light,
        registrations.clip.camera,
        avatar.frames,
        seconds,
    )


def fit_baseline(name: BaselineName, hand: Registered, seed: int, effort: float = 1.0) -> Baseline:
    """Learn one representation; ``effort`` scales how often every frame is seen (the mesh: how many are)."""
    if name == "mesh":
        return fit_mesh(hand, effort)
    kinds: dict[str, SplatKind] = {
        "surfels-random": "random",
        "surfels-vertices": "vertices",
        "gaussians-3d": "gaussians",
    }
    with one_thread():  # sums over threads run in any order: the same seed would give another look
        model = BoundSplats.make(kinds[name], hand.shape, hand.light, hand.camera, seed)
        train_splats(model, hand.level, hand.trained, hand.pose, seed, effort)
    return model


@dataclass
class TexturedMesh:
    """``albedo`` [V',3] on the vertices of the refined mesh, under ``light`` [9,3]; the surface stands
    ``swell`` metres over the registered one. Pictures of at most 256 pixels, in which such triangles would
    be a fraction of a pixel, are drawn from ``rough``, the surface refined once, whose vertices are the first
    of ``fine``'s: pose refinement draws thousands."""

    shape: Shape
    fine: Subdivision
    rough: Subdivision
    albedo: Tensor
    light: Tensor
    camera: Camera
    finer: int = 2  # sub-pixels along a side
    swell: float = 0.0

    @property
    def size_bytes(self) -> int:
        """Colours, displacements, light."""
        return 4 * (self.albedo.numel() + self.shape.displacement.numel() + self.light.numel())

    def vertices(self, pose: HandPose) -> Tensor:
        """Refined vertices [V',3] of a pose (a batch of one)."""
        return self._surface(pose, self.fine)

    def _surface(self, pose: HandPose, subdivision: Subdivision) -> Tensor:
        with torch.no_grad():
            mesh = subdivision.apply(self.shape.model.posed(pose, self.shape.displacement).vertices)[0]
            return mesh + self.swell * vertex_normals(mesh, subdivision.faces)

    def render_pose(self, pose: HandPose, camera: Camera) -> RenderOutput:
        """Over black, anti-aliased by sub-pixels."""
        small = max(camera.width, camera.height) <= 256
        surface, k = (self.rough, 1) if small else (self.fine, self.finer)
        mesh = self._surface(pose, surface)
        faces = surface.faces.numpy()
        shading = irradiance_basis(vertex_normals(mesh, surface.faces)) @ self.light
        colors = (self.albedo[: len(mesh)] * shading.clamp_min(0)).double().numpy()
        sharp = camera.resized(camera.width * k, camera.height * k)
        found = rasterize_mesh(mesh.double().numpy(), faces, sharp, cull=True)
        hit = (found.face >= 0)[..., None]
        planes = np.concatenate([found.interpolate(faces, colors), hit, found.depth[..., None]], -1)
        mean = planes.reshape(camera.height, k, camera.width, k, 5).mean((1, 3))
        image = torch.from_numpy(mean.astype(np.float32))
        alpha = image[..., 3]
        depth = torch.where(alpha > 0, image[..., 4] / alpha.clamp_min(1e-6), 0.0)
        return RenderOutput(image[..., :3], alpha, depth, 0)


def fit_mesh(
    hand: Registered, effort: float = 1.0, levels: int = 3, side: int = 640, smooth: float = 0.3
) -> TexturedMesh:
    """The least-squares texture over all training frames; with less ``effort`` over an even choice of them.

    More effort than 1 is 1: the same equations twice have the same solution.
    A pixel's colour is linear in the colours of its face's corners, so the best ones solve one sparse system;
    ``smooth`` (in pixels of evidence) ties neighbours where few pixels are seen.
    """
    model = hand.shape.model
    fine = loop_subdivision(model.faces, len(model.template), levels)
    rough = loop_subdivision(model.faces, len(model.template), 1)
    mesh = TexturedMesh(hand.shape, fine, rough, torch.zeros(fine.n_vertices, 3), hand.light, hand.camera)
    mesh.swell = _best_swell(mesh, hand)
    faces, count = fine.faces.numpy(), fine.n_vertices
    edges = mesh_edges(fine.faces).numpy()
    matrices: list[sp.csr_array] = []
    sides = np.zeros((3, count))
    for channel in range(3):
        ones = np.full(len(edges), smooth)
        off = sp.csr_array((ones, (edges[:, 0], edges[:, 1])), shape=(count, count))
        off = sp.csr_array(off + off.T)
        matrices.append(sp.csr_array(sp.diags_array(off.sum(1)) - off))
        sides[channel] = 0
    for row in spread(hand.trained, steps_of(1.0, len(hand.trained), effort)):
        level = hand.level(row, side)
        vertices = mesh.vertices(hand.pose(row))
        shading = irradiance_basis(vertex_normals(vertices, fine.faces)) @ hand.light
        found = rasterize_mesh(vertices.double().numpy(), faces, level.camera, cull=True)
        usable = (found.face >= 0) & (level.hand.numpy() > 0.95) & (level.colored.numpy() > 0.95)
        corners = faces[found.face[usable]]
        pixel = np.repeat(np.arange(len(corners)), 3)
        for channel in range(3):
            shade = shading[:, channel].clamp_min(0.05).double().numpy()
            weights = (found.weights[usable] * shade[corners]).ravel()
            rows = sp.csr_array((weights, (pixel, corners.ravel())), shape=(len(corners), count))
            matrices[channel] = sp.csr_array(matrices[channel] + rows.T @ rows)
            sides[channel] += rows.T @ level.rgb.numpy()[usable][:, channel].astype(np.float64)
    columns = []
    for channel in range(3):
        system = sp.csr_array(matrices[channel] + 1e-6 * sp.eye_array(count))
        precondition = sp.diags_array(1 / system.diagonal())
        start = np.full(count, 0.5)
        solved, _ = cg(system, sides[channel], x0=start, rtol=1e-4, maxiter=400, M=precondition)
        columns.append(np.clip(solved, 0, 2))
    mesh.albedo = torch.tensor(np.stack(columns, -1), dtype=torch.float32)
    return mesh


def _best_swell(mesh: TexturedMesh, hand: Registered) -> float:
    """The registered surface is one that surfels, which reach over it, cover the mask from: a mesh must
    stand where they end. The offset with the best silhouettes of a few training frames."""
    rows = [hand.trained[int(place)] for place in np.linspace(0, len(hand.trained) - 1, 4).round()]
    choices = [0.0005 * step for step in range(-2, 6)]
    found = []
    for swell in choices:
        moved = replace(mesh, swell=swell)
        overlaps = []
        for row in rows:
            level = hand.views[row].level(320)
            drawn = mesh_mask(
                moved._surface(hand.pose(row), mesh.rough).double().numpy(),
                mesh.rough.faces.numpy(),
                level.camera,
            )
            overlaps.append(iou(torch.from_numpy(drawn), level.hand > 0.5, level.valid > 0.5))
        found.append(float(np.mean(overlaps)))
    return choices[int(np.argmax(found))]


def frames_per_second(subject: Renderable, pose: HandPose, camera: Camera, seconds: float = 0.5) -> float:
    """Renders a second of one pose through ``camera``, by the median of as many as fit into ``seconds``."""
    subject.render_pose(pose, camera)
    spent: list[float] = []
    while len(spent) < 3 or (sum(spent) < seconds and len(spent) < 200):
        start = time.perf_counter()
        subject.render_pose(pose, camera)
        spent.append(time.perf_counter() - start)
    return 1 / max(float(np.median(spent)), 1e-9)
