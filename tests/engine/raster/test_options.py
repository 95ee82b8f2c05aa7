"""What the options promise: other renderers' conventions, windows, and optimisations that change no bit."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mass_engine.camera import Camera
from mass_engine.raster import RasterOptions, rasterize
from mass_engine.raster.cpu import Call
from mass_engine.raster.types import OPTIMIZATIONS, Backend, Convention, Optimization
from mass_engine.surfel.inellipse import principal_tangents
from tests.engine.raster.scenes import EVERYTHING, Surfels, camera, images, render, surfels, with_gradients


@pytest.mark.parametrize("name", OPTIMIZATIONS)
@pytest.mark.parametrize("kind", ["overlapping", "tiny", "opaque", "huge"])
def test_an_optimization_changes_no_bit(name: Optimization, kind: str) -> None:
    scene, view = surfels(kind, 400, 5), camera(90, 70)
    scene = replace(scene, tangents=scene.tangents * (1.0 if kind == "huge" else 0.4))
    with_it, gradients = with_gradients(scene, view, EVERYTHING, torch.float32)
    options = replace(EVERYTHING, without=frozenset({name}))
    without, other = with_gradients(scene, view, options, torch.float32)
    for key, image in images(with_it).items():
        assert torch.equal(image, images(without)[key]), key
    assert torch.equal(with_it.weight_sum, without.weight_sum)
    for key, gradient in gradients.items():
        if name in ("tight_bounds", "blocks"):  # sums over tiles are taken in another order
            assert float((gradient - other[key]).norm()) <= 1e-5 * float(gradient.norm()), key
        else:
            assert torch.equal(gradient, other[key]), key


def profile(scene: Surfels, view: Camera, options: RasterOptions) -> dict[str, float]:
    call = Call(view.width, view.height, options, keep_frame=True)
    with torch.no_grad():
        call.run(*scene.tensors(), view.world_to_camera, view.K)
    assert call.frame is not None
    return {**call.frame.profile, "pairs": call.frame.pairs}


def test_optimizations_save_work() -> None:
    scene, view = surfels("faint", 400, 5), camera(90, 70)
    every = profile(scene, view, EVERYTHING)
    assert every["blocks"] > 0
    blocks: Optimization
    for blocks in ("tight_bounds", "blocks"):
        less = profile(scene, view, replace(EVERYTHING, without=frozenset({blocks})))
        assert less["blocks"] > every["blocks"], blocks
    solid = surfels("opaque", 4000, 5)
    early = replace(EVERYTHING, without=frozenset({"early_stop"}))
    assert profile(solid, view, early)["blocks"] > profile(solid, view, EVERYTHING)["blocks"]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_window_is_a_part_of_the_image(backend: Backend) -> None:
    scene, view = surfels("overlapping", 100, 1), camera(61, 43)
    background = torch.rand(20, 30, 3)
    options = replace(EVERYTHING, backend=backend)
    whole = render(scene, view, options)
    part = rasterize(
        *scene.tensors(), view, background=background, options=replace(options, window=(11, 7, 30, 20))
    )
    assert part.rgb.shape == (20, 30, 3)
    torch.testing.assert_close(part.alpha, whole.alpha[7:27, 11:41], atol=2e-3, rtol=0)
    torch.testing.assert_close(
        part.rgb, whole.rgb[7:27, 11:41] + (1 - part.alpha)[..., None] * background, atol=2e-3, rtol=0
    )


def disk(scale: float, opacity: float, tilt: float = 0.0, z: float = 1.0) -> Surfels:
    half = torch.tensor([tilt / 2])
    quats = torch.stack([half.cos(), torch.zeros(1), half.sin(), torch.zeros(1)], -1)
    tangents = principal_tangents(torch.full((1, 2), scale), quats)
    return Surfels(torch.tensor([[0.0, 0.0, z]]), tangents, torch.tensor([opacity]), torch.ones(1, 3))


def alpha(scene: Surfels, convention: Convention, size: int = 160) -> torch.Tensor:
    view = Camera.from_fov(size, size, 2 * 45.0)  # size / 2 pixels a unit at z = 1
    return rasterize(*scene.tensors(), view, options=RasterOptions(convention=convention)).alpha


def test_bounds_of_the_conventions() -> None:
    # sigma is 8 px: the cut at full opacity lies at 3.33 sigma, 26.6 px from the middle (80).
    scene = disk(0.1, 1.0)
    exact, inria, gsplat = (alpha(scene, c) for c in ("exact", "inria", "gsplat"))
    row = [int((image[80] > 0).sum()) for image in (exact, inria, gsplat)]
    assert row == [54, 54, 54]  # the edges of their tiles lie beyond the cut
    shifted = disk(0.1, 1.0)
    shifted.means[0, 0] = 0.125  # 10 px: three sigma (24 px) end in the next tile, which is drawn whole
    exact, inria = alpha(shifted, "exact"), alpha(shifted, "inria")
    assert int((exact[80] > 0).nonzero().max()) == 116
    assert int((inria[80] > 0).nonzero().max()) == 116
    assert int((exact[80] > 0).nonzero().min()) == 63
    assert int((inria[80] > 0).nonzero().min()) == 64
    shifted.means[0, 0] = 0.085  # 6.8 px: three sigma end at 110.8, before the tile edge
    exact, inria, gsplat = (alpha(shifted, c) for c in ("exact", "inria", "gsplat"))
    assert int((exact[80] > 0).nonzero().max()) == 112
    assert int((inria[80] > 0).nonzero().max()) == 111  # cut at the tile's edge, at alpha above 1/255
    assert int((gsplat[80] > 0).nonzero().max()) == 112
    # A speck at a tile's border: its low-pass part reaches 2.35 px, which gsplat leaves out.
    speck = disk(1e-5, 1.0)
    speck.means[0, 0] = 0.02  # pixel 81.6, tile 80 to 95
    exact, inria, gsplat = (alpha(speck, c) for c in ("exact", "inria", "gsplat"))
    assert int((exact[80] > 0).nonzero().min()) == 79
    assert int((inria[80] > 0).nonzero().min()) == 79
    assert int((gsplat[80] > 0).nonzero().min()) == 80


def test_depth_of_the_conventions() -> None:
    view = Camera.from_fov(160, 160, 90.0)
    scene = disk(0.1, 0.9, tilt=0.6)
    depth = {
        c: rasterize(*scene.tensors(), view, options=RasterOptions(convention=c, outputs="all"))
        for c in ("exact", "inria", "gsplat")
    }
    covered = depth["exact"].alpha > 0.5
    assert float(depth["exact"].depth[covered].std()) > 0.02
    assert torch.equal(depth["exact"].depth[covered], depth["inria"].depth[covered])
    for image in (depth["gsplat"].depth, depth["gsplat"].median_depth):
        torch.testing.assert_close(image[covered], torch.ones(int(covered.sum())), atol=1e-6, rtol=0)


def test_near_plane_of_the_conventions() -> None:
    near = disk(0.01, 0.9, z=0.15)
    assert float(alpha(near, "exact").max()) > 0.5
    assert float(alpha(near, "gsplat").max()) > 0.5
    assert float(alpha(near, "inria").max()) == 0.0
    view = Camera.from_fov(160, 160, 90.0)
    shown = rasterize(*near.tensors(), view, options=RasterOptions(convention="inria", near=0.1))
    assert float(shown.alpha.max()) > 0.5


def test_buffers_are_reused_from_frame_to_frame() -> None:
    scene, view = surfels("overlapping", 500, 2), camera()
    options = replace(EVERYTHING, instruction_set="portable")

    def size() -> int:
        call = Call(view.width, view.height, options, keep_frame=True)
        call.run(*(t.requires_grad_() for t in scene.tensors()), view.world_to_camera, view.K)
        assert call.frame is not None
        return call.frame.bytes

    first = size()
    assert first > 0
    assert [size() for _ in range(5)] == [first] * 5


def test_principal_tangents_pass_gradients_and_mark_what_has_no_area() -> None:
    generator = torch.Generator().manual_seed(0)
    scales = (0.1 + torch.rand(5, 2, generator=generator)).double().requires_grad_()
    quats = torch.randn(5, 4, generator=generator).double().requires_grad_()
    assert torch.autograd.gradcheck(principal_tangents, (scales, quats))
    spoilt_scales, spoilt_quats = scales.detach().clone(), quats.detach().clone()
    spoilt_scales[0, 0], spoilt_scales[1, 1], spoilt_quats[2], spoilt_quats[3, 1] = 0.0, -1.0, 0.0, torch.nan
    leaves = [spoilt_scales.requires_grad_(), spoilt_quats.requires_grad_()]
    tangents = principal_tangents(*leaves)
    assert bool(tangents[:4].isnan().any(-1).any(-1).all())
    gradients = torch.autograd.grad(tangents[4].sum(), leaves)
    for gradient in gradients:
        assert bool(gradient.isfinite().all())
        assert float(gradient[:4].abs().max()) == 0.0
