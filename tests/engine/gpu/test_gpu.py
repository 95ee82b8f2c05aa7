"""On a GPU: the kernels against torch, the graph of a fit and of many poses against the CPU.

Collected only where there is a GPU.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mass_engine import gpu
from mass_engine.deform.decoder import Layers, Units, decode, decode_reference
from mass_engine.deform.residuals import Residuals, deform, deform_reference
from mass_engine.device import memory_error
from mass_engine.fitting import losses
from mass_engine.fitting.surfel_fit import SurfelFit, SurfelPass
from mass_engine.many_poses import ManyPoses
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import AttachedSurfels
from mass_engine.surfel.fixed_product import to_torch_csr
from tests.engine.fitting.test_static_pass import learned, odd_scene
from tests.engine.gpu.test_emulated import fixed, pictures
from tests.engine.test_many_poses import cameras, poses_of, rich_avatar

CUDA = torch.device("cuda", 0)


def test_the_kernels_were_built() -> None:
    assert gpu.shared_kernels() is not None


@pytest.mark.parametrize("each", [8, 200])
def test_sparse_products(each: int) -> None:
    matrix = to_torch_csr(fixed(3000, 500, each, 0))
    dense = torch.randn(500, 6)
    found = gpu.sparse_product(gpu.shared_kernels(), matrix.to(CUDA), dense.to(CUDA)).cpu()
    torch.testing.assert_close(found, torch.mm(matrix, dense), rtol=1e-4, atol=1e-4)


def test_the_structural_loss() -> None:
    seen, wanted, inside = pictures(301, 217, 0)
    results = []
    for device in (torch.device("cpu"), CUDA):
        leaf = seen.to(device).requires_grad_(True)
        loss = losses.dssim(leaf, wanted.to(device), inside.to(device))
        results.append((loss.detach().cpu(), torch.autograd.grad(loss, leaf)[0].cpu()))
    assert float(results[1][0]) == pytest.approx(float(results[0][0]), rel=1e-4)
    apart = (results[1][1] - results[0][1]).abs()
    assert float(apart.mean()) <= 1e-3 * float(results[0][1].abs().max())


def test_the_deformation() -> None:
    random = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=random)

    shapes = ((5000, 32), (2, 32), (32, 32), (32,), (32, 9), (9,))
    given = [normal(*shape) / shape[-1] ** 0.5 for shape in shapes]
    attached = [normal(2, 5000, 3), 1e-3 * normal(2, 5000, 2, 3), normal(2, 5000, 3)]
    attached[2] = torch.nn.functional.normalize(attached[2], dim=-1)

    def run(device: torch.device, exact: bool) -> list[Tensor]:
        dtype = torch.float64 if exact else torch.float32
        leaves = [value.to(device, dtype).requires_grad_(True) for value in given]
        way, move = (decode_reference, deform_reference) if exact else (decode, deform)
        residuals: Residuals = way(leaves[0], leaves[1], Layers(*leaves[2:]), Units(1e-3, 0.1))
        moved = move(AttachedSurfels(*(value.to(device, dtype) for value in attached)), residuals)
        out = [moved.means, 1e3 * moved.tangents, moved.normals, residuals.mask_logit]
        total = sum((value.square().sum() for value in out), torch.zeros((), device=device))
        found = [*out, *torch.autograd.grad(total, leaves)]
        return [value.detach().cpu().double() for value in found]

    for mine, other in zip(run(CUDA, False), run(torch.device("cpu"), True), strict=True):
        assert float((mine - other).norm()) <= 1e-4 * float(other.norm()) + 1e-9


@pytest.mark.parametrize("stage", [SurfelPass(200, 2), SurfelPass(200, 2, geometry=True)])
def test_a_pass_as_one_graph_reaches_what_the_cpu_reaches(stage: SurfelPass) -> None:
    reached = []
    for device, static in ((torch.device("cpu"), False), (CUDA, False), (CUDA, True), (CUDA, True)):
        scene = replace(odd_scene(), compute=device)
        skin, look = learned(scene)
        result = SurfelFit(scene, static=static).run(skin, look, stage, 0)
        assert look.albedo.device.type == "cpu"
        reached.append((result, look.albedo.clone()))
    results = [result for result, _ in reached]
    assert {result.visits for result in results} == {results[0].visits}
    for result in results[1:]:
        assert result.before == pytest.approx(results[0].before, abs=0.01)
        assert result.after == pytest.approx(results[0].after, abs=0.05)
    assert torch.equal(reached[2][1], reached[3][1]), "the same bits twice"


def test_many_poses_as_one_graph_are_what_the_cpu_draws() -> None:
    avatar = rich_avatar()
    poses, views = poses_of(avatar, 11), cameras(avatar, 11)[:11]
    options = RasterOptions(cull_backfaces=True)
    size = avatar.camera.width, avatar.camera.height
    drawn = []
    for device in (torch.device("cpu"), CUDA):
        many = ManyPoses(avatar.shape, avatar.posable(), *size, device, 4, options)
        drawn.append([out.rgb.cpu() for _, out in many.render(poses, views)])
    for here, there in zip(*drawn, strict=True):
        assert float(((here - there).abs() > 1e-3).float().mean()) < 0.005


def test_a_full_gpu_is_told_from_other_errors() -> None:
    with pytest.raises(torch.OutOfMemoryError) as caught:
        torch.empty(1 << 44, dtype=torch.uint8, device=CUDA)
    assert memory_error(caught.value) is not None
