from torch import Tensor

def instruction_sets() -> list[str]: ...

class Kernels:
    def __init__(self, instruction_set: str = ...) -> None: ...
    @property
    def instruction_set(self) -> str: ...
    def decode(
        self,
        surfel_share: Tensor,
        pose_share: Tensor,
        second: Tensor,
        second_bias: Tensor,
        head: Tensor,
        head_bias: Tensor,
        out: Tensor,
        threads: int,
        /,
    ) -> None: ...
    def pose_surfels(
        self,
        vertices: Tensor,
        corners: Tensor,
        places: Tensor,
        coefficients: Tensor,
        bones: Tensor,
        rotations: Tensor,
        albedo: Tensor,
        harmonics: Tensor,
        opacities: Tensor,
        light: Tensor,
        center_units: list[float],
        deformed_from: int,
        surfel_share: Tensor,
        pose_share: Tensor,
        second: Tensor,
        second_bias: Tensor,
        head: Tensor,
        head_bias: Tensor,
        means_out: Tensor,
        tangents_out: Tensor,
        normals_out: Tensor,
        opacities_out: Tensor,
        colors_out: Tensor,
        threads: int,
        /,
    ) -> None: ...
    def decode_backward(
        self,
        surfel_share: Tensor,
        pose_share: Tensor,
        second: Tensor,
        second_bias: Tensor,
        head: Tensor,
        d_out: Tensor,
        d_surfel_share: Tensor,
        d_pose_share: Tensor,
        d_second: Tensor,
        d_second_bias: Tensor,
        d_head: Tensor,
        d_head_bias: Tensor,
        threads: int,
        /,
    ) -> None: ...
