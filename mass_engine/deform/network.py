"""The deformation module: hash grid, feature encoder and decoder from a surfel and a pose to residuals.

f_h = Enc_h([p, i]), f_r = Enc_n([f_h, theta, beta]), [dp, ds, dr, M] = Dec(f_r) of the paper's "Gaussian
Surfel Deformation". Enc_n is two layers with rectifiers, Dec one whose weights start at zero: untrained, the
module changes nothing at all.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from mass_engine.deform.decoder import OUTPUTS, Layers, Units, decode, decode_reference
from mass_engine.deform.hashgrid import HashGrid, HashGridConfig
from mass_engine.deform.precision import product
from mass_engine.deform.residuals import Residuals
from mass_engine.device import Precision
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.hand.rotation import axis_angle_to_matrix

#: 15 joints' R - I, flattened, and 10 shape numbers.
POSE_FEATURES = 145


@dataclass(frozen=True)
class DeformationConfig:
    """``hidden`` units a layer; ``offset_unit`` metres and ``rotation_unit`` radians per unit of output.

    32 units learn a made-up field of folds as well as 64, in a third of the time. The two units make a step
    of the optimiser about as visible in one output as in another.
    """

    grid: HashGridConfig = field(default_factory=HashGridConfig)
    hidden: int = 32
    offset_unit: float = 1e-3
    rotation_unit: float = 0.1

    def __post_init__(self) -> None:
        if self.hidden not in (16, 32, 48, 64, 96, 128):
            raise BadArgumentError(
                "deform.config", f"hidden is {self.hidden}.", "Use 16, 32, 48, 64, 96 or 128."
            )
        if not (self.offset_unit > 0 and self.rotation_unit > 0):
            raise BadArgumentError("deform.config", "A unit is not positive.", "Use the defaults.")

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for a file's metadata."""
        return asdict(self)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> DeformationConfig:
        """What :meth:`to_dict` gave. Raises TypeError or KeyError for anything else."""
        return DeformationConfig(**{**values, "grid": HashGridConfig(**values["grid"])})


@dataclass(frozen=True)
class UnitCube:
    """The cube around a resting hand in which the hash grid lies: ``origin`` [3] and ``side``, metres."""

    origin: Tensor
    side: float

    @staticmethod
    def around(template: Tensor) -> UnitCube:
        """The smallest cube with a margin of 2 % around ``template`` [V,3]."""
        low, high = template.amin(0), template.amax(0)
        side = float((high - low).max()) * 1.04
        return UnitCube((low + high) / 2 - side / 2, side)

    def coordinates(self, points: Tensor) -> Tensor:
        """Points [N,3] in metres to coordinates in 0..1."""
        return (points - self.origin) / self.side


def pose_features(hand_pose: Tensor, betas: Tensor) -> Tensor:
    """``hand_pose`` [B,45] axis-angles and ``betas`` [B,10] -> [B,145].

    A joint enters as R - I, as in the hand model's pose correctives: zero at rest, bounded, and the same for
    every axis-angle of one rotation.
    """
    if hand_pose.ndim != 2 or hand_pose.shape[1] != 45 or betas.shape != (len(hand_pose), 10):
        raise BadArgumentError(
            "deform.pose",
            f"hand_pose is {tuple(hand_pose.shape)}, betas {tuple(betas.shape)}.",
            "Give [B,45] and [B,10].",
        )
    rest = torch.eye(3, dtype=hand_pose.dtype, device=hand_pose.device)
    turns = axis_angle_to_matrix(hand_pose.reshape(-1, 15, 3)) - rest
    return torch.cat([turns.flatten(1), betas], -1)


class Deformation(nn.Module):
    """Residuals of given surfels in any pose.

    ``centroids`` [N,3] metres of the surfels on the hand at rest, ``faces`` [N] of the base mesh (of
    ``face_count``), ``cube`` around the rest hand. float32, everything random from ``generator``.
    """

    def __init__(
        self,
        config: DeformationConfig,
        centroids: Tensor,
        faces: Tensor,
        face_count: int,
        cube: UnitCube,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.config, self.cube = config, cube
        #: Of the layers' products; what is trained with another than float32 is trained by torch's operators.
        self.precision: Precision = "float32"
        self.grid = HashGrid(config.grid, cube.coordinates(centroids), faces, face_count, generator)
        width, hidden = config.grid.width, config.hidden

        def layer(inputs: int, outputs: int, fan_in: int) -> nn.Parameter:
            bound = math.sqrt(6 / fan_in)  # He et al. 2015, for rectifiers
            return nn.Parameter((torch.rand(inputs, outputs, generator=generator) * 2 - 1) * bound)

        self.first_hash = layer(width, hidden, width)
        self.first_pose = layer(POSE_FEATURES, hidden, POSE_FEATURES)
        self.first_bias = nn.Parameter(torch.zeros(hidden))
        self.second = layer(hidden, hidden, hidden)
        self.second_bias = nn.Parameter(torch.zeros(hidden))
        self.head = nn.Parameter(torch.zeros(hidden, OUTPUTS))
        self.head_bias = nn.Parameter(torch.zeros(OUTPUTS))

    def forward(self, hand_pose: Tensor, betas: Tensor) -> Residuals:
        """Residuals [B,N] for ``hand_pose`` [B,45] and ``betas`` [B,10]; differentiable."""
        share = product(self.grid(), self.first_hash, self.precision)
        return self._decoder(share).residuals(hand_pose, betas, self.precision)

    def copied_to(self, device: torch.device | str) -> Deformation:
        """A copy elsewhere, with weights of its own."""
        # Sparse tensors cannot be copied this way, and constants need not be.
        constants = {id(matrix): matrix for pair in self.grid.matrices for matrix in pair}
        return copy.deepcopy(self, constants).to(device)

    def freeze(self) -> FrozenDeformation:
        """For inference: the hash grid's share of the first layer becomes one constant row a surfel."""
        with torch.no_grad():
            frozen = self._decoder(self.grid() @ self.first_hash)
            layers = Layers(*(value.detach().clone() for value in frozen.layers))
            return FrozenDeformation(
                self.config,
                frozen.surfel_share,
                frozen.first_pose.detach().clone(),
                frozen.first_bias.detach().clone(),
                layers,
            )

    def tensors(self) -> dict[str, Tensor]:
        """Every weight by name, for a file. Together with the config and the surfels they are the module."""
        return {name: value.detach().clone() for name, value in self.named_parameters()}

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the weights that :meth:`tensors` gave. Raises EngineError ``deform.weights``."""
        own = dict(self.named_parameters())
        if own.keys() != tensors.keys():
            odd = sorted(own.keys() ^ tensors.keys())
            raise EngineError(
                "deform.weights", f"Weights missing or unknown: {', '.join(odd)}.", "Fit the avatar again."
            )
        for name, value in tensors.items():
            if value.shape != own[name].shape:
                raise EngineError(
                    "deform.weights",
                    f"{name} is {tuple(value.shape)}, not {tuple(own[name].shape)}.",
                    "Fit the avatar again.",
                )
        with torch.no_grad():
            for name, value in tensors.items():
                own[name].copy_(value)

    def _decoder(self, surfel_share: Tensor) -> FrozenDeformation:
        layers = Layers(self.second, self.second_bias, self.head, self.head_bias)
        return FrozenDeformation(self.config, surfel_share, self.first_pose, self.first_bias, layers)


@dataclass(frozen=True)
class FrozenDeformation:
    """A deformation after its hash grid: ``surfel_share`` [N,H] of the first layer, and the other weights."""

    config: DeformationConfig
    surfel_share: Tensor
    first_pose: Tensor
    first_bias: Tensor
    layers: Layers

    def to(self, device: torch.device | str) -> FrozenDeformation:
        """The same deformation elsewhere."""
        return FrozenDeformation(
            self.config,
            self.surfel_share.to(device),
            self.first_pose.to(device),
            self.first_bias.to(device),
            Layers(*(v.to(device) for v in self.layers)),
        )

    def pose_share(self, hand_pose: Tensor, betas: Tensor) -> Tensor:
        """The poses' part [B,H] of the first layer."""
        return pose_features(hand_pose, betas) @ self.first_pose + self.first_bias

    def residuals(self, hand_pose: Tensor, betas: Tensor, precision: Precision = "float32") -> Residuals:
        """Residuals [B,N] for ``hand_pose`` [B,45] and ``betas`` [B,10]."""
        units = Units(self.config.offset_unit, self.config.rotation_unit)
        share = self.pose_share(hand_pose, betas)
        if precision != "float32":
            return decode_reference(self.surfel_share, share, self.layers, units, precision)
        return decode(self.surfel_share, share, self.layers, units)
