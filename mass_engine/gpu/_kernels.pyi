from torch import Tensor

def ssim_blocks(height: int, width: int) -> int: ...
def product(
    stream: int, begins: Tensor, columns: Tensor, values: Tensor, dense: Tensor, few: bool, out: Tensor, /
) -> None: ...
def decoder_blocks(count: int) -> int: ...
def decoder_sums(hidden: int, batch: int) -> int: ...
def decode(
    stream: int,
    surfel_share: Tensor,
    pose_share: Tensor,
    second: Tensor,
    second_bias: Tensor,
    head: Tensor,
    head_bias: Tensor,
    offset_unit: float,
    rotation_unit: float,
    offset: Tensor,
    log_scale: Tensor,
    rotation: Tensor,
    mask_logit: Tensor,
    /,
) -> None: ...
def decode_backward(
    stream: int,
    surfel_share: Tensor,
    pose_share: Tensor,
    second: Tensor,
    second_bias: Tensor,
    head: Tensor,
    head_bias: Tensor,
    offset_unit: float,
    rotation_unit: float,
    d_offset: Tensor,
    d_log_scale: Tensor,
    d_rotation: Tensor,
    d_mask_logit: Tensor,
    log_scale: Tensor,
    d_surfel_share: Tensor,
    partial: Tensor,
    sums: Tensor,
    /,
) -> None: ...
def deform(
    stream: int,
    means: Tensor,
    tangents: Tensor,
    normals: Tensor,
    offset: Tensor,
    log_scale: Tensor,
    rotation: Tensor,
    means_out: Tensor,
    tangents_out: Tensor,
    normals_out: Tensor,
    /,
) -> None: ...
def deform_backward(
    stream: int,
    tangents: Tensor,
    normals: Tensor,
    offset: Tensor,
    log_scale: Tensor,
    rotation: Tensor,
    d_means_out: Tensor,
    d_tangents_out: Tensor,
    d_normals_out: Tensor,
    d_tangents: Tensor,
    d_normals: Tensor,
    d_offset: Tensor,
    d_log_scale: Tensor,
    d_rotation: Tensor,
    /,
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
