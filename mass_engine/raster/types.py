"""What goes into the rasteriser besides surfels, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from mass_engine.errors import BadArgumentError

Backend = Literal["auto", "cpu", "reference"]
Outputs = Literal["color", "all"]

# The numbers the result depends on, as in kernels/constants.hpp (a test compares the two).
ALPHA_MAX = 0.99
ALPHA_CUT = 1.0 / 255.0
TRANSMITTANCE_STOP = 1e-4
LOW_PASS = 2.0
MEDIAN_TRANSMITTANCE = 0.5
EDGE_ON_COSINE = 1e-4


@dataclass(frozen=True)
class RasterOptions:
    """How to rasterise.

    ``outputs``: "color" is rgb, alpha and depth; "all" adds median depth, normal, distortion and weight_sum.
    ``near``: surfels whose centre is nearer than this (scene units) are not drawn, parts of a disk nearer
    than this are not met by their rays. ``cull_backfaces`` drops surfels whose normal (third axis) points
    away from the camera. ``distortion_range``: the near and far that map depth to [0, 1] in the distortion
    output; take them around the object, or its value is numerically dead. ``threads``: None is every core
    this process may use.
    """

    backend: Backend = "auto"
    outputs: Outputs = "color"
    cull_backfaces: bool = False
    near: float = 0.01
    distortion_range: tuple[float, float] = (0.1, 10.0)
    threads: int | None = None

    def check(self) -> None:
        """Raise ``BadArgumentError`` when a value makes no sense."""
        if self.backend not in ("auto", "cpu", "reference"):
            raise BadArgumentError(
                "raster.backend",
                f"No backend {self.backend!r}.",
                "Use 'auto', 'cpu' or 'reference'.",
            )
        if self.outputs not in ("color", "all"):
            raise BadArgumentError(
                "raster.outputs", f"There is no output set {self.outputs!r}.", "Use 'color' or 'all'."
            )
        if not self.near > 0:
            raise BadArgumentError("raster.near", f"near is {self.near}.", "Give a positive distance.")
        if not 0 < self.distortion_range[0] < self.distortion_range[1]:
            raise BadArgumentError(
                "raster.distortion_range",
                f"distortion_range is {self.distortion_range}.",
                "Give two distances, 0 < near < far.",
            )
        if self.threads is not None and self.threads < 1:
            raise BadArgumentError("raster.threads", f"threads is {self.threads}.", "Give at least 1.")

    @property
    def distortion_scale(self) -> float:
        """``b`` in m = a - b / z, the map of z to [0, 1] over ``distortion_range`` (``a`` cancels)."""
        near, far = self.distortion_range
        return near * far / (far - near)


@dataclass(frozen=True)
class Extras:
    """The outputs computed only with ``outputs="all"``."""

    median_depth: Tensor
    normal: Tensor
    distortion: Tensor
    weight_sum: Tensor


@dataclass(frozen=True)
class RenderOutput:
    """Images of one camera, and what happened to each surfel.

    ``rgb`` [H,W,3] over the background (premultiplied colour without one); ``alpha`` [H,W];
    ``depth`` [H,W] sum(w z) / alpha, 0 where alpha is 0; ``dropped`` counts surfels left out because of NaN,
    infinite, zero or negative numbers.
    With ``outputs="all"``: ``median_depth`` [H,W] (0 where nothing was met); ``normal`` [H,W,3] sum(w n) in
    camera coordinates, each n turned to the camera; ``distortion`` [H,W] sum over pairs of w_i w_j (m_i -
    m_j)^2; ``weight_sum`` [N] sum of each surfel's blending weights over the image (no gradient; 0 is not
    visible).
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    dropped: int
    extras: Extras | None = None

    def _extras(self) -> Extras:
        if self.extras is None:
            raise BadArgumentError(
                "raster.output_not_computed",
                "This output was not asked for.",
                "Rasterise with RasterOptions(outputs='all').",
            )
        return self.extras

    @property
    def median_depth(self) -> Tensor:
        return self._extras().median_depth

    @property
    def normal(self) -> Tensor:
        return self._extras().normal

    @property
    def distortion(self) -> Tensor:
        return self._extras().distortion

    @property
    def weight_sum(self) -> Tensor:
        return self._extras().weight_sum
