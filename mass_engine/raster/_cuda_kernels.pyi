"""Built only where there is a CUDA compiler. Arrays are tensors or DLPack capsules of them."""

from typing import Any

class DeviceError(RuntimeError): ...

def problem() -> str: ...

class Plan:
    def __init__(
        self,
        surfels: int,
        width: int,
        height: int,
        capacity: int,
        extra: bool,
        differentiable: bool,
        near: float,
        distortion_scale: float,
        cull_backfaces: bool,
        bounds: int,
        center_depth: bool,
        /,
    ) -> None: ...
    @property
    def bytes(self) -> int: ...
    def forward(
        self,
        stream: int,
        memory: Any,
        counters: Any,
        means: Any,
        tangents: Any,
        opacities: Any,
        colors: Any,
        pose: Any,
        K: Any,
        rgb: Any,
        alpha: Any,
        depth: Any,
        median: Any | None,
        normal: Any | None,
        distortion: Any | None,
        weights: Any | None,
        /,
    ) -> None: ...
    def backward(
        self,
        stream: int,
        memory: Any,
        means: Any,
        tangents: Any,
        opacities: Any,
        colors: Any,
        pose: Any,
        K: Any,
        alpha: Any,
        depth: Any,
        d_rgb: Any | None,
        d_alpha: Any | None,
        d_depth: Any | None,
        d_median: Any | None,
        d_normal: Any | None,
        d_distortion: Any | None,
        d_means: Any,
        d_tangents: Any,
        d_opacities: Any,
        d_colors: Any,
        d_pose: Any,
        d_K: Any,
        /,
    ) -> None: ...
