"""The hash grid: interpolation of known tables, gradients, hashing, refusals."""

from __future__ import annotations

import pytest
import torch
from torch.autograd import gradcheck

from mass_engine.deform.hashgrid import HashGrid, HashGridConfig
from mass_engine.errors import BadArgumentError


def grid(config: HashGridConfig, points: torch.Tensor, faces: torch.Tensor) -> HashGrid:
    return HashGrid(config, points, faces, 5, torch.Generator().manual_seed(0))


def random_points(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(count, 3, generator=generator), torch.randint(0, 5, (count,), generator=generator)


def test_a_table_linear_in_space_is_read_back_exactly() -> None:
    config = HashGridConfig(levels=1, features=3, base_resolution=6, table_bits=12, face_features=2)
    points, faces = random_points(200)
    points[0], points[1] = torch.tensor([1.0, 1.0, 1.0]), torch.tensor([0.0, 0.5, 1.0])
    module = grid(config, points, faces)
    row = torch.arange(7**3)
    corners = torch.stack([row % 7, row // 7 % 7, row // 49], -1) / 6
    with torch.no_grad():
        module.tables[0].copy_(corners)
        module.face_table.copy_(torch.arange(10.0).reshape(5, 2))
    out = module()
    assert torch.allclose(out[:, :3], points, atol=1e-6)
    assert torch.equal(out[:, 3:], module.face_table[faces])


def test_hashed_level_equals_a_plain_sum_over_corners() -> None:
    config = HashGridConfig(levels=1, features=2, base_resolution=40, table_bits=9, face_features=0)
    points, faces = random_points(50)
    module = grid(config, points, faces)
    table = module.tables[0]
    assert len(table) == 512
    out = module()
    for index in (0, 17, 49):
        scaled = points[index].double() * 40
        cell = scaled.floor().long()
        total = torch.zeros(2, dtype=torch.float64)
        for corner in range(8):
            offset = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2])
            weight = torch.where(offset == 1, scaled - cell, 1 - (scaled - cell)).prod()
            x, y, z = (int(v) for v in cell + offset)
            row = (x ^ y * 2654435761 ^ z * 805459861) % 512
            total += weight * table[row].double()
        assert torch.allclose(out[index].double(), total, atol=1e-9)


def test_gradients_agree_with_finite_differences() -> None:
    points, faces = random_points(9)
    module = grid(HashGridConfig(levels=2, base_resolution=2, table_bits=4, growth=3.0), points, faces)
    module.double()
    names = [name for name, _ in module.named_parameters()]
    values = tuple(value.detach().clone().requires_grad_() for _, value in module.named_parameters())

    def features(*tables: torch.Tensor) -> torch.Tensor:
        result: torch.Tensor = torch.func.functional_call(module, dict(zip(names, tables, strict=True)), ())
        return result

    assert gradcheck(features, values)


def test_the_same_generator_gives_the_same_tables_and_points_can_be_replaced() -> None:
    points, faces = random_points(20)
    config = HashGridConfig(levels=2)
    first, second = grid(config, points, faces), grid(config, points, faces)
    assert torch.equal(first(), second())
    second.place(points[5:9], faces[5:9])
    assert torch.equal(first()[5:9], second())


def test_bad_input_is_refused() -> None:
    points, faces = random_points(4)
    with pytest.raises(BadArgumentError, match=r"deform\.config"):
        HashGridConfig(levels=0)
    with pytest.raises(BadArgumentError, match=r"deform\.config"):
        HashGridConfig(levels=24, growth=4.0)
    with pytest.raises(BadArgumentError, match=r"deform\.points"):
        grid(HashGridConfig(), points, faces + 4)
    with pytest.raises(BadArgumentError, match=r"deform\.points"):
        grid(HashGridConfig(), points[:2], faces)
    with pytest.raises(BadArgumentError, match=r"deform\.points"):
        grid(HashGridConfig(), points * torch.nan, faces)
