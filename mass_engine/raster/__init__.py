"""2-D Gaussian surfel rasteriser (2DGS, Huang et al. 2024), exact and differentiable.

``rasterize`` is the whole interface. Three implementations stand behind it: ``reference`` (plain torch, any
dtype, the specification), ``cpu`` (C++ kernels) and ``cuda`` (the same mathematics on a GPU).

Conventions: a surfel is a centre and two tangents, conjugate half-diameters of its one-sigma ellipse; the
product of the tangents points out of its front (``surfel.inellipse.principal_tangents`` makes them of
standard deviations and a quaternion). Pixel (column i, row j) has its centre at (i + 0.5, j + 0.5). Surfels
are blended in order of their centre's camera z, ties by index.
"""

from __future__ import annotations

from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError
from mass_engine.raster import cpu, cuda, reference
from mass_engine.raster.types import Backend, Extras, RasterOptions, RenderOutput

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
    as a rigid motion) and ``camera.K`` (its upper two rows; the third is taken as 0, 0, 1). Surfels are
    rendered where they are, on the CPU or a GPU; the camera may stay on the CPU. Both compute in float32, the
    same bits every time, whatever the number of threads. Raises ``BadArgumentError`` (``raster.shape``,
    ``raster.device``, ``raster.image_size``, ...) and ``EngineError`` (``device.unavailable``,
    ``raster.too_many_pairs``).
    """
    options = options or RasterOptions()
    options.check()
    _check(means, tangents, opacities, colors, camera)
    backend = _backend(means, tangents, opacities, colors, camera, options.backend)
    if options.window is not None:
        camera = _window(camera, *options.window)
    out = _RENDER[backend](means, tangents, opacities, colors, camera, options)
    if background is None:
        return out
    if background.shape not in ((3,), (camera.height, camera.width, 3)):
        raise BadArgumentError(
            "raster.shape", f"background is {tuple(background.shape)}.", "Give [3] or [height, width, 3]."
        )
    rgb = out.rgb + (1.0 - out.alpha)[..., None] * background
    return RenderOutput(rgb, out.alpha, out.depth, out.dropped, out.extras, out.counters)


_RENDER = {"cpu": cpu.rasterize, "cuda": cuda.rasterize, "reference": reference.rasterize}


def _backend(
    means: Tensor, tangents: Tensor, opacities: Tensor, colors: Tensor, camera: Camera, asked: Backend
) -> Backend:
    """The one that ``auto`` is; raise unless all tensors are where it computes."""
    backend: Backend = asked if asked != "auto" else "cuda" if means.device.type == "cuda" else "cpu"
    surfels = {"means": means, "tangents": tangents, "opacities": opacities, "colors": colors}
    cameras = {"camera.K": camera.K, "camera.world_to_camera": camera.world_to_camera}
    wanted = means.device if backend == "cuda" and means.device.type == "cuda" else None
    for name, tensor in (surfels | cameras).items():
        here = tensor.device
        if here.type == "cpu" and (backend != "cuda" or name in cameras):
            continue
        if wanted is None or here != wanted:
            place = wanted or ("a GPU" if backend == "cuda" else "the CPU")
            raise BadArgumentError("raster.device", f"{name} is on {here}.", f"Move it to {place}.")
    return backend


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
    # On a GPU the kernels look, so that nothing waits for it here.
    on_cpu = [t for t in (camera.K, camera.world_to_camera) if t.device.type == "cpu"]
    if not all(bool(t.isfinite().all()) for t in on_cpu):
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
