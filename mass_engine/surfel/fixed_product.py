"""A constant sparse matrix times a dense one, differentiable in the dense one."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from mass_engine import gpu


def fixed_product(matrix: Tensor, transpose: Tensor, dense: Tensor) -> Tensor:
    """``matrix`` [N,T] (CSR) @ ``dense`` [T,C] -> [N,C].

    ``transpose`` is the matrix's transpose, CSR too: kept, the gradient costs what the product does.
    """
    product: Tensor = _FixedProduct.apply(dense, matrix, transpose)  # type: ignore[no-untyped-call]
    return product


class _FixedProduct(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dense: Tensor, matrix: Tensor, transpose: Tensor) -> Tensor:
        ctx.transpose = transpose
        return _product(matrix, dense)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _product(ctx.transpose, gradient), None, None


def _product(matrix: Tensor, dense: Tensor) -> Tensor:
    kernels = gpu.kernels_for(dense)
    return torch.mm(matrix, dense) if kernels is None else gpu.sparse_product(kernels, matrix, dense)


def to_torch_csr(matrix: sp.csr_array) -> Tensor:
    """A scipy CSR matrix as a torch one (float32)."""
    matrix.sort_indices()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
        warnings.filterwarnings("ignore", message="Sparse invariant checks")
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(np.int32)),
            torch.from_numpy(matrix.indices.astype(np.int32)),
            torch.from_numpy(matrix.data.astype(np.float32)),
            size=matrix.shape,
        )
