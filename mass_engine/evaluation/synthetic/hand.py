"""A hand that is not the fitted model: other proportions, other bending, wrinkles, nails, a ring, a forearm.

It is built from the built-in hand's mesh, but no shape parameters, displacement of at most a few millimetres
or linear blend of the model gives it: every bone has its own length and breadth, the skin follows the bones
with other weights, joints bulge less, and the surface is carved finer than the fitted mesh is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.fitting.subject import mesh_edges, vertex_normals
from mass_engine.hand.anatomy import FIRST_JOINT, SHAPE_NAMES, soft_tissue
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.field import nail_distance
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import JOINT_PARENTS, TIP_PARENTS, HandPose
from mass_engine.surfel.subdivision import Subdivision, loop_subdivision

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

#: What a pixel shows, as user masks say it: hand, ignored, background.
HAND, IGNORED, BACKGROUND = 255, 128, 0

#: Factors of the length and the breadth of the bone that begins at each joint (MANO's order).
_LENGTHS = (1.0, 1.13, 0.89, 1.06, 0.92, 1.11, 0.94, 0.86, 1.15, 0.9, 1.1, 0.93, 1.11, 1.0, 0.88, 1.17)
_BREADTHS = (1.0, 0.9, 0.95, 1.08, 1.0, 1.09, 0.92, 1.12, 1.0, 0.9, 0.9, 1.0, 1.1, 1.06, 0.9, 1.1)
_PALM = (0.97, 1.06, 1.05)
_BULGE = 0.6  # of the built-in hand's pose correctives
_LEVELS = 3
_WRINKLE, _PORE = 0.00028, 0.00012  # metres


@dataclass(frozen=True)
class Part:
    """A mesh of the scene: ``vertices`` [V,3], ``faces`` [F,3], ``albedo`` [V,3], ``gloss`` 0..1, and what
    its pixels are in the mask."""

    vertices: Array
    faces: Faces
    albedo: Array
    gloss: float
    label: int


@dataclass(frozen=True)
class OtherHand:
    """``model`` poses the coarse mesh, ``fine`` refines it, ``relief`` [V'] (metres) carves it."""

    model: HandModel
    fine: Subdivision
    relief: Tensor
    albedo: Array

    @staticmethod
    def make(seed: int = 0, wrinkles: bool = True) -> OtherHand:
        """The right hand of ``seed`` (its skin)."""
        random = np.random.default_rng(seed)
        base = load_builtin("right")
        fine = loop_subdivision(base.faces, len(base.template), _LEVELS)
        rest = fine.apply(base.template)
        normals = vertex_normals(rest, fine.faces)
        places, out = rest.double().numpy(), normals.double().numpy()
        nails = np.zeros(len(places))
        for part in soft_tissue(np.zeros(len(SHAPE_NAMES))):
            if part.group in FIRST_JOINT and part.nail is not None:
                nails = np.maximum(nails, np.clip(1 - nail_distance(places, part.nail) / 0.0006, 0, 1))
        folds = _folds(places, out, base.joint_template.double().numpy(), random)
        relief = _WRINKLE * folds + _PORE * _noise(places, 0.0035, random)
        relief = np.where(nails > 0, 0.0, relief) * (1.0 if wrinkles else 0.0)
        albedo = _skin(places, out, folds if wrinkles else 0 * folds, nails, random)
        return OtherHand(_reshaped(base), fine, torch.tensor(relief, dtype=torch.float32), albedo)

    def posed(self, pose: HandPose) -> tuple[Array, Array]:
        """Fine vertices [V',3] and the 21 points of one ``pose`` (a batch of one)."""
        with torch.no_grad():
            vertices, joints = self.model(pose)
            fine = self.fine.apply(vertices)[0]
            fine = fine + vertex_normals(fine, self.fine.faces) * self.relief.unsqueeze(-1)
        return fine.double().numpy(), joints[0].double().numpy()

    def part(self, vertices: Array) -> Part:
        """The skin."""
        return Part(vertices, self.fine.faces.numpy(), self.albedo, 0.25, HAND)

    def frames(self, pose: HandPose) -> tuple[Array, Array]:
        """Where the bones are: rotations [16,3,3] and joints [16,3]."""
        with torch.no_grad():
            points, turns = self.model.skeleton(pose)
        return turns[0].double().numpy(), points[0, :16].double().numpy()


def _reshaped(base: HandModel) -> HandModel:
    """Bones of other lengths, skin of other breadths, other weights, less bulge, no shape parameters."""
    old = base.joint_template.double().numpy()
    new = old.copy()
    palm = np.array(_PALM)
    ends = {joint: child for child, joint in enumerate(JOINT_PARENTS) if joint > 0}
    ends.update({parent: 16 + tip for tip, parent in enumerate(TIP_PARENTS)})
    for joint in range(1, 16):
        parent = JOINT_PARENTS[joint]
        step = old[joint] - old[parent]
        new[joint] = new[parent] + (step * palm if parent == 0 else step * _LENGTHS[parent])
    for tip, parent in enumerate(TIP_PARENTS):
        new[16 + tip] = new[parent] + (old[16 + tip] - old[parent]) * _LENGTHS[parent]
    places, weights = base.template.double().numpy(), base.weights.double().numpy()
    moved = np.zeros_like(places)
    for joint in range(16):
        arm = places - old[joint]
        if joint == 0:
            carried = arm * palm
        else:
            bone = old[ends[joint]] - old[joint]
            along = bone / np.linalg.norm(bone)
            part = (arm @ along)[:, None] * along
            carried = part * _LENGTHS[joint] + (arm - part) * _BREADTHS[joint]
        moved += weights[:, [joint]] * (new[joint] + carried)
    edges = mesh_edges(base.faces)
    soft = base.weights.clone()
    for _ in range(2):  # the skin slides over the joints
        total = torch.zeros_like(soft).index_add(0, edges[:, 0], soft[edges[:, 1]])
        total = total.index_add(0, edges[:, 1], soft[edges[:, 0]])
        soft = 0.6 * soft + 0.4 * total / total.sum(1, keepdim=True)
    assert base.pose_basis is not None
    return replace(
        base,
        template=torch.tensor(moved, dtype=torch.float32),
        joint_template=torch.tensor(new, dtype=torch.float32),
        weights=soft / soft.sum(1, keepdim=True),
        pose_basis=_BULGE * base.pose_basis,
        shape_basis=torch.zeros_like(base.shape_basis),
        joint_shape_basis=torch.zeros_like(base.joint_shape_basis),
    )


def _folds(places: Array, out: Array, points: Array, random: np.random.Generator) -> Array:
    """-1..1: creases across the backs of the knuckles and across the palm's side of the joints."""
    total = np.zeros(len(places))
    for joint in range(1, 16):
        arm = places - points[joint]
        end = points[joint] - points[JOINT_PARENTS[joint]]
        along = end / np.linalg.norm(end)
        distance = arm @ along
        near = np.exp(-0.5 * (distance / 0.0045) ** 2 - 0.5 * (np.linalg.norm(arm, axis=1) / 0.013) ** 2)
        total += near * np.cos(2 * np.pi * distance / random.uniform(0.0022, 0.0032) + random.uniform(0, 6))
    lines = np.exp(-0.5 * ((places[:, 0] + 0.062 + 0.25 * places[:, 2]) / 0.0009) ** 2)
    lines += np.exp(-0.5 * ((places[:, 0] + 0.045 - 0.5 * places[:, 2]) / 0.0009) ** 2)
    inner = (out[:, 1] < -0.3) & (places[:, 0] > -0.085) & (places[:, 0] < -0.02)
    return np.asarray(np.clip(total - lines * inner, -1.0, 1.0))


def _noise(places: Array, wavelength: float, random: np.random.Generator, waves: int = 8) -> Array:
    total = np.zeros(len(places))
    for _ in range(waves):
        direction = random.normal(size=3)
        direction *= 2 * np.pi / wavelength / np.linalg.norm(direction)
        total += np.sin(places @ direction + random.uniform(0, 2 * np.pi))
    return np.asarray(total / np.sqrt(waves / 2) / 2)


def _skin(places: Array, out: Array, folds: Array, nails: Array, random: np.random.Generator) -> Array:
    """Albedo [V,3]: skin with paler palm, redder knuckles, dark creases, freckles and veins; pale nails."""
    tone = 0.05 * _noise(places, 0.04, random) + 0.05 * _noise(places, 0.012, random)
    tone += 0.05 * _noise(places, 0.005, random)
    palm = np.clip(-out[:, 1], 0, 1)[:, None]
    base = np.array([0.72, 0.50, 0.39]) * (1 - palm) + np.array([0.84, 0.61, 0.52]) * palm
    albedo = base * (1 + tone[:, None] * np.array([0.8, 1.1, 1.3]))
    albedo *= 1 - 0.22 * np.clip(-folds, 0, 1)[:, None] * np.array([0.8, 1.0, 1.0])
    veins = np.clip(1 - np.abs(_noise(places * [1.0, 1.0, 2.0], 0.03, random, 3)) / 0.12, 0, 1)
    back = np.clip(out[:, 1], 0, 1) * (places[:, 0] > -0.09)
    albedo *= 1 - 0.10 * (veins * back)[:, None] * np.array([1.0, 0.6, 0.3])
    for _ in range(40):
        mole = places[random.integers(len(places))]
        near = np.exp(-0.5 * (np.linalg.norm(places - mole, axis=1) / random.uniform(0.0007, 0.0015)) ** 2)
        albedo *= 1 - random.uniform(0.2, 0.6) * near[:, None]
    plate = np.array([0.88, 0.68, 0.62])
    albedo = albedo * (1 - nails[:, None]) + plate * nails[:, None]
    return np.asarray(np.clip(albedo, 0.02, 1.0))


def tube(start: Array, end: Array, radii: tuple[float, float], rows: int = 24, around: int = 40) -> Part:
    """A closed, slightly mottled tube of skin from ``start`` to ``end``, metres."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    angles = 2 * np.pi * np.arange(around) / around
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * other
    share = np.linspace(0, 1, rows)
    radius = radii[0] + (radii[1] - radii[0]) * share
    vertices = (start + share[:, None] * (end - start))[:, None] + radius[:, None, None] * ring
    faces = _grid(rows, around, wrap_rows=False)
    places = vertices.reshape(-1, 3)
    shade = 1 + 0.06 * np.sin(places @ np.array([310.0, 170.0, 260.0]))
    albedo = np.array([0.72, 0.50, 0.39]) * shade[:, None]
    return Part(places, faces, albedo, 0.2, IGNORED)


def torus(middle: Array, axis: Array, radius: float, thick: float) -> Part:
    """A golden ring."""
    side = np.cross(axis, [0.3, 1.0, 0.2])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    u = 2 * np.pi * np.arange(48) / 48
    v = 2 * np.pi * np.arange(14) / 14
    radial = np.cos(u)[:, None] * side + np.sin(u)[:, None] * other
    centers = middle + radius * radial
    wide = 1.8 * thick
    vertices = (
        centers[:, None]
        + thick * np.cos(v)[None, :, None] * radial[:, None]
        + wide * np.sin(v)[None, :, None] * axis
    )
    albedo = np.tile([0.85, 0.62, 0.22], (48 * 14, 1))
    return Part(vertices.reshape(-1, 3), _grid(48, 14, wrap_rows=True), albedo, 1.0, IGNORED)


def _grid(rows: int, columns: int, wrap_rows: bool) -> Faces:
    """Triangles of a grid whose columns close; its rows too, if asked."""
    row, column = np.mgrid[0 : rows if wrap_rows else rows - 1, 0:columns]
    a = row * columns + column
    b = row * columns + (column + 1) % columns
    c = (row + 1) % rows * columns + column
    d = (row + 1) % rows * columns + (column + 1) % columns
    corners = np.stack([np.stack([a, b, c], -1), np.stack([b, d, c], -1)], -2)
    return corners.reshape(-1, 3).astype(np.int64)
