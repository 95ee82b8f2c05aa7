"""The kernels beside the rasteriser's, emulated: what torch's operators do, in value and in gradient."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from torch import Tensor

from mass_engine import gpu
from mass_engine.deform.decoder import Layers, Units, decode_reference
from mass_engine.deform.hashgrid import HashGrid, HashGridConfig
from mass_engine.deform.residuals import Residuals, deform_by, deform_reference
from mass_engine.fitting import losses
from mass_engine.surfel.binding import AttachedSurfels
from mass_engine.surfel.fixed_product import to_torch_csr

Way = Callable[[AttachedSurfels, Residuals], AttachedSurfels]


def fixed(rows: int, columns: int, each: int, seed: int) -> sp.csr_array:
    """A matrix with up to ``each`` entries a row, some rows empty."""
    random = np.random.default_rng(seed)
    counts = random.integers(0, each + 1, rows)
    at = np.repeat(np.arange(rows), counts)
    where = random.integers(0, columns, len(at))
    made = sp.csr_array(sp.coo_array((random.normal(size=len(at)), (at, where)), shape=(rows, columns)))
    made.sum_duplicates()
    return made


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 6, 9])
@pytest.mark.parametrize("each", [8, 200])
def test_a_fixed_product_and_its_transpose(emulated: ModuleType, each: int, channels: int) -> None:
    matrix = fixed(150, 300, each, each + channels)
    for one in (to_torch_csr(matrix), to_torch_csr(sp.csr_array(matrix.T))):
        dense = torch.randn(one.shape[1], channels, generator=torch.Generator().manual_seed(1))
        found = gpu.sparse_product(emulated, one, dense)
        wanted = torch.mm(one.double(), dense.double())
        torch.testing.assert_close(found.double(), wanted, rtol=1e-5, atol=1e-5 * float(wanted.abs().max()))


def test_the_lookup_in_a_hash_grid_and_its_gradient(
    emulated: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = torch.Generator().manual_seed(0)
    points, faces = torch.rand(400, 3, generator=random), torch.randint(0, 30, (400,), generator=random)
    grid = HashGrid(HashGridConfig(levels=4, table_bits=9), points, faces, 30, random)
    weights = torch.randn(400, grid.config.width, generator=random)
    results = []
    for kernels in (None, emulated):
        monkeypatch.setattr(gpu, "kernels_for", lambda _, kernels=kernels: kernels)
        features = grid()
        gradients = torch.autograd.grad((features * weights).sum(), list(grid.parameters()))
        results.append((features.detach(), *gradients))
    for wanted, found in zip(*results, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6 * float(wanted.abs().max()))


def pictures(height: int, width: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    smooth = torch.nn.functional.avg_pool2d
    both = torch.rand(2, 3, height + 4, width + 4, generator=random)
    seen, wanted = smooth(both, 5, 1).movedim(1, -1)
    seen[: height // 3] = 0.4  # flat: no variance
    inside = (torch.rand(height, width, generator=random) > 0.3).float()
    return seen.contiguous(), wanted.contiguous(), inside


@pytest.mark.parametrize("size", [(16, 16), (40, 55), (5, 70), (1, 1)])
def test_structural_loss_and_its_gradient(emulated: ModuleType, size: tuple[int, int]) -> None:
    seen, wanted, inside = pictures(*size, seed=sum(size))
    exact = seen.double().requires_grad_(True)
    expected = losses.dssim(exact, wanted.double(), inside.double())
    (slope,) = torch.autograd.grad(3 * expected, exact)
    ours = seen.clone().requires_grad_(True)
    found = gpu.dssim(emulated, ours, wanted, inside)
    (mine,) = torch.autograd.grad(3 * found, ours)
    assert float(found.detach()) == pytest.approx(float(expected.detach()), rel=1e-4, abs=1e-7)
    # Where nothing varies, rounding decides which side of the clamp a variance is on.
    apart = (mine - slope.float()).abs()
    scale = float(slope.abs().max())
    assert float(apart.mean()) <= 1e-3 * scale + 1e-9
    assert float((apart > 1e-2 * scale).float().mean()) <= 0.02


def test_nothing_inside_is_no_loss(emulated: ModuleType) -> None:
    seen, wanted, inside = pictures(20, 20, 3)
    seen.requires_grad_(True)
    loss = gpu.dssim(emulated, seen, wanted, torch.zeros_like(inside))
    (slope,) = torch.autograd.grad(loss, seen)
    assert float(loss) == 0
    assert not bool(slope.any())


def test_the_fit_uses_the_kernels_where_there_are_any(
    emulated: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "kernels_for", lambda _: emulated)
    seen, wanted, inside = pictures(30, 30, 4)
    assert float(losses.dssim(seen, wanted, inside)) == float(gpu.dssim(emulated, seen, wanted, inside))


@pytest.mark.parametrize("count", [1, 300])
def test_what_residuals_do_to_surfels_and_its_gradient(emulated: ModuleType, count: int) -> None:
    random = torch.Generator().manual_seed(count)

    def normal(*shape: int) -> Tensor:
        return torch.randn(2, count, *shape, generator=random)

    normals = torch.nn.functional.normalize(normal(3), dim=-1)
    across = torch.linalg.cross(normals, normal(3))
    tangents = 1e-3 * torch.stack([across, torch.linalg.cross(normals, across) + 0.2 * across], -2)
    given = (normal(3), tangents, normals, 1e-3 * normal(3), 0.3 * normal(2), 0.2 * normal(3))
    weights = (normal(3), 1e3 * normal(2, 3), normal(3))

    def results(
        way: Callable[[AttachedSurfels, Residuals], AttachedSurfels], *values: Tensor
    ) -> list[Tensor]:
        leaves = [value.clone().requires_grad_(True) for value in values]
        out = way(AttachedSurfels(*leaves[:3]), Residuals(leaves[3], leaves[4], leaves[5], normal()))
        images = (out.means, out.tangents, out.normals)
        upstream = [weight.to(values[0]) for weight in weights]
        return [*(i.detach() for i in images), *torch.autograd.grad(images, leaves, upstream)]

    passes = gpu.deform_passes(emulated)
    found = results(lambda surfels, changes: deform_by(passes, surfels, changes), *given)
    wanted = results(deform_reference, *(value.double() for value in given))
    for mine, other in zip(found, wanted, strict=True):
        scale = float(other.abs().max())
        torch.testing.assert_close(mine.double(), other, rtol=1e-4, atol=2e-6 * scale)


@pytest.mark.parametrize("hidden", gpu.DECODER_WIDTHS)
@pytest.mark.parametrize(("count", "batch"), [(1, 1), (150, 2)])
def test_the_decoder_and_its_gradient(emulated: ModuleType, hidden: int, count: int, batch: int) -> None:
    random = torch.Generator().manual_seed(hidden + count)
    shapes = ((count, hidden), (batch, hidden), (hidden, hidden), (hidden,), (hidden, 9), (9,))
    given = [torch.randn(shape, generator=random) / shape[-1] ** 0.5 for shape in shapes]
    units = Units(1e-3, 0.1)
    upstream = [torch.randn(batch, count, *end, generator=random) for end in ((3,), (2,), (3,), ())]
    leaves = [value.double().requires_grad_(True) for value in given]
    exact = decode_reference(leaves[0], leaves[1], Layers(*leaves[2:]), units)
    wanted = [exact.offset, exact.log_scale, exact.rotation, exact.mask_logit]
    wanted += torch.autograd.grad(wanted, leaves, [value.double() for value in upstream])
    ours = [value.clone().requires_grad_(True) for value in given]
    found = list(gpu.decode(emulated, units, *ours))
    found += torch.autograd.grad(found, ours, upstream)
    for mine, other in zip(found, wanted, strict=True):
        scale = float(other.detach().abs().max())
        torch.testing.assert_close(mine.double(), other, rtol=1e-4, atol=1e-5 * scale)


def test_the_decoder_sums_alike_each_time(emulated: ModuleType) -> None:
    random = torch.Generator().manual_seed(0)
    shapes = ((200, 32), (1, 32), (32, 32), (32,), (32, 9), (9,))
    given = [torch.randn(shape, generator=random).requires_grad_(True) for shape in shapes]
    runs = []
    for _ in range(2):
        out = gpu.decode(emulated, Units(1e-3, 0.1), *given)
        runs.append(torch.autograd.grad([value.sum() for value in out], given))
    for first, second in zip(*runs, strict=True):
        assert torch.equal(first, second)
