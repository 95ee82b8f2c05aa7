"""The GPU kernels beside the rasteriser's, run by the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType

import pytest

from tests.emulation import ROOT, build
from tests.gpu import gpu_problem, nvcc

# A line at the end of the run says what was left out.
collect_ignore = [
    *(["test_gpu.py"] if gpu_problem() else []),
    *([] if nvcc() else ["test_cuda_build.py"]),
]

KERNELS = ROOT / "mass_engine" / "gpu" / "kernels"
OTHERS = [ROOT / "mass_engine" / part / "kernels" for part in ("raster", "deform")]


@pytest.fixture(scope="session")
def built() -> ModuleType:
    """Compiled once a session, if anything changed."""
    return build("_kernels", [*sorted(KERNELS.glob("*.cu")), KERNELS / "module.cpp"], [KERNELS, *OTHERS])


@pytest.fixture(params=[False, True], ids=["forwards", "backwards"])
def emulated(built: ModuleType, request: pytest.FixtureRequest) -> Iterator[ModuleType]:
    """The kernels with the threads of a block in one order, then in the other: no result may tell."""
    built.reverse_threads(request.param)
    yield built
    built.reverse_threads(False)
