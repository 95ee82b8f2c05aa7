"""nvcc takes the kernels; collected only where there is an nvcc."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.emulation import ROOT
from tests.gpu import nvcc

KERNELS = ROOT / "mass_engine" / "gpu" / "kernels"
INCLUDES = [ROOT / "mass_engine" / part / "kernels" for part in ("raster", "deform", "gpu")]


@pytest.mark.parametrize("source", sorted(path.name for path in KERNELS.glob("*.cu")))
def test_it_compiles_and_keeps_its_values_in_registers(source: str, tmp_path: Path) -> None:
    compiler = nvcc()
    assert compiler is not None
    command = [compiler, "-std=c++17", "-O3", "--fmad=false", "-Xptxas", "-v", "-arch=sm_90", "-cubin"]
    command += [f"-I{path}" for path in INCLUDES]
    command += [str(KERNELS / source), "-o", str(tmp_path / "out.cubin")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    spills = re.findall(r"(\d+) bytes spill stores, (\d+) bytes spill loads", done.stderr)
    assert spills
    assert all(pair == ("0", "0") for pair in spills), done.stderr
