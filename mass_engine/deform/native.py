"""The compiled kernels of the deformation, one set a process."""

from __future__ import annotations

import functools

from mass_engine.deform import _kernels
from mass_engine.errors import BadArgumentError


@functools.cache
def shared_kernels(instruction_set: str = "auto") -> _kernels.Kernels:
    """The process's kernels; their threads are made on first use.

    Raises BadArgumentError ``deform.instruction_set`` when this machine lacks it.
    """
    if instruction_set != "auto" and instruction_set not in _kernels.instruction_sets():
        raise BadArgumentError(
            "deform.instruction_set",
            f"This machine has no {instruction_set}.",
            f"Use auto, {', '.join(_kernels.instruction_sets())}.",
        )
    return _kernels.Kernels(instruction_set)
