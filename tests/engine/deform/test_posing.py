"""The compiled pass from mesh to shaded surfels against its specification, on every instruction set."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mass_engine.deform import _kernels
from mass_engine.deform.decoder import Layers
from mass_engine.deform.network import Deformation, DeformationConfig, UnitCube
from mass_engine.deform.posing import MeshPose, PosableSurfels
from mass_engine.deform.static import StaticResiduals
from mass_engine.errors import BadArgumentError
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.surfel.binding import MeshBinding
from tests.engine.deform.hands import SMALL, poses


def posable(harmonics: int, deformed: int, depth: int = 1) -> tuple[PosableSurfels, MeshPose]:
    """Some attached surfels and then ``deformed`` detached ones, with random weights and looks, in a pose."""
    generator = torch.Generator().manual_seed(harmonics + deformed)
    model = load_builtin("right")
    binding = MeshBinding.build(model, 1, depth)
    sources = torch.cat(
        [
            torch.arange(0, binding.count, 37),
            torch.randint(0, binding.count, (deformed,), generator=generator),
        ]
    )
    count, first = len(sources), len(sources) - deformed
    frozen = None
    if deformed:
        rest = binding.surfels(model.template).means
        module = Deformation(
            replace(SMALL, hidden=32) if deformed % 2 else DeformationConfig(),
            rest[sources[first:]],
            binding.surfel_faces[sources[first:]],
            len(model.faces),
            UnitCube.around(model.template),
            generator,
        )
        with torch.no_grad():
            for value in module.parameters():
                value.copy_(torch.randn(value.shape, generator=generator) * 0.2)
        frozen = module.freeze()
    surfels = PosableSurfels(
        binding,
        sources,
        torch.rand(count, 3, generator=generator),
        torch.rand(count, generator=generator),
        torch.randn(count, harmonics, 3, generator=generator) * 0.2,
        torch.randn(9, 3, generator=generator) * 0.3 + 0.5,
        frozen,
        first,
    )
    hand_pose, betas = (value[0] for value in poses(1))
    transl = torch.tensor([0.02, 0.05, 0.4])
    posed = model.posed(HandPose(betas, torch.tensor([0.5, 1.0, -0.3]), hand_pose, transl, "right"))
    return surfels, MeshPose(
        binding.subdivision.apply(posed.vertices),
        posed.bone_transforms[:, :3, :3],
        torch.tensor([0.01, -0.02, 0.03]),
        hand_pose,
        betas,
    )


def settled(surfels: PosableSurfels) -> PosableSurfels:
    """The same with static residuals of those before the deformed ones, but for the last three."""
    generator = torch.Generator().manual_seed(8)
    static = StaticResiduals.none(torch.ones(surfels.deformed_from - 3))
    for value in static.parameters().values():
        value.copy_(torch.randn(value.shape, generator=generator) * 0.5)
    return replace(surfels, static=static)


def in_double(surfels: PosableSurfels, pose: MeshPose) -> tuple[PosableSurfels, MeshPose]:
    """The same in float64: in float32 the specification's own tangents have five digits."""
    moving = surfels.deformation
    if moving is not None:
        moving = replace(
            moving,
            surfel_share=moving.surfel_share.double(),
            first_pose=moving.first_pose.double(),
            first_bias=moving.first_bias.double(),
            layers=Layers(*(layer.double() for layer in moving.layers)),
        )
    exact = replace(
        surfels,
        binding=replace(surfels.binding, _parts=surfels.binding._parts.double()),
        albedo=surfels.albedo.double(),
        opacities=surfels.opacities.double(),
        sh=surfels.sh.double(),
        light=surfels.light.double(),
        deformation=moving,
        static=surfels.static and StaticResiduals(*(v.double() for v in surfels.static.tensors().values())),
    )
    return exact, MeshPose(*(value.double() for value in vars(pose).values()))


def far(one: Tensor, other: Tensor) -> float:
    return float((one - other).abs().max())


@pytest.mark.parametrize("instruction_set", _kernels.instruction_sets())
@pytest.mark.parametrize("static", [False, True])
@pytest.mark.parametrize(
    ("harmonics", "deformed", "depth"), [(0, 0, 0), (3, 301, 1), (8, 96, 2), (15, 5, 1), (3, 2000, 0)]
)
def test_it_agrees_with_the_specification(
    instruction_set: str, harmonics: int, deformed: int, depth: int, static: bool
) -> None:
    surfels, pose = posable(harmonics, deformed, depth)
    if static:
        surfels = settled(surfels)
    got = surfels.compiled().posed(pose, instruction_set=instruction_set)
    exact, exact_pose = in_double(surfels, pose)
    expected = exact.posed(exact_pose)
    for name in ("means", "normals", "opacities", "colors"):
        assert getattr(got, name).shape == getattr(expected, name).shape
        assert far(getattr(got, name), getattr(expected, name)) < 1e-5
    # Tangents are tenths of a millimetre.
    assert far(got.tangents, expected.tangents) < 1e-7
    assert far(surfels.posed(pose).tangents, expected.tangents) < 1e-6
    if deformed:
        start = surfels.deformed_from
        still = replace(exact, deformation=None).posed(exact_pose)
        assert far(expected.means[start:], still.means[start:]) > 1e-5
        assert far(expected.opacities[start:], still.opacities[start:]) > 0.01
        assert torch.equal(expected.means[:start], still.means[:start])


def test_static_residuals_move_the_attached_surfels_alone() -> None:
    surfels, pose = posable(3, 301)
    first = surfels.deformed_from
    plain, moved = surfels.compiled().posed(pose), settled(surfels).compiled().posed(pose)
    assert float((plain.means - moved.means)[: first - 3].norm(dim=-1).mean()) > 1e-4
    for name in ("means", "tangents", "normals", "opacities", "colors"):
        assert torch.equal(getattr(plain, name)[first - 3 :], getattr(moved, name)[first - 3 :])
    assert torch.equal(plain.opacities, moved.opacities)


def test_any_number_of_threads_gives_the_same_bits() -> None:
    surfels, pose = posable(3, 3001)
    compiled = surfels.compiled()
    one, three = compiled.posed(pose, threads=1), compiled.posed(pose, threads=3)
    assert torch.equal(one.means, three.means)
    assert torch.equal(one.colors, three.colors)


def test_no_surfels_at_all() -> None:
    surfels, pose = posable(3, 0)
    none = torch.arange(0)
    empty = replace(
        surfels,
        sources=none,
        albedo=surfels.albedo[none],
        opacities=surfels.opacities[none],
        sh=surfels.sh[none],
    )
    assert empty.compiled().posed(pose).means.shape == (0, 3)


def test_parts_that_do_not_fit_are_refused() -> None:
    surfels, _ = posable(3, 11)
    with pytest.raises(BadArgumentError, match=r"deform\.surfels"):
        replace(surfels, albedo=surfels.albedo[1:])
    with pytest.raises(BadArgumentError, match=r"deform\.surfels"):
        replace(surfels, sh=surfels.sh[:, :2])
    with pytest.raises(BadArgumentError, match=r"deform\.surfels"):
        replace(surfels, deformed_from=0)
    with pytest.raises(BadArgumentError, match=r"deform\.surfels"):
        replace(surfels, static=StaticResiduals.none(torch.ones(surfels.deformed_from + 1)))
    with pytest.raises(BadArgumentError, match=r"deform\.surfels"):
        replace(surfels, sources=surfels.sources + surfels.binding.count)
