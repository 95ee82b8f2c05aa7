"""Residuals of attached surfels that are the same in every pose: where a surfel really sits in its triangle.

The paper's attached surfels stay where the mesh has them. A surface registered for the outlines of all frames
leaves each of its surfels a little too far out or too large; these residuals take that back, and no more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mass_engine.deform.residuals import Residuals, deform
from mass_engine.surfel.binding import AttachedSurfels

#: Metres per unit of an offset, and how many units it has at most along each axis. More than half a pixel of
#: a usual clip, and a surfel that is seen from a new side stands off the hand like a flake.
OFFSET_UNIT, OFFSET_BOUND = 1e-3, 0.3
#: Logarithms of scales stay within this: a factor of two.
SCALE_BOUND = 0.69
#: How much a rotation counts (radians) beside an offset (units) and a scale where residuals are held.
ROTATION_WEIGHT = 3.0


@dataclass
class StaticResiduals:
    """Of A attached surfels, as an optimiser has them, zero for none.

    ``offset`` [A,3] in millimetres along (tangent, bitangent, normal) and ``log_scale`` [A,2], both before
    they are bounded, ``rotation`` [A,3] radians about the same axes. ``free`` [A,1] is 1 where a surfel may
    move and 0 where it may not.
    """

    offset: Tensor
    log_scale: Tensor
    rotation: Tensor
    free: Tensor

    @staticmethod
    def none(free: Tensor) -> StaticResiduals:
        """Surfels that are where the mesh has them; ``free`` (bool [A]) says which may leave."""
        count = len(free)
        return StaticResiduals(
            torch.zeros(count, 3), torch.zeros(count, 2), torch.zeros(count, 3), free.float().unsqueeze(1)
        )

    @staticmethod
    def read(tensors: Mapping[str, Tensor], count: int) -> StaticResiduals | None:
        """From a file's ``tensors`` under "static."; None if it has none.

        Raises KeyError or ValueError unless they are those of ``count`` surfels.
        """
        names = [field.name for field in fields(StaticResiduals)]
        if not any(f"static.{name}" in tensors for name in names):
            return None
        found = StaticResiduals(*(tensors[f"static.{name}"] for name in names))
        for name, value in StaticResiduals.none(torch.ones(count)).tensors().items():
            got = found.tensors()[name].shape
            if got != value.shape:
                raise ValueError(f"static residuals' {name} is {tuple(got)} for {count} surfels")
        return found

    def tensors(self) -> dict[str, Tensor]:
        """Everything by name, for a file."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def parameters(self) -> dict[str, Tensor]:
        """What is learnt, by name."""
        return {name: value for name, value in self.tensors().items() if name != "free"}

    def rows(self, rows: Tensor) -> StaticResiduals:
        """Those of some surfels: ``rows`` bool [A] or indices."""
        return StaticResiduals(*(value[rows] for value in self.tensors().values()))

    def to(self, device: torch.device | str) -> StaticResiduals:
        """The same elsewhere."""
        return StaticResiduals(*(value.to(device) for value in self.tensors().values()))

    def take(self, other: StaticResiduals) -> None:
        """The values of ``other``, wherever they are."""
        for name, value in self.tensors().items():
            value.copy_(other.tensors()[name].detach())

    def size(self) -> Tensor:
        """How much they change, in mean squares (scalar)."""
        squares = self.offset.square().sum() + self.log_scale.square().sum()
        return (squares + ROTATION_WEIGHT * self.rotation.square().sum()) / max(len(self.offset), 1)

    def residuals(self, batch: int) -> Residuals:
        """What they change, for a batch of poses [batch,A]; differentiable."""
        offset, log_scale, rotation = (
            (self.free * part).expand(batch, -1, -1).contiguous()
            for part in (
                OFFSET_UNIT * _bounded(self.offset, OFFSET_BOUND),
                _bounded(self.log_scale, SCALE_BOUND),
                self.rotation,
            )
        )
        return Residuals(offset, log_scale, rotation, offset.new_zeros(offset.shape[:2]))

    def apply(self, surfels: AttachedSurfels) -> AttachedSurfels:
        """The surfels [B,A] with them; differentiable in both."""
        return deform(surfels, self.residuals(len(surfels.means)))


def _bounded(value: Tensor, bound: float) -> Tensor:
    return bound * torch.tanh(value / bound)
