"""2-D Gaussian surfel rasteriser (2DGS, Huang et al. 2024), exact and differentiable.

``rasterize`` is the whole interface. Two implementations stand behind it: ``reference`` (plain torch, any
dtype, the specification) and ``cpu`` (C++ kernels).

Conventions: a surfel is a centre and two tangents, conjugate half-diameters of its one-sigma ellipse; the
product of the tangents points out of its front (``surfel.inellipse.principal_tangents`` makes them of
standard deviations and a quaternion). Pixel (column i, row j) has its centre at (i + 0.5, j + 0.5). Surfels
are blended in order of their centre's camera z, ties by index.
"""

from __future__ import annotations

from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError
from mass_engine.raster import cpu, reference
from mass_engine.raster.types import Extras, RasterOptions, RenderOutput

__all__ = ["Extras", "RasterOptions", "RenderOutput", "rasterize"]

_LARGEST_SIDE = 16384
_MOST_SURFELS = 1 << 24


def rasterize(
    means: Tensor,
    tangents: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    options: RasterOptions | None = None,
) -> RenderOutput:
    """Render surfels: means [N,3], tangents [N,2,3], opacities [N] in 0..1.

    ``colors`` are plain [N,3] or spherical harmonics [N,K,3] of degree 0 to 3 (K = 1, 4, 9 or 16), seen from
    the camera's centre: max(0, 0.5 + sum_k Y_k h_k). ``background`` [3] or [H,W,3] goes behind (none: black,
    so ``rgb`` is premultiplied). Gradients reach every tensor argument and ``camera.world_to_camera`` (taken
    as a rigid motion) and ``camera.K`` (its upper two rows; the third is taken as 0, 0, 1). The "cpu" backend
    computes in float32 and is deterministic bit for bit whatever the number of threads. Raises
    ``BadArgumentError`` (``raster.shape``, ``raster.device``, ``raster.image_size``, ...).
    """
    options = options or RasterOptions()
    options.check()
    _check(means, tangents, opacities, colors, camera)
    if options.window is not None:
        camera = _window(camera, *options.window)
    render = reference.rasterize if options.backend == "reference" else cpu.rasterize
    out = render(means, tangents, opacities, colors, camera, options)
    if background is None:
        return out
    if background.shape not in ((3,), (camera.height, camera.width, 3)):
        raise BadArgumentError(
            "raster.shape", f"background is {tuple(background.shape)}.", "Give [3] or [height, width, 3]."
        )
    rgb = out.rgb + (1.0 - out.alpha)[..., None] * background
    return RenderOutput(rgb, out.alpha, out.depth, out.dropped, out.extras)


def _window(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    if not (width > 0 and height > 0 and 0 <= x <= camera.width - width and 0 <= y <= camera.height - height):
        raise BadArgumentError(
            "raster.window",
            f"The window {width} x {height} at ({x}, {y}) is not inside {camera.width} x {camera.height}.",
            "Give x, y, width and height of a part of the image.",
        )
    return camera.crop(x, y, width, height)


def _check(means: Tensor, tangents: Tensor, opacities: Tensor, colors: Tensor, camera: Camera) -> None:
    n = means.shape[0] if means.ndim else 0
    harmonics = colors.ndim == 3 and colors.shape[1] in (1, 4, 9, 16)
    wanted = {
        "means": (means, (n, 3)),
        "tangents": (tangents, (n, 2, 3)),
        "opacities": (opacities, (n,)),
        "colors": (colors, (n, colors.shape[1], 3) if harmonics else (n, 3)),
        "camera.K": (camera.K, (3, 3)),
        "camera.world_to_camera": (camera.world_to_camera, (4, 4)),
    }
    for name, (tensor, shape) in wanted.items():
        if tensor.shape != shape:
            raise BadArgumentError(
                "raster.shape",
                f"{name} is {tuple(tensor.shape)}, not {shape}.",
                "Give one row per surfel in every argument (harmonics: 1, 4, 9 or 16 of them).",
            )
        if not tensor.is_floating_point():
            raise BadArgumentError(
                "raster.dtype", f"{name} is {tensor.dtype}.", "Give floating-point tensors."
            )
        if tensor.device.type != "cpu":
            raise BadArgumentError("raster.device", f"{name} is on {tensor.device}.", "Move it to the CPU.")
    if not bool(camera.K.isfinite().all()) or not bool(camera.world_to_camera.isfinite().all()):
        raise BadArgumentError(
            "raster.camera", "The camera holds NaN or infinity.", "Check K and world_to_camera."
        )
    if n >= _MOST_SURFELS:
        raise BadArgumentError("raster.count", f"{n} surfels.", f"Render fewer than {_MOST_SURFELS}.")
    if not (0 < camera.width <= _LARGEST_SIDE and 0 < camera.height <= _LARGEST_SIDE):
        raise BadArgumentError(
            "raster.image_size",
            f"The image is {camera.width} x {camera.height}.",
            f"Each side must be 1 to {_LARGEST_SIDE} pixels.",
        )
