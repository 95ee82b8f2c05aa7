"""nvcc takes the kernels, for every architecture; collected only where there is an nvcc."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.emulation import ROOT
from tests.gpu import nvcc

KERNELS = ROOT / "mass_engine" / "raster" / "kernels"
#: All but the sort, which is CUB's and takes nvcc minutes.
SOURCES = sorted(path.name for path in KERNELS.glob("cuda_*.cu") if path.name != "cuda_sort.cu")


@pytest.mark.parametrize("source", SOURCES)
def test_it_compiles_and_keeps_its_values_in_registers(source: str, tmp_path: Path) -> None:
    compiler = nvcc()
    assert compiler is not None
    command = [compiler, "-std=c++17", "-O3", "--fmad=false", "-Xptxas", "-v", "-arch=sm_90", "-cubin"]
    command += [str(KERNELS / source), "-o", str(tmp_path / "out.cubin")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    spills = re.findall(r"(\d+) bytes spill stores, (\d+) bytes spill loads", done.stderr)
    assert all(pair == ("0", "0") for pair in spills), done.stderr
