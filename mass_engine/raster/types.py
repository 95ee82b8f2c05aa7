"""What goes into the rasteriser besides surfels, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from torch import Tensor

from mass_engine.errors import BadArgumentError

Backend = Literal["auto", "cpu", "cuda", "reference"]
Outputs = Literal["color", "all"]
Convention = Literal["exact", "inria", "gsplat"]
InstructionSet = Literal["auto", "avx512", "avx2", "portable", "scalar"]
Optimization = Literal[
    "tight_bounds", "blocks", "short_path", "early_stop", "empty_tiles", "reuse", "fast_sort"
]

# The numbers the result depends on, as in kernels/constants.hpp (a test compares the two).
ALPHA_MAX = 0.99
ALPHA_CUT = 1.0 / 255.0
TRANSMITTANCE_STOP = 1e-4
LOW_PASS = 2.0
MEDIAN_TRANSMITTANCE = 0.5
EDGE_ON_COSINE = 1e-4
LEAST_SINE2 = 1e-12
LEAST_AREA2 = 1e-37
INRIA_REACH = 3.0
GSPLAT_REACH = 3.33

OPTIMIZATIONS: tuple[Optimization, ...] = get_args(Optimization)


@dataclass(frozen=True)
class RasterOptions:
    """How to rasterise.

    ``outputs``: "color" is rgb, alpha and depth; "all" adds median depth, normal, distortion and weight_sum.
    ``near``: surfels whose centre is nearer than this (scene units) are not drawn, parts of a disk nearer
    than this are not met by their rays; None is the convention's own (0.01; "inria" 0.2).
    ``window`` (x, y, width, height) in pixels renders that part of the camera's image. ``cull_backfaces``
    drops surfels whose normal points away from the camera. ``distortion_range``: the near and far that map
    depth to [0, 1] in the distortion output; take them around the object, or its value is numerically dead.
    ``convention``: "exact", or the bounds and depth of another renderer, so that its assets look as they do
    there: "inria" (hbb1/diff-surfel-rasterization) draws whole 16-pixel tiles around three standard
    deviations, "gsplat" around 3.33 of them, and gives every pixel of a surfel its centre's depth.
    ``threads``: None is every core this process may use. ``instruction_set`` and ``without`` (optimisations
    of the "cpu" backend to leave out) do not change the image: they are there to measure.
    ``pair_capacity``: room for pairs of surfel and 16-pixel tile in the "cuda" backend's memory. None: as
    many as the frame needs, for which the host waits. A number: nothing waits, and a frame that needs more
    lacks surfels (``raster.cuda.check_counters``).
    """

    backend: Backend = "auto"
    outputs: Outputs = "color"
    cull_backfaces: bool = False
    near: float | None = None
    window: tuple[int, int, int, int] | None = None
    distortion_range: tuple[float, float] = (0.1, 10.0)
    convention: Convention = "exact"
    threads: int | None = None
    instruction_set: InstructionSet = "auto"
    without: frozenset[Optimization] = frozenset()
    pair_capacity: int | None = None

    def check(self) -> None:
        """Raise ``BadArgumentError`` when a value makes no sense."""
        _one_of("backend", self.backend, get_args(Backend))
        _one_of("outputs", self.outputs, get_args(Outputs))
        _one_of("convention", self.convention, get_args(Convention))
        _one_of("instruction_set", self.instruction_set, get_args(InstructionSet))
        for name in self.without:
            _one_of("without", name, OPTIMIZATIONS)
        if not self.near_plane > 0:
            raise BadArgumentError("raster.near", f"near is {self.near}.", "Give a positive distance.")
        if not 0 < self.distortion_range[0] < self.distortion_range[1]:
            raise BadArgumentError(
                "raster.distortion_range",
                f"distortion_range is {self.distortion_range}.",
                "Give two distances, 0 < near < far.",
            )
        if self.threads is not None and self.threads < 1:
            raise BadArgumentError("raster.threads", f"threads is {self.threads}.", "Give at least 1.")
        if self.pair_capacity is not None and not 0 < self.pair_capacity < 1 << 31:
            raise BadArgumentError(
                "raster.pair_capacity",
                f"pair_capacity is {self.pair_capacity}.",
                "Give a number from 1 to 2147483647.",
            )

    @property
    def near_plane(self) -> float:
        """``near``, or the convention's own."""
        if self.near is not None:
            return self.near
        return 0.2 if self.convention == "inria" else 0.01

    @property
    def center_depth(self) -> bool:
        """Does every pixel of a surfel have its centre's depth?"""
        return self.convention == "gsplat"

    @property
    def distortion_scale(self) -> float:
        """``b`` in m = a - b / z, the map of z to [0, 1] over ``distortion_range`` (``a`` cancels)."""
        near, far = self.distortion_range
        return near * far / (far - near)


def _one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise BadArgumentError(f"raster.{name}", f"No {name} {value!r}.", f"Use {', '.join(allowed)}.")


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
    ``depth`` [H,W] sum(w z) / alpha, 0 where alpha is 0; ``dropped`` counts surfels left out because of NaN
    or infinite numbers or because they have no area.
    With ``outputs="all"``: ``median_depth`` [H,W] (0 where nothing was met); ``normal`` [H,W,3] sum(w n) in
    camera coordinates, each n turned to the camera; ``distortion`` [H,W] sum over pairs of w_i w_j (m_i -
    m_j)^2; ``weight_sum`` [N] sum of each surfel's blending weights over the image (no gradient; 0 is not
    visible).
    On a GPU with ``pair_capacity`` nobody waited for the count: ``dropped`` is -1, and ``counters`` [3] are
    on the device, for ``raster.cuda.check_counters``.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    dropped: int
    extras: Extras | None = None
    counters: Tensor | None = None

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
