"""MeshBinding: the fixed, linear map from a posed hand mesh to its attached surfels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mass_engine.hand.model import HandModel
from mass_engine.surfel.densify import fractal_corners
from mass_engine.surfel.inellipse import (
    CONJUGATE,
    SIGMA_PER_SEMI_AXIS,
    principal_scales_quats,
    safe_norm,
)
from mass_engine.surfel.subdivision import Subdivision, loop_subdivision

#: A face's one surfel, this much larger than its inellipse, leaves no gaps at the corners: two neighbours
#: cover an edge's midpoint to 0.97, six a corner to 0.99.
WIDENED = 1.5


@dataclass(frozen=True)
class AttachedSurfels:
    """Surfels [...,N] of posed meshes: ``means`` [...,N,3], ``tangents`` [...,N,2,3], ``normals`` [...,N,3].

    The disk's points are mean + u tangent_0 + v tangent_1 with weight exp(-(u^2 + v^2) / 2); normals face
    outward.
    """

    means: Tensor
    tangents: Tensor
    normals: Tensor

    def part(self, rows: slice) -> AttachedSurfels:
        """Some of them."""
        return AttachedSurfels(
            self.means[..., rows, :], self.tangents[..., rows, :, :], self.normals[..., rows, :]
        )

    def then(self, others: AttachedSurfels) -> AttachedSurfels:
        """These, and after them the others."""
        return AttachedSurfels(
            torch.cat([self.means, others.means], -2),
            torch.cat([self.tangents, others.tangents], -3),
            torch.cat([self.normals, others.normals], -2),
        )

    def scales_quats(self) -> tuple[Tensor, Tensor]:
        """Standard deviations [...,N,2] along the principal axes and their rotation, quats [...,N,4] wxyz."""
        return principal_scales_quats(self.tangents[..., 0, :], self.tangents[..., 1, :])


@dataclass(frozen=True)
class MeshBinding:
    """Built once for a hand model, ``levels`` of Loop subdivision and a fractal ``depth``.

    Surfel n belongs to face ``surfel_faces[n]`` of the base mesh (``base_faces`` [F,3]) and moves mostly with
    bone ``bones[n]``. Surfels of one refined face are neighbours: n = face * per_face + place. Place 0 is the
    inellipse of the whole face. With ``widened`` the last place is that one WIDENED times as large, to stand
    for all of the face's surfels.
    """

    levels: int
    depth: int
    base_faces: Tensor
    subdivision: Subdivision
    per_face: int
    surfel_faces: Tensor
    bones: Tensor
    widened: bool
    _parts: Tensor  # [9,9 K]: a face's corners (flat) to mean and tangents of each of its small triangles

    @staticmethod
    def build(model: HandModel, levels: int, depth: int, widened: bool = False) -> MeshBinding:
        """Precompute everything that does not depend on the pose."""
        subdivision = loop_subdivision(model.faces, len(model.template), levels)
        corners = fractal_corners(depth)
        conjugate = torch.tensor(CONJUGATE)
        conjugate[1:] *= SIGMA_PER_SEMI_AXIS
        # Tangent order (Q, P): their cross product is the outward normal.
        places = conjugate[[0, 2, 1]] @ corners
        if widened:
            wide = places[:1] * torch.tensor([1.0, WIDENED, WIDENED])[:, None]
            places = torch.cat([places, wide])
        rows = places.reshape(-1, 3)
        parts = torch.kron(rows.T.contiguous(), torch.eye(3))
        weights = subdivision.apply(model.weights)
        bones = weights[subdivision.faces].mean(1).argmax(-1)
        count = len(places)
        return MeshBinding(
            levels,
            depth,
            model.faces,
            subdivision,
            count,
            subdivision.face_parent.repeat_interleave(count),
            bones.repeat_interleave(count),
            widened,
            parts,
        )

    def to(self, device: torch.device | str) -> MeshBinding:
        """The same elsewhere."""
        if self.bones.device == torch.device(device):
            return self
        return replace(
            self,
            base_faces=self.base_faces.to(device),
            subdivision=self.subdivision.to(device),
            surfel_faces=self.surfel_faces.to(device),
            bones=self.bones.to(device),
            _parts=self._parts.to(device),
        )

    @property
    def count(self) -> int:
        """Number of surfels."""
        return len(self.surfel_faces)

    @property
    def places(self) -> Tensor:
        """[K,3,3]: mean and tangents of a face's K small triangles, as combinations of its corners."""
        return self._parts[::3, ::3].T.reshape(self.per_face, 3, 3)

    def surfels(self, vertices: Tensor) -> AttachedSurfels:
        """Attached surfels of posed base-mesh vertices [...,V,3]; differentiable."""
        return self.register(self.subdivision.apply(vertices))

    def register(self, refined: Tensor) -> AttachedSurfels:
        """Attached surfels of the refined mesh's vertices [...,V',3]; differentiable."""
        lead = refined.shape[:-2]
        corners = refined.index_select(-2, self.subdivision.faces.flatten())
        # One product for all: [faces, 9 numbers] times the fixed map, whose output is in surfel order.
        both = (corners.reshape(*lead, -1, 9) @ self._parts).reshape(*lead, self.count, 3, 3)
        a, b, c = corners.reshape(*lead, -1, 3, 3).unbind(-2)
        normals = torch.linalg.cross(b - a, c - a)
        normals = normals / safe_norm(normals).unsqueeze(-1)
        # The small triangles of a face lie in its plane.
        normals = normals.unsqueeze(-2).expand(*lead, -1, self.per_face, 3).reshape(*lead, self.count, 3)
        return AttachedSurfels(both[..., 0, :], both[..., 1:, :], normals)
