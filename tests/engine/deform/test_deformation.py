"""The deformation: identity when untrained, what each residual does, gradients, weights in and out."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from mass_engine.deform import _kernels
from mass_engine.deform.network import DeformationConfig
from mass_engine.deform.residuals import Residuals, deform, deform_reference, opacity_mask
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.hand.rotation import axis_angle_to_matrix
from mass_engine.surfel.binding import AttachedSurfels
from tests.engine.deform.hands import deformation, poses, rest_surfels, trained


def batched(surfels: AttachedSurfels, count: int, dtype: torch.dtype = torch.float32) -> AttachedSurfels:
    """The first ``count`` surfels as a batch of one."""
    return AttachedSurfels(
        surfels.means[None, :count].to(dtype),
        surfels.tangents[None, :count].to(dtype),
        surfels.normals[None, :count].to(dtype),
    )


def nothing(count: int, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    shapes = {"offset": (3,), "log_scale": (2,), "rotation": (3,), "mask_logit": ()}
    return {name: torch.zeros(1, count, *shape, dtype=dtype) for name, shape in shapes.items()}


def test_untrained_it_is_the_identity() -> None:
    surfels, *_ = rest_surfels()
    residuals = deformation()(*poses(2))
    for value in (residuals.offset, residuals.log_scale, residuals.rotation, residuals.mask_logit):
        assert not bool(value.any())
    assert bool((residuals.mask == 1).all())
    count = len(surfels.means)
    both = AttachedSurfels(
        surfels.means.expand(2, count, 3),
        surfels.tangents.expand(2, count, 2, 3),
        surfels.normals.expand(2, count, 3),
    )
    after = deform(both, residuals)
    assert torch.equal(after.means, both.means)
    assert torch.equal(after.normals, both.normals)
    assert torch.equal(after.tangents, both.tangents)


def test_an_untrained_head_learns_and_then_everything_does() -> None:
    module = deformation(count=30)
    hand_pose, betas = poses(2)
    optimizer = torch.optim.Adam(module.parameters(), lr=1e-2)
    target = torch.rand(2, 30, 3, generator=torch.Generator().manual_seed(0)) * 1e-3
    losses = []
    for _ in range(300):
        optimizer.zero_grad()
        loss = ((module(hand_pose, betas).offset - target) * 1e3).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.05 * losses[0]
    assert all(value.grad is not None and bool(value.grad.any()) for value in module.grid.parameters())


def test_offset_follows_the_surfels_frame() -> None:
    surfels, *_ = rest_surfels()
    one = batched(surfels, 6)
    offset = torch.tensor([1e-3, -2e-3, 3e-3])
    after = deform(one, Residuals(**{**nothing(6), "offset": offset.expand(1, 6, 3)}))
    moved = after.means - one.means
    assert torch.allclose((moved * one.normals).sum(-1), torch.tensor(3e-3), atol=1e-7)
    assert torch.allclose(moved.norm(dim=-1), offset.norm().expand(1, 6), atol=1e-7)
    # The whole hand turned: the offset turns with it.
    turn = axis_angle_to_matrix(torch.tensor([0.3, -1.0, 0.5]))
    turned = AttachedSurfels(one.means @ turn.T, one.tangents @ turn.T, one.normals @ turn.T)
    again = deform(turned, Residuals(**{**nothing(6), "offset": offset.expand(1, 6, 3)}))
    assert torch.allclose(again.means, after.means @ turn.T, atol=1e-6)


def test_rotation_is_the_one_of_its_axis() -> None:
    surfels, *_ = rest_surfels()
    one = batched(surfels, 6, torch.float64)
    w = torch.tensor([0.2, -0.4, 0.3], dtype=torch.float64)
    after = deform(one, Residuals(**{**nothing(6, torch.float64), "rotation": w.expand(1, 6, 3)}))
    t = one.tangents[..., 0, :] / one.tangents[..., 0, :].norm(dim=-1, keepdim=True)
    frame = torch.stack([t, torch.linalg.cross(one.normals, t), one.normals], -1)
    angle = 2 * math.atan(float(w.norm()) / 2)
    turn = frame @ axis_angle_to_matrix(w / w.norm() * angle) @ frame.mT
    assert torch.allclose(after.normals, (turn @ one.normals.unsqueeze(-1)).squeeze(-1), atol=2e-5)
    assert torch.allclose(after.tangents, one.tangents @ turn.mT, atol=1e-7)
    assert torch.equal(after.means, one.means)


def test_scales_stay_positive_and_within_a_factor_of_two() -> None:
    module = trained()
    with torch.no_grad():
        module.head.mul_(100)
    surfels, *_ = rest_surfels()
    hand_pose, betas = poses(1)
    residuals = module(hand_pose, betas)
    assert float(residuals.log_scale.detach().abs().max()) <= math.log(2) + 1e-6
    one = batched(surfels, len(surfels.means))
    before, _ = one.scales_quats()
    after, _ = deform(one, residuals).scales_quats()
    ratio = (after / before).detach()
    assert 0.499 < float(ratio.min()) < 0.6
    assert 1.9 < float(ratio.max()) < 2.001


def test_the_mask_starts_at_one_reaches_zero_and_is_never_stuck() -> None:
    x = torch.tensor([0.0, -1.0, -20.0, 3.0], requires_grad=True)
    mask = opacity_mask(x)
    expected = torch.tensor([1.0, 2 / (1 + math.e), 0.0, 1.0])
    assert torch.allclose(mask, expected, atol=1e-6)
    (less,) = torch.autograd.grad(mask.sum(), x, retain_graph=True)
    assert bool((less > 0).all())
    (more,) = torch.autograd.grad(-mask.sum(), x)
    assert float(more[3]) == 0
    below = torch.linspace(-4, -0.1, 7, dtype=torch.float64, requires_grad=True)
    assert gradcheck(opacity_mask, (below,))


def test_gradients_agree_with_finite_differences() -> None:
    surfels, *_ = rest_surfels()
    one = batched(surfels, 3, torch.float64)
    generator = torch.Generator().manual_seed(2)
    inputs = [one.means, one.tangents * 100, one.normals]
    inputs += [
        torch.randn(shape.shape, generator=generator, dtype=torch.float64) * 0.3
        for shape in nothing(3).values()
    ]

    def run(*values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        after = deform(AttachedSurfels(*values[:3]), Residuals(*values[3:]))
        return after.means, after.tangents, after.normals

    assert gradcheck(run, tuple(value.detach().clone().requires_grad_() for value in inputs))


@pytest.mark.parametrize("instruction_set", _kernels.instruction_sets())
@pytest.mark.parametrize("threads", [1, 3])
def test_compiled_it_agrees_with_the_specification(instruction_set: str, threads: int) -> None:
    surfels, *_ = rest_surfels()
    generator = torch.Generator().manual_seed(2)
    count = 1999
    rows = torch.randint(0, len(surfels.means), (2, count), generator=generator)
    inputs = [surfels.means[rows], surfels.tangents[rows], surfels.normals[rows]]
    scales = {"offset": 1e-3, "log_scale": 0.4, "rotation": 0.5}
    inputs += [
        torch.randn(2, count, 2 if name == "log_scale" else 3, generator=generator) * scale
        for name, scale in scales.items()
    ]
    weights = [torch.randn(value.shape, generator=generator) for value in inputs[:3]]
    weights[1] *= 1e3  # tangents are tenths of a millimetre

    def run(values: list[Tensor], compiled: bool) -> list[Tensor]:
        values = [value.clone().requires_grad_() for value in values]
        offset, log_scale, rotation = values[3:]
        residuals = Residuals(offset, log_scale, rotation, torch.zeros(2, count))
        given = AttachedSurfels(*values[:3]), residuals
        if compiled:
            after = deform(*given, threads=threads, instruction_set=instruction_set)
        else:
            after = deform_reference(*given)
        out = [after.means, after.tangents, after.normals]
        total = sum((x * w.to(x.dtype)).sum() for x, w in zip(out, weights, strict=True))
        assert isinstance(total, Tensor)
        return [*(x.detach() for x in out), *torch.autograd.grad(total, values)]

    exact = run([value.double() for value in inputs], compiled=False)
    for value, truth in zip(run(inputs, compiled=True), exact, strict=True):
        assert value.shape == truth.shape
        assert float((value - truth).abs().max()) <= 2e-6 * float(truth.abs().max())


def test_gradients_of_the_whole_module_agree_with_finite_differences() -> None:
    module = trained(count=4).double()
    names = [name for name, _ in module.named_parameters()]
    values = tuple(value.detach().clone().requires_grad_() for _, value in module.named_parameters())
    hand_pose, betas = (value.double() for value in poses(2))

    def run(*weights: Tensor) -> tuple[Tensor, Tensor]:
        out: Residuals = torch.func.functional_call(
            module, dict(zip(names, weights, strict=True)), (hand_pose, betas)
        )
        # In radians and millimetres, so that the comparison's tolerance means something.
        return out.offset * 1e3, torch.cat([out.log_scale, out.rotation], -1)

    assert gradcheck(run, values, fast_mode=True)


def test_frozen_it_gives_the_same_and_a_subset_its_part() -> None:
    module = trained(config=DeformationConfig())
    hand_pose, betas = poses(3)
    every = module(hand_pose, betas)
    frozen = module.freeze().residuals(hand_pose, betas)
    surfels, faces, *_ = rest_surfels()
    rows = torch.arange(5, 900, 7)
    module.grid.place(module.cube.coordinates(surfels.means[rows]), faces[rows])
    part = module(hand_pose, betas)
    for name in ("offset", "log_scale", "rotation", "mask_logit"):
        assert not getattr(frozen, name).requires_grad
        assert torch.allclose(getattr(frozen, name), getattr(every, name), atol=1e-6)
        assert torch.allclose(getattr(part, name), getattr(every, name)[:, rows], atol=1e-6)


def test_weights_travel_through_a_flat_dict() -> None:
    module, other = trained(seed=1), deformation(seed=9)
    other.load_tensors(module.tensors())
    assert torch.equal(module(*poses(1)).offset, other(*poses(1)).offset)
    assert DeformationConfig.from_dict(module.config.to_dict()) == module.config
    with pytest.raises(EngineError, match=r"deform\.weights"):
        other.load_tensors({"head": torch.zeros(2)})
    with pytest.raises(EngineError, match=r"deform\.weights"):
        other.load_tensors({**module.tensors(), "head": torch.zeros(2)})


def test_bad_input_is_refused() -> None:
    with pytest.raises(BadArgumentError, match=r"deform\.pose"):
        deformation()(torch.zeros(1, 48), torch.zeros(1, 10))
    surfels, *_ = rest_surfels()
    with pytest.raises(BadArgumentError, match=r"deform\.shape"):
        deform(batched(surfels, 5), Residuals(**nothing(4)))
    with pytest.raises(BadArgumentError, match=r"deform\.config"):
        DeformationConfig(hidden=17)
    with pytest.raises(BadArgumentError, match=r"deform\.config"):
        DeformationConfig(offset_unit=0.0)
