"""Loop subdivision (Loop 1987) as one fixed sparse matrix, so that re-posing a mesh costs one product."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.surfel.fixed_product import fixed_product, to_torch_csr


@dataclass(frozen=True)
class Subdivision:
    """``faces`` [F',3] of the refined mesh and ``face_parent`` [F'], the original face each came from."""

    faces: Tensor
    face_parent: Tensor
    n_vertices: int
    _matrix: Tensor | None
    _transpose: Tensor | None

    def apply(self, vertices: Tensor) -> Tensor:
        """Vertex positions (or other values) [...,V,C] of the base mesh -> [...,V',C]; differentiable."""
        if self._matrix is None or self._transpose is None:
            return vertices
        lead, (count, channels) = vertices.shape[:-2], vertices.shape[-2:]
        # One product for the whole batch: columns are (batch, channel).
        columns = vertices.reshape(-1, count, channels).movedim(1, 0).reshape(count, -1)
        product = fixed_product(self._matrix, self._transpose, columns)
        return product.reshape(self.n_vertices, -1, channels).movedim(0, 1).reshape(*lead, -1, channels)

    def to(self, device: torch.device | str) -> Subdivision:
        """The same elsewhere."""
        return Subdivision(
            self.faces.to(device),
            self.face_parent.to(device),
            self.n_vertices,
            None if self._matrix is None else self._matrix.to(device),
            None if self._transpose is None else self._transpose.to(device),
        )

    def gather(self, values: Tensor) -> Tensor:
        """The transposed map: values [V',C] of the refined mesh summed onto the base vertices [V,C]."""
        return values if self._transpose is None else torch.mm(self._transpose, values)


def loop_subdivision(faces: Tensor, n_vertices: int, levels: int) -> Subdivision:
    """The operator of ``levels`` (0 to 3) Loop steps on a mesh of ``faces`` [F,3]; boundaries are creases."""
    if not 0 <= levels <= 3:
        raise ValueError(f"levels must be 0 to 3, not {levels}")
    current = faces.numpy().astype(np.int64)
    parent = np.arange(len(current))
    matrix: sp.csr_array | None = None
    count = n_vertices
    for _ in range(levels):
        step, current, face_parent = _loop_step(current, count)
        parent = parent[face_parent]
        count = step.shape[0]
        matrix = step if matrix is None else sp.csr_array(step @ matrix)
    return Subdivision(
        torch.from_numpy(np.ascontiguousarray(current)),
        torch.from_numpy(parent),
        count,
        None if matrix is None else to_torch_csr(matrix),
        None if matrix is None else to_torch_csr(sp.csr_array(matrix.T)),
    )


def _loop_step(
    faces: NDArray[np.int64], count: int
) -> tuple[sp.csr_array, NDArray[np.int64], NDArray[np.int64]]:
    """One step: the matrix [V+E,V], the refined faces [4F,3] and each one's parent."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    across = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    edges, edge_of = np.unique(ends, axis=0, return_inverse=True)
    edge_of = edge_of.reshape(-1)
    # An edge of three faces or more is a crease like a border.
    border = np.bincount(edge_of, minlength=len(edges)) != 2
    creases = np.bincount(edges[border].ravel(), minlength=count)
    on_border, corner = creases > 0, (creases > 0) & (creases != 2)
    edge_row = count + np.arange(len(edges))

    # A new vertex on an edge: 3/8 of its ends and 1/8 of the corners across; half and half on a border.
    end_weight = np.where(border, 1 / 2, 3 / 8)
    inner_side = ~border[edge_of]
    rows = [edge_row, edge_row, count + edge_of[inner_side]]
    columns = [edges[:, 0], edges[:, 1], across[inner_side]]
    values = [end_weight, end_weight, np.full(int(inner_side.sum()), 1 / 8)]

    # An old vertex: Loop's weights of its ring; 3/4 and 1/8, 1/8 along a border; a corner stays.
    degree = np.bincount(edges.ravel(), minlength=count)
    n = np.maximum(degree, 1)
    ring_weight = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / n) / 4) ** 2) / n
    own = np.where(corner, 1.0, np.where(on_border, 3 / 4, 1 - degree * ring_weight))
    rows.append(np.arange(count))
    columns.append(np.arange(count))
    values.append(own)
    for here, there in ((0, 1), (1, 0)):
        a, b = edges[:, here], edges[:, there]
        weight = np.where(on_border[a], np.where(border & ~corner[a], 1 / 8, 0.0), ring_weight[a])
        rows.append(a)
        columns.append(b)
        values.append(weight)
    matrix = sp.csr_array(
        sp.coo_array(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
            shape=(count + len(edges), count),
        )
    )
    matrix.eliminate_zeros()

    ab, bc, ca = (count + part for part in edge_of.reshape(3, -1))
    a, b, c = faces.T
    refined = np.stack(
        [np.stack(corners, 1) for corners in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))], 1
    )
    return matrix, refined.reshape(-1, 3), np.repeat(np.arange(len(faces)), 4)
