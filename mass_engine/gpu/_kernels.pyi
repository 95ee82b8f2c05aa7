from torch import Tensor

def ssim_blocks(height: int, width: int) -> int: ...
def product(
    stream: int, begins: Tensor, columns: Tensor, values: Tensor, dense: Tensor, few: bool, out: Tensor, /
) -> None: ...
def ssim(
    stream: int, seen: Tensor, wanted: Tensor, inside: Tensor, sums: Tensor, slopes: Tensor | None, /
) -> None: ...
def ssim_backward(
    stream: int,
    seen: Tensor,
    wanted: Tensor,
    inside: Tensor,
    slopes: Tensor,
    scale: Tensor,
    d_seen: Tensor,
    /,
) -> None: ...
