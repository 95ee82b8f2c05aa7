"""Multi-resolution hash grid of fixed points (Müller et al. 2022, Instant-NGP), the paper's Enc_h.

The points are *canonical* centroids, of the hand at rest: the keys of posed ones would move with every frame.
They never move, so corners and weights of every point are found once, and a lookup is one fixed sparse
product a level.

Who the surfel's base face is enters as a learned embedding per face beside the grid, not as a fourth
coordinate: faces are names, not a scale. A fourth axis would blend faces whose numbers happen to be
neighbours, wherever they are on the hand, and twice the corners would have to be looked up for it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor, nn

from mass_engine.errors import BadArgumentError
from mass_engine.surfel.fixed_product import fixed_product, to_torch_csr

_PRIMES = (1, 2654435761, 805459861)
#: Features start this close to zero (Instant-NGP, section 4).
_START = 1e-4


@dataclass(frozen=True)
class HashGridConfig:
    """``levels`` of ``features`` numbers each: level l has round(base_resolution growth^l) cells along an
    edge of the unit cube and a table of at most 2^``table_bits`` rows. ``face_features`` numbers more belong
    to the base face (0: none).

    The defaults are a hand's: cells from 28 mm down to 1.7 mm. The skin is a surface and meets few corners:
    164,608 surfels of the built-in hand 152 on the coarsest level, 19,524 on the last but one and 43,743 on
    the last, the only one with more corners than its 32,768 rows.
    """

    levels: int = 8
    features: int = 2
    table_bits: int = 15
    base_resolution: int = 8
    growth: float = 1.5
    face_features: int = 4

    def __post_init__(self) -> None:
        ranges = {
            "levels": (1, 24),
            "features": (1, 16),
            "table_bits": (4, 24),
            "base_resolution": (1, 1024),
            "growth": (1.0, 4.0),
            "face_features": (0, 64),
        }
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise BadArgumentError(
                    "deform.config", f"{name} is {value}.", f"Use {least} to {most} for the hash grid."
                )
        if self.resolutions[-1] > 1 << 16:
            raise BadArgumentError(
                "deform.config",
                f"The finest level has {self.resolutions[-1]} cells.",
                "Use fewer levels or less growth.",
            )

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along an edge, coarse to fine."""
        return tuple(round(self.base_resolution * self.growth**level) for level in range(self.levels))

    @property
    def width(self) -> int:
        """Numbers per point."""
        return self.levels * self.features + self.face_features

    def rows(self, resolution: int) -> int:
        """Rows of a level's table: one per corner where they fit."""
        return int(min((resolution + 1) ** 3, 1 << self.table_bits))


class HashGrid(nn.Module):
    """Features [N, config.width] of fixed points.

    ``points`` [N,3] in the unit cube (what lies outside is taken to its border), ``faces`` [N] in
    0..``face_count``-1. Raises BadArgumentError ``deform.points``.
    """

    def __init__(
        self,
        config: HashGridConfig,
        points: Tensor,
        faces: Tensor,
        face_count: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.config = config
        self.face_count = face_count

        def start(rows: int, columns: int) -> nn.Parameter:
            return nn.Parameter((torch.rand(rows, columns, generator=generator) * 2 - 1) * _START)

        self.tables = nn.ParameterList(
            start(config.rows(resolution), config.features) for resolution in config.resolutions
        )
        self.face_table = start(face_count if config.face_features else 0, config.face_features)
        self.place(points, faces)

    def place(self, points: Tensor, faces: Tensor) -> None:
        """Look up other points from now on."""
        if points.ndim != 2 or points.shape[1] != 3 or faces.shape != points.shape[:1]:
            raise BadArgumentError(
                "deform.points",
                f"points are {tuple(points.shape)}, faces {tuple(faces.shape)}.",
                "Give [N,3] and [N].",
            )
        if not bool(points.isfinite().all()):
            raise BadArgumentError("deform.points", "A point is not finite.", "Check the template.")
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < self.face_count:
            raise BadArgumentError(
                "deform.points", f"A face is not in 0 to {self.face_count - 1}.", "Use the base mesh's faces."
            )
        unit = points.detach().double().numpy().clip(0.0, 1.0)
        pairs = [
            _level_matrix(unit, resolution, self.config.rows(resolution))
            for resolution in self.config.resolutions
        ]
        if self.config.face_features:
            rows = np.arange(len(unit) + 1)
            ones = np.ones(len(unit))
            pairs.append(sp.csr_array((ones, faces.numpy(), rows), shape=(len(unit), self.face_count)))
        self.matrices = [(to_torch_csr(m), to_torch_csr(sp.csr_array(m.T))) for m in pairs]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        """Other dtypes: the matrices go along (they are no buffers, a file has no use for them)."""
        self.matrices = [(fn(matrix), fn(transpose)) for matrix, transpose in self.matrices]
        return super()._apply(fn, recurse)  # type: ignore[no-untyped-call]

    def forward(self) -> Tensor:
        """The features of every point, [N, config.width]."""
        tables = [*self.tables, self.face_table] if self.config.face_features else list(self.tables)
        parts = [
            fixed_product(matrix, transpose, table)
            for (matrix, transpose), table in zip(self.matrices, tables, strict=True)
        ]
        return torch.cat(parts, -1)


def _level_matrix(points: np.ndarray[Any, Any], resolution: int, rows: int) -> sp.csr_array:
    """[N, rows]: the eight corners of each point's cell with their trilinear weights."""
    scaled = points * resolution
    cell = np.minimum(np.floor(scaled), resolution - 1).astype(np.int64)
    within = scaled - cell
    columns, weights = [], []
    for corner in itertools.product((0, 1), repeat=3):
        index = cell + np.array(corner)
        columns.append(_row_of(index, resolution, rows))
        weights.append(np.where(np.array(corner) == 1, within, 1 - within).prod(1))
    starts = np.arange(0, 8 * len(points) + 1, 8)
    matrix = sp.csr_array(
        (np.stack(weights, 1).ravel(), np.stack(columns, 1).ravel(), starts), shape=(len(points), rows)
    )
    matrix.sum_duplicates()  # corners of one cell may share a hashed row
    return matrix


def _row_of(corner: np.ndarray[Any, Any], resolution: int, rows: int) -> np.ndarray[Any, Any]:
    """The table's row of grid corners [N,3]: their own where all fit, else Instant-NGP's hash."""
    side = resolution + 1
    if rows == side**3:
        return np.asarray((corner[:, 2] * side + corner[:, 1]) * side + corner[:, 0])
    x, y, z = (corner[:, axis] * prime for axis, prime in enumerate(_PRIMES))
    return np.asarray((x ^ y ^ z) & (rows - 1))
