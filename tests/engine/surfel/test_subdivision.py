"""Loop subdivision as a fixed matrix."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mass_engine.hand.builtin import load_builtin
from mass_engine.surfel.subdivision import loop_subdivision

few = settings(max_examples=20, deadline=None, derandomize=True)


def grid(size: int = 6) -> tuple[Tensor, Tensor]:
    """A flat open sheet of triangles: vertices [V,3] and faces."""
    place = torch.arange(size * size).reshape(size, size)
    a, b, c, d = place[:-1, :-1], place[:-1, 1:], place[1:, :-1], place[1:, 1:]
    faces = torch.cat([torch.stack([a, b, d], -1).reshape(-1, 3), torch.stack([a, d, c], -1).reshape(-1, 3)])
    x, y = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    # Sheared so that the triangles are those of the regular, six-sided lattice.
    vertices = torch.stack([x + 0.5 * y, y * 0.866, torch.zeros_like(x)], -1).reshape(-1, 3).float()
    return vertices, faces


def octahedron() -> tuple[Tensor, Tensor]:
    vertices = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).float()
    faces = torch.tensor(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    )
    return vertices, faces


@pytest.mark.parametrize("levels", [0, 1, 2, 3])
def test_counts_and_parents(levels: int) -> None:
    model = load_builtin("right")
    fine = loop_subdivision(model.faces, len(model.template), levels)
    count = len(model.faces) * 4**levels
    assert fine.faces.shape == (count, 3)
    assert torch.equal(fine.face_parent.bincount(), torch.full((len(model.faces),), 4**levels))
    # Closed: V - E + F = 2 with E = 3/2 F.
    assert len(fine.apply(model.template)) == fine.n_vertices == 2 + count // 2
    assert int(fine.faces.max()) == fine.n_vertices - 1


def test_closed_forms_on_an_octahedron() -> None:
    vertices, faces = octahedron()
    fine = loop_subdivision(faces, 6, 1).apply(vertices)
    # Degree 4: beta = (5/8 - (3/8 + cos(90)/4)^2) / 4; the four neighbours of a corner cancel.
    beta = (5 / 8 - (3 / 8) ** 2) / 4
    assert torch.allclose(fine[:6], vertices * (1 - 4 * beta))
    # The middle of an edge: 3/8 of its ends, 1/8 of the two corners across, which cancel here.
    middles = {tuple(round(float(x), 6) for x in point) for point in fine[6:]}
    assert len(middles) == 12
    for point in fine[6:]:
        assert sorted(point.abs().tolist()) == pytest.approx([0.0, 0.375, 0.375])


def test_faces_keep_their_winding() -> None:
    vertices, faces = octahedron()
    fine = loop_subdivision(faces, 6, 2)
    points = fine.apply(vertices)
    a, b, c = (points[fine.faces[:, k]] for k in range(3))
    assert ((torch.linalg.cross(b - a, c - a) * (a + b + c)).sum(1) > 0).all()


def test_a_border_is_a_crease_and_stays_where_it_is() -> None:
    vertices, faces = grid()
    bent = vertices.clone()
    bent[:, 2] = torch.sin(vertices[:, 0] * 1.3)
    inner = torch.ones(len(vertices), dtype=torch.bool)
    size = 6
    place = torch.arange(size * size).reshape(size, size)
    border = torch.cat([place[0], place[-1], place[:, 0], place[:, -1]])
    inner[border] = False
    moved = bent.clone()
    moved[inner] += torch.tensor([0.3, -0.2, 5.0])
    fine = loop_subdivision(faces, len(vertices), 1)
    before, after = fine.apply(bent), fine.apply(moved)
    # What the inside does never reaches the border curve: its vertices are 3/4, 1/8, 1/8 of the border's own.
    assert torch.allclose(before[border], after[border])
    first = place[0]
    expected = 0.75 * bent[first[2]] + 0.125 * (bent[first[1]] + bent[first[3]])
    assert torch.allclose(before[first[2]], expected, atol=1e-6)
    ends = torch.sort(torch.stack([first[:-1], first[1:]], 1), 1).values
    middles = (bent[ends[:, 0]] + bent[ends[:, 1]]) / 2
    for middle in middles:
        assert (before - middle).norm(dim=1).min() < 1e-6


@few
@given(st.integers(0, 1000))
def test_affine_invariance(seed: int) -> None:
    random = torch.Generator().manual_seed(seed)
    vertices, faces = octahedron()
    fine = loop_subdivision(faces, 6, 2)
    linear, shift = torch.randn(3, 3, generator=random), torch.randn(3, generator=random)
    assert torch.allclose(
        fine.apply(vertices @ linear.T + shift), fine.apply(vertices) @ linear.T + shift, atol=1e-5
    )


def test_levels_compose() -> None:
    model = load_builtin("right")
    one = loop_subdivision(model.faces, len(model.template), 1)
    again = loop_subdivision(one.faces, one.n_vertices, 1)
    two = loop_subdivision(model.faces, len(model.template), 2)
    assert torch.equal(again.faces, two.faces)
    assert torch.allclose(again.apply(one.apply(model.template)), two.apply(model.template), atol=1e-7)
    assert torch.equal(one.face_parent[again.face_parent], two.face_parent)


def test_weights_stay_convex() -> None:
    model = load_builtin("right")
    weights = loop_subdivision(model.faces, len(model.template), 2).apply(model.weights)
    assert (weights >= 0).all()
    assert torch.allclose(weights.sum(1), torch.ones(len(weights)), atol=1e-5)


def test_batches_and_gradient() -> None:
    _, faces = octahedron()
    fine = loop_subdivision(faces, 6, 2)
    batch = torch.randn(3, 2, 6, 3, generator=torch.Generator().manual_seed(0)).requires_grad_(True)
    out = fine.apply(batch)
    assert out.shape == (3, 2, fine.n_vertices, 3)
    assert torch.allclose(out[1, 1], fine.apply(batch[1, 1]), atol=1e-6)
    weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))
    (gradient,) = torch.autograd.grad((out * weight).sum(), batch)
    # The map is linear: its gradient is its transpose, found here column by column.
    matrix = fine.apply(torch.eye(6))
    expected = torch.einsum("rv,...rc->...vc", matrix, weight)
    assert torch.allclose(gradient, expected, atol=1e-5)


@pytest.mark.parametrize("levels", [-1, 4])
def test_levels_out_of_range_are_refused(levels: int) -> None:
    with pytest.raises(ValueError, match="0 to 3"):
        loop_subdivision(octahedron()[1], 6, levels)


def test_any_mesh_keeps_its_place() -> None:
    # Three triangles on one edge, and two sheets that touch in one corner: what other people's meshes hold.
    vertices, faces = grid()
    count = len(vertices)
    fin = torch.tensor([[7, 8, count], [0, count + 1, count + 2]])
    vertices = torch.cat([vertices, torch.tensor([[1.5, 1.0, 2.0], [-2.0, 0.0, 0.0], [-2.0, -1.0, 0.0]])])
    fine = loop_subdivision(torch.cat([faces, fin]), len(vertices), 2)
    shift = torch.tensor([3.0, -2.0, 5.0])
    torch.testing.assert_close(fine.apply(vertices + shift), fine.apply(vertices) + shift, atol=1e-5, rtol=0)
