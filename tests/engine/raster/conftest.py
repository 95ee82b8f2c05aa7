"""Torch on one thread: the reference works on tensors too small to share, and waiting at barriers is slow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from mass_engine.raster.cuda import Backend
from tests.emulation import ROOT, build
from tests.gpu import gpu_problem, nvcc

# tests/conftest.py says so at the end of a run.
collect_ignore = [
    *(["test_gpu.py"] if gpu_problem() else []),
    *([] if nvcc() else ["test_cuda_build.py"]),
]

KERNELS = ROOT / "mass_engine" / "raster" / "kernels"


@pytest.fixture(autouse=True, scope="package")
def one_torch_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def emulated() -> Backend:
    """The GPU kernels, run by the CPU."""
    sources: list[Path] = [*sorted(KERNELS.glob("cuda_*.cu")), KERNELS / "cuda_module.cpp"]
    return Backend(build("_cuda_kernels", sources, [KERNELS]))
