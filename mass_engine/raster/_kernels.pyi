from torch import Tensor

CONSTANTS: dict[str, float]

class TooManyPairsError(RuntimeError): ...

def instruction_sets() -> list[str]: ...

class Frame:
    @property
    def dropped(self) -> int: ...
    @property
    def pairs(self) -> int: ...
    @property
    def bytes(self) -> int: ...
    @property
    def profile(self) -> dict[str, float]: ...

class Renderer:
    def __init__(self, instruction_set: str = ...) -> None: ...
    @property
    def instruction_set(self) -> str: ...
    def forward(
        self,
        camera: list[float],
        width: int,
        height: int,
        cull_backfaces: bool,
        bounds: int,
        center_depth: bool,
        without: int,
        means: Tensor,
        tangents: Tensor,
        opacities: Tensor,
        colors: Tensor,
        rgb: Tensor,
        alpha: Tensor,
        depth: Tensor,
        median: Tensor | None,
        normal: Tensor | None,
        distortion: Tensor | None,
        weights: Tensor | None,
        differentiable: bool,
        threads: int,
        /,
    ) -> Frame: ...
    def backward(
        self,
        frame: Frame,
        means: Tensor,
        tangents: Tensor,
        opacities: Tensor,
        colors: Tensor,
        alpha: Tensor,
        depth: Tensor,
        d_rgb: Tensor | None,
        d_alpha: Tensor | None,
        d_depth: Tensor | None,
        d_median: Tensor | None,
        d_normal: Tensor | None,
        d_distortion: Tensor | None,
        d_means: Tensor,
        d_tangents: Tensor,
        d_opacities: Tensor,
        d_colors: Tensor,
        d_camera: Tensor,
        threads: int,
        /,
    ) -> None: ...
