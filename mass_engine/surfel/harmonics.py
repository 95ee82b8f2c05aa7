"""Real spherical harmonics of degree 0 to 3 in the sign convention of 3-D Gaussian splatting.

A colour is ``0.5 + sum_k sh[k] * Y_k(direction)``; the offset of 0.5 belongs to the colour, not to ``sh``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_C0 = 0.5 / math.sqrt(math.pi)
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = (math.sqrt(15 / (4 * math.pi)), math.sqrt(5 / (16 * math.pi)), math.sqrt(15 / (16 * math.pi)))
_C3 = (
    math.sqrt(35 / (32 * math.pi)),
    math.sqrt(105 / (4 * math.pi)),
    math.sqrt(21 / (32 * math.pi)),
    math.sqrt(7 / (16 * math.pi)),
    math.sqrt(105 / (16 * math.pi)),
)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """Y_0 .. Y_{count-1} of unit ``directions`` [...,3] -> [...,count]; ``count`` is 1, 4, 9 or 16."""
    if count not in (1, 4, 9, 16):
        raise ValueError(f"count must be 1, 4, 9 or 16, not {count}")
    x, y, z = directions.unbind(-1)
    terms = [torch.full_like(x, _C0)]
    if count > 1:
        terms += [-_C1 * y, _C1 * z, -_C1 * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        terms += [
            _C2[0] * x * y,
            -_C2[0] * y * z,
            _C2[1] * (2 * zz - xx - yy),
            -_C2[0] * x * z,
            _C2[2] * (xx - yy),
        ]
        if count > 9:
            terms += [
                -_C3[0] * y * (3 * xx - yy),
                _C3[1] * x * y * z,
                -_C3[2] * y * (4 * zz - xx - yy),
                _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                -_C3[2] * x * (4 * zz - xx - yy),
                _C3[4] * z * (xx - yy),
                -_C3[0] * x * (xx - 3 * yy),
            ]
    return torch.stack(terms, -1)


def evaluate_sh(sh: Tensor, directions: Tensor) -> Tensor:
    """Colours [N,3] of ``sh`` [N,K,3] seen along unit ``directions`` [N,3] (camera towards surfel)."""
    return torch.einsum("nk,nkc->nc", sh_basis(directions, sh.shape[1]), sh) + 0.5


def evaluate_sh_rest(sh: Tensor, directions: Tensor) -> Tensor:
    """What degrees 1 and up add to a colour: ``sh`` [N,K-1,3] without its constant term -> [...,N,3]."""
    return torch.einsum("...nk,nkc->...nc", sh_basis(directions, sh.shape[1] + 1)[..., 1:], sh)


def rgb_to_sh0(rgb: Tensor) -> Tensor:
    """The constant coefficient [...,3] of a colour [...,3] in 0..1."""
    return (rgb - 0.5) / _C0
