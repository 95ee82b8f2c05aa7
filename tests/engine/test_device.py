"""Where surfels are fitted and drawn: what keeps a GPU from being used, and what is said when it is full."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from mass_engine import cli, device
from mass_engine.deform.precision import product
from mass_engine.errors import OUT_OF_MEMORY, BadArgumentError, EngineError
from mass_engine.options import FitOptions
from mass_engine.raster import cuda


def test_the_cpu_is_always_there() -> None:
    assert device.choose_device("cpu") == torch.device("cpu")


def test_a_torch_without_cuda_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    assert device.choose_device("auto") == torch.device("cpu")
    with pytest.raises(BadArgumentError, match=r"built without CUDA") as caught:
        device.choose_device("cuda")
    assert caught.value.code == "device.unavailable"


def test_a_machine_without_a_gpu_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(BadArgumentError, match=r"no driver, or no GPU") as caught:
        FitOptions(device="cuda")
    assert caught.value.code == "device.unavailable"


def test_a_build_without_kernels_is_named_and_one_with_them_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)

    def absent() -> None:
        raise EngineError("device.unavailable", "There are no GPU kernels in this build.", "Build them.")

    monkeypatch.setattr(cuda, "import_kernels", absent)
    assert device.choose_device("auto") == torch.device("cpu")
    with pytest.raises(BadArgumentError, match=r"no GPU kernels"):
        device.choose_device("cuda")
    monkeypatch.setattr(cuda, "import_kernels", lambda: None)
    assert device.choose_device("auto") == device.choose_device("cuda") == torch.device("cuda", 1)


@pytest.mark.parametrize(
    ("error", "full"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB."), True),
        (RuntimeError("CUDA error: out of memory"), True),
        (RuntimeError("CUDA error: an illegal memory access was encountered"), False),
        (RuntimeError("out of range"), False),
        (MemoryError(), False),
    ],
)
def test_only_a_full_device_is_one(error: Exception, full: bool) -> None:
    assert (device.memory_error(error) is not None) == full


@pytest.mark.parametrize("as_json", [True, False])
def test_the_command_ends_with_a_code_of_its_own(
    as_json: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")

    monkeypatch.setattr("mass_engine.pipeline.fit_to_directory", full)
    flags = ["--json"] if as_json else []
    code = cli.main(["fit", str(tmp_path / "x.mp4"), "--out", str(tmp_path / "run"), *flags])
    said = capsys.readouterr()
    assert code == cli.EXIT_OUT_OF_MEMORY
    assert f"error: {OUT_OF_MEMORY}" in said.err
    assert "--max-frames" in said.err
    if as_json:
        event = json.loads(said.out.splitlines()[-1])
        assert (event["type"], event["code"]) == ("error", OUT_OF_MEMORY)


def test_choosing_the_cpu_loads_no_torch() -> None:
    code = (
        "import sys\n"
        "from mass_engine.options import FitOptions\n"
        "FitOptions(device='cpu'), FitOptions()\n"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(("precision", "bits"), [("float32", 20), ("tf32", 9), ("bf16", 5)])
def test_products_of_fewer_bits_and_their_gradients(precision: device.Precision, bits: int) -> None:
    random = torch.Generator().manual_seed(0)
    rows = torch.randn(2, 50, 16, generator=random, requires_grad=True)
    weights = torch.randn(16, 9, generator=random, requires_grad=True)
    found = product(rows, weights, precision)
    assert found.dtype == torch.float32
    exact = rows.double() @ weights.double()
    upstream = torch.randn(found.shape, generator=random)
    ours = (found, *torch.autograd.grad(found, (rows, weights), upstream))
    theirs = (exact, *torch.autograd.grad(exact, (rows, weights), upstream.double()))
    for mine, other in zip(ours, theirs, strict=True):
        assert float((mine - other).detach().norm()) <= 2.0**-bits * float(other.detach().norm())
    assert torch.get_float32_matmul_precision() == "highest"
