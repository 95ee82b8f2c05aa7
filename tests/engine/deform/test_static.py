"""Static residuals: none change nothing, scales stay in their bounds, files that do not fit are refused."""

from __future__ import annotations

import pytest
import torch

from mass_engine.deform.static import OFFSET_BOUND, OFFSET_UNIT, SCALE_BOUND, StaticResiduals
from mass_engine.hand.builtin import load_builtin
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding


def surfels() -> AttachedSurfels:
    model = load_builtin("right")
    return MeshBinding.build(model, 0, 0).register(model.template[None])


def test_none_change_no_bit() -> None:
    before = surfels()
    after = StaticResiduals.none(torch.ones(before.means.shape[1])).apply(before)
    assert torch.equal(before.means, after.means)
    assert torch.equal(before.tangents, after.tangents)
    assert torch.equal(before.normals, after.normals)


def test_offsets_and_scales_are_bounded() -> None:
    before = surfels()
    static = StaticResiduals.none(torch.ones(before.means.shape[1]))
    static.offset[:, 2] = 50.0
    static.log_scale[:] = 50.0
    after = static.apply(before)
    most = OFFSET_BOUND * OFFSET_UNIT
    torch.testing.assert_close(after.means - before.means, most * before.normals, atol=1e-7, rtol=0)
    factor = after.tangents[..., 0, :].norm(dim=-1) / before.tangents[..., 0, :].norm(dim=-1)
    torch.testing.assert_close(factor.log(), torch.full_like(factor, SCALE_BOUND), atol=1e-4, rtol=0)


def test_surfels_that_are_not_free_stay() -> None:
    before = surfels()
    free = torch.arange(before.means.shape[1]) % 2 == 0
    static = StaticResiduals.none(free)
    for value in static.parameters().values():
        value += 0.1
    after = static.apply(before)
    assert torch.equal(before.means[:, ~free], after.means[:, ~free])
    assert torch.equal(before.tangents[:, ~free], after.tangents[:, ~free])
    assert float((before.means - after.means)[:, free].norm(dim=-1).min()) > 1e-5


def test_some_rows_have_numbers_of_their_own() -> None:
    static, other = StaticResiduals.none(torch.ones(4)), StaticResiduals.none(torch.ones(4))
    static.offset[2] = 1.0
    some = static.rows(torch.tensor([False, False, True, True]))
    static.offset[2] = 5.0
    assert some.offset[:, 0].tolist() == [1.0, 0.0]
    other.take(static)
    assert other.offset[2, 0] == 5.0
    assert float(StaticResiduals.none(torch.ones(0)).size()) == 0.0


def test_a_file_without_them_has_none_and_one_that_does_not_fit_is_refused() -> None:
    assert StaticResiduals.read({}, 4) is None
    tensors = {
        f"static.{name}": value for name, value in StaticResiduals.none(torch.ones(4)).tensors().items()
    }
    assert StaticResiduals.read(tensors, 4) is not None
    with pytest.raises(ValueError, match="for 5 surfels"):
        StaticResiduals.read(tensors, 5)
    with pytest.raises(KeyError):
        StaticResiduals.read({"static.offset": torch.zeros(4, 3)}, 4)
