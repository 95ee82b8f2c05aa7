"""Is there a GPU to test on, and a CUDA compiler?"""

from __future__ import annotations

import ctypes
import os
import shutil


def nvcc() -> str | None:
    """The CUDA compiler that ``CUDACXX`` names, or the one on the path."""
    return shutil.which(os.environ.get("CUDACXX", "nvcc"))


def gpu_problem() -> str:
    """Why the tests that need a GPU cannot run here; empty when they can."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "no NVIDIA driver"
    import torch

    from mass_engine.errors import EngineError
    from mass_engine.raster.cuda import import_kernels

    if not torch.cuda.is_available():
        return "PyTorch sees no GPU"
    try:
        import_kernels()
    except EngineError as error:
        return error.message
    return ""


def left_out() -> list[str]:
    """What a test run says at its end about the tests it did not collect."""
    lines = []
    if problem := gpu_problem():
        lines.append(f"GPU: {problem}: tests on a GPU are left out, the emulation's run")
    if nvcc() is None:
        lines.append("nvcc: not found: the GPU kernels are not compiled, the emulation is")
    return lines
