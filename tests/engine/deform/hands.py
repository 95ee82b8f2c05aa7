"""A small hand with surfels and their deformation, for tests."""

from __future__ import annotations

import torch
from torch import Tensor

from mass_engine.deform.hashgrid import HashGridConfig
from mass_engine.deform.network import Deformation, DeformationConfig, UnitCube
from mass_engine.hand.builtin import load_builtin
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding

SMALL = DeformationConfig(HashGridConfig(levels=3, base_resolution=4, table_bits=8), hidden=16)


def rest_surfels() -> tuple[AttachedSurfels, Tensor, int, UnitCube]:
    """Surfels [N] of the built-in hand at rest, their base faces [N], how many faces, the cube."""
    model = load_builtin("right")
    binding = MeshBinding.build(model, 0, 0)
    return (
        binding.surfels(model.template),
        binding.surfel_faces,
        len(model.faces),
        UnitCube.around(model.template),
    )


def deformation(seed: int = 0, count: int | None = None, config: DeformationConfig = SMALL) -> Deformation:
    """An untrained deformation of the first ``count`` surfels."""
    surfels, faces, face_count, cube = rest_surfels()
    generator = torch.Generator().manual_seed(seed)
    return Deformation(config, surfels.means[:count], faces[:count], face_count, cube, generator)


def trained(seed: int = 0, count: int | None = None, config: DeformationConfig = SMALL) -> Deformation:
    """A deformation with random weights everywhere, as if trained."""
    module = deformation(seed, count, config)
    generator = torch.Generator().manual_seed(seed + 1)
    with torch.no_grad():
        for value in module.parameters():
            value.copy_(torch.randn(value.shape, generator=generator) * 0.3)
    return module


def poses(batch: int, seed: int = 5) -> tuple[Tensor, Tensor]:
    """``hand_pose`` [B,45] and ``betas`` [B,10] at random."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, 45, generator=generator) * 0.4, torch.randn(batch, 10, generator=generator)
