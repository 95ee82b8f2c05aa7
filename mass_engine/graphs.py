"""A computation on tensors that stay where they are: called as it is on a CPU, one CUDA graph on a GPU.

A step of a few hundred small operators costs a GPU's host more than the GPU: each has to be launched. A graph
is launched once. What it needs is said here in one place: every tensor lies at the same address each time,
no shape depends on a value, nothing asks the device for a number, and nothing comes from the host within.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

T = TypeVar("T")

#: Runs before the capture: libraries choose their algorithms, and buffers get their sizes.
_WARM_UPS = 3


class Replayed(Generic[T]):
    """``function`` of no arguments, which reads and writes tensors that it holds.

    On a GPU the first call runs it a few times, captures it and replays that from then on: what it returns
    then are the same tensors each time, with the latest values. On a CPU every call simply runs it.
    ``before_capture`` is called around the runs that do not count, with True before them and False after:
    they must leave nothing behind.
    """

    def __init__(
        self,
        function: Callable[[], T],
        device: torch.device,
        before_capture: Callable[[bool], object] | None = None,
    ) -> None:
        self._function, self._device = function, device
        self._idle = before_capture or (lambda _: None)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._out: T | None = None

    def __call__(self) -> T:
        if self._device.type != "cuda":
            return self._function()
        if self._graph is None:
            self._out = self._capture()
        assert self._graph is not None
        self._graph.replay()
        return self._out  # type: ignore[return-value]

    def _capture(self) -> T:
        self._idle(True)
        with torch.cuda.device(self._device):
            beside = torch.cuda.Stream()
            beside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(beside):
                for _ in range(_WARM_UPS):
                    self._function()
            torch.cuda.current_stream().wait_stream(beside)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                out = self._function()
        self._idle(False)
        self._graph = graph
        return out
