"""What a step over the surfels of one frame minimises: one definition for every way a step is run."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.fitting import losses, regularisers
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, PosedSurfels, render_row
from mass_engine.fitting.views import Level
from mass_engine.raster import RasterOptions, RenderOutput

#: The hand's usual length, metres: the unit of depth distortion.
HAND_SIZE = 0.18


@dataclass(frozen=True)
class SurfelWeights:
    """What the terms weigh. ``binding`` names the loss; ``delta`` metres is how far a detached surfel may be
    from its face for nothing; ``still`` holds the residuals (in their units) towards none, ``settled`` the
    static ones. ``holes``: how
    much more than what sticks out a hole counts where attached surfels may leave the outline (where they may
    not, it would only make the hand fatter)."""

    silhouette: float = 0.5
    binding: str = "additive"
    binding_weight: float = 1.0
    delta: float = 5e-4
    normal: float = 0.02
    distortion: float = 10.0
    still: float = 0.01
    settled: float = 0.03
    holes: float = 1.5


@dataclass(frozen=True)
class Frame:
    """One frame as a step looks at it.

    ``level`` are its pixels, ``depth`` (scalar, metres) the hand's distance, ``gain`` [3] multiplies its
    colours (None: 1). ``window`` is where structure is compared: rows and columns, or None for everywhere.
    A picture that is padded to the size of others says which pixels are ``present`` [h,w] and which have four
    present neighbours (``inner`` [h,w]), both 0 or 1, and gives the inverse of its K, which is found by
    waiting for the device otherwise.
    """

    level: Level
    depth: Tensor
    gain: Tensor | None = None
    window: tuple[slice, slice] | None = None
    present: Tensor | None = None
    inner: Tensor | None = None
    K_inverse: Tensor | None = None


def shaped_options(options: RasterOptions, depth: float) -> RasterOptions:
    """``options`` with every output, and a range of depths around a hand ``depth`` metres away."""
    return RasterOptions(
        outputs="all",
        cull_backfaces=options.cull_backfaces,
        distortion_range=(0.5 * depth, 2.0 * depth),
    )


def render_frame(
    appearance: Appearance,
    bones: Tensor,
    frame: Frame,
    surfels: PosedSurfels,
    options: RasterOptions,
    background: Tensor | None = None,
) -> tuple[RenderOutput, Tensor]:
    """The frame's hand before ``background`` [3], and its colours [h,w,3] with the frame's gain."""
    out = render_row(appearance, surfels, 0, bones, frame.level.camera, options, background)
    rgb = out.rgb
    if frame.gain is not None:
        behind = torch.zeros_like(frame.gain) if background is None else background
        through = (1 - out.alpha).unsqueeze(-1) * behind
        rgb = (rgb - through) * frame.gain + through
    return out, rgb


def surfel_loss(
    appearance: Appearance,
    skin: Skin,
    frame: Frame,
    surfels: PosedSurfels,
    background: Tensor,
    options: RasterOptions,
    weights: SurfelWeights,
    dssim: float,
    geometry: bool,
) -> tuple[Tensor, RenderOutput]:
    """The loss (scalar) of one frame's surfels before ``background`` [3], and the render it is of.

    ``geometry`` adds what shapes the surfels; ``options`` with all outputs where normals or distortion weigh
    anything.
    """
    w, level = weights, frame.level
    out, rgb = render_frame(appearance, skin.bones, frame, surfels, options, background)
    area = level.hand.sum().clamp_min(16.0)
    cover = level.hand.unsqueeze(-1)
    target = level.rgb * cover + background * (1 - cover)
    loss = losses.photometric(rgb, target, level.colored, area)
    if dssim > 0:
        inside = level.colored * (level.hand > 0)
        seen, wanted = rgb, target
        if frame.window is not None:
            seen, wanted, inside = rgb[frame.window], target[frame.window], inside[frame.window]
        if frame.present is not None:
            # Beyond a picture's border there is nothing, as beyond a smaller picture's.
            seen, wanted = (value * frame.present.unsqueeze(-1) for value in (seen, wanted))
        structure = losses.dssim(seen, wanted, inside)
        loss = (1 - dssim) * loss + dssim * 2 * structure
    static = None if geometry else skin.static
    holes = 0.0 if static is None else w.holes
    loss = loss + w.silhouette * losses.silhouette(out.alpha, level.hand, level.valid, area, holes=holes)
    if static is not None:
        loss = loss + w.settled * static.size()
    if not geometry:
        return loss, out
    if options.outputs == "all":
        loss = loss + w.distortion * regularisers.depth_distortion(
            out.distortion, level.valid, area, options, frame.depth, HAND_SIZE
        )
        valid = level.valid if frame.inner is None else level.valid * frame.inner
        loss = loss + w.normal * regularisers.normal_consistency(
            out.median_depth, out.normal, out.alpha, level.camera.K, valid, area, frame.K_inverse
        )
    return loss + _held(weights, skin, surfels), out


def _held(weights: SurfelWeights, skin: Skin, surfels: PosedSurfels) -> Tensor:
    """What binds the detached surfels to the mesh."""
    w = weights
    if surfels.residuals is None:
        return surfels.attached.means.new_zeros(())
    attached, start = surfels.attached, skin.detached_from
    means, normals = attached.means[:, start:], attached.normals[:, start:]
    residuals = surfels.residuals
    config = skin.deformation.config if skin.deformation is not None else None
    assert config is not None
    still = (residuals.offset / config.offset_unit).square().mean() + residuals.log_scale.square().mean()
    loss = w.still * (still + (residuals.rotation / config.rotation_unit).square().mean())
    if w.binding == "none":
        return loss * 0.0
    triangles = skin.triangles(surfels.outline_vertices)
    if w.binding == "paper":
        return loss + w.binding_weight * regularisers.binding_paper(means, normals, triangles, w.delta)
    return loss + w.binding_weight * regularisers.binding_additive(means, normals, triangles, w.delta)
