"""Where the surfels are fitted and drawn: the processor, or an NVIDIA GPU.

A GPU needs three things, none of which the CPU needs: a torch that can use it, a driver with a GPU behind it,
and this package's GPU kernels, which are built when nvcc is found (docs/gpu.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from mass_engine.errors import OUT_OF_MEMORY, BadArgumentError, EngineError

if TYPE_CHECKING:
    import torch

#: Of matrix products on a GPU: mantissas of 23, 10 (TF32) and 7 bits. A CPU's are always float32.
Precision = Literal["float32", "tf32", "bf16"]
#: What ``--device`` takes. ``auto`` is the GPU where one can be used.
DEVICES = ("auto", "cpu", "cuda")


def missing_for_gpu() -> tuple[str, str] | None:
    """What keeps this process from using a GPU, and what to do about it; None when nothing does."""
    import torch

    from mass_engine.raster.cuda import import_kernels

    if torch.version.cuda is None:
        return (
            "This torch is built without CUDA.",
            "Install torch with CUDA (docs/gpu.md), or use --device cpu.",
        )
    if not torch.cuda.is_available():
        return (
            "No NVIDIA GPU can be reached: there is no driver, or no GPU behind it.",
            "See what nvidia-smi says, and CUDA_VISIBLE_DEVICES; or use --device cpu.",
        )
    try:
        import_kernels()
    except EngineError as error:
        return error.message, error.advice
    return None


def choose_device(wanted: str) -> torch.device:
    """The device for ``auto``, ``cpu`` or ``cuda``.

    Raises BadArgumentError ``device.unavailable`` for a GPU that cannot be used.
    """
    import torch

    if wanted == "cpu":
        return torch.device("cpu")
    missing = missing_for_gpu()
    if missing is None:
        return torch.device("cuda", torch.cuda.current_device())
    if wanted == "cuda":
        raise BadArgumentError("device.unavailable", *missing)
    return torch.device("cpu")


def device_report(device: torch.device) -> dict[str, Any]:
    """What a report says of it: its kind, and a GPU's name and the most of its memory that was in use."""
    import torch

    if device.type != "cuda":
        return {"device": device.type}
    return {
        "device": device.type,
        "gpu": torch.cuda.get_device_name(device),
        "gpu_peak_memory_bytes": torch.cuda.max_memory_allocated(device),
    }


def memory_error(error: BaseException) -> EngineError | None:
    """The failure that ``error`` is when a device's memory did not suffice; None for any other error."""
    import torch

    full = isinstance(error, torch.OutOfMemoryError)
    # Where a library allocates by itself, the driver's words are all there is.
    words = str(error).lower()
    if not full and not (isinstance(error, RuntimeError) and "cuda" in words and "out of memory" in words):
        return None
    return EngineError(
        OUT_OF_MEMORY,
        "The GPU's memory did not suffice.",
        "Use a lower preset, fewer frames (--max-frames) or --device cpu; see that nothing else uses it.",
    )
