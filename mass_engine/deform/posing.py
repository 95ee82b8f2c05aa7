"""From a posed mesh to surfels ready for the rasteriser, for inference: attached, deformed, shaded.

``PosableSurfels`` says what an avatar's surfels are and, in plain torch, what a pose makes of them;
``compiled`` lays the same out for one compiled pass over the surfels (``kernels/posing.hpp``), without
gradients: each surfel is read and written once, where torch takes some forty passes over memory.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mass_engine.deform.decoder import OUTPUTS, Layers
from mass_engine.deform.native import shared_kernels
from mass_engine.deform.network import FrozenDeformation
from mass_engine.deform.residuals import deform_reference
from mass_engine.deform.static import StaticResiduals
from mass_engine.errors import BadArgumentError
from mass_engine.raster.cpu import available_threads
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding
from mass_engine.surfel.harmonics import evaluate_sh_rest
from mass_engine.surfel.shading import shade

_LANES = 16


@dataclass(frozen=True)
class MeshPose:
    """One pose as the surfels see it, or several: then every tensor begins with [B].

    ``refined`` [V',3] vertices of the subdivided mesh, metres; ``bone_rotations`` [16,3,3] from rest;
    ``center`` [3] of the camera; ``hand_pose`` [45] and ``betas`` [10] for the deformation.
    """

    refined: Tensor
    bone_rotations: Tensor
    center: Tensor
    hand_pose: Tensor
    betas: Tensor


@dataclass(frozen=True)
class ShadedSurfels:
    """Surfels of one pose (or of B): what ``raster.rasterize`` takes, and their normals.

    ``means`` [M,3], ``tangents`` [M,2,3], ``normals`` [M,3], ``opacities`` [M], ``colors`` [M,3].
    """

    means: Tensor
    tangents: Tensor
    normals: Tensor
    opacities: Tensor
    colors: Tensor

    def row(self, row: int) -> ShadedSurfels:
        """Those of one pose of several."""
        return ShadedSurfels(*(getattr(self, field.name)[row] for field in fields(self)))


@dataclass(frozen=True)
class PosableSurfels:
    """M surfels of a binding: ``sources`` [M] says whose copy of it each is.

    ``albedo`` [M,3], ``opacities`` [M], ``sh`` [M,K,3] of degree 1 on in the rest frame of the bone (K = 0,
    3, 8 or 15), ``light`` [9,3]. With a ``deformation`` the surfels from ``deformed_from`` on are moved by
    it, one row of it each; ``static`` moves the first, one row each. Raises BadArgumentError
    ``deform.surfels`` when the parts do not fit together.
    """

    binding: MeshBinding
    sources: Tensor
    albedo: Tensor
    opacities: Tensor
    sh: Tensor
    light: Tensor
    deformation: FrozenDeformation | None = None
    deformed_from: int = 0
    static: StaticResiduals | None = None

    def __post_init__(self) -> None:
        count = len(self.sources)
        shapes = {
            "albedo": (count, 3),
            "opacities": (count,),
            "sh": (count, self.sh.shape[1] if self.sh.ndim == 3 else 0, 3),
            "light": (9, 3),
        }
        for name, shape in shapes.items():
            value: Tensor = getattr(self, name)
            if value.shape != shape:
                raise BadArgumentError(
                    "deform.surfels", f"{name} is {tuple(value.shape)}, not {shape}.", "Give a row a surfel."
                )
        if self.sh.shape[1] not in (0, 3, 8, 15):
            raise BadArgumentError(
                "deform.surfels", f"sh has {self.sh.shape[1]} coefficients.", "Give 0, 3, 8 or 15."
            )
        if count and not 0 <= int(self.sources.min()) <= int(self.sources.max()) < self.binding.count:
            raise BadArgumentError(
                "deform.surfels", "A source is not in the binding.", "Use the avatar's own binding."
            )
        most = count if self.deformation is None else self.deformed_from
        if self.static is not None and len(self.static.offset) > most:
            raise BadArgumentError(
                "deform.surfels",
                f"{len(self.static.offset)} static residuals for {most} surfels that nothing else moves.",
                "Give those of the attached surfels.",
            )
        if self.deformation is not None:
            rows = len(self.deformation.surfel_share)
            if not 0 <= self.deformed_from <= count or rows != count - self.deformed_from:
                raise BadArgumentError(
                    "deform.surfels",
                    f"{rows} rows of deformation for surfels {self.deformed_from} to {count}.",
                    "Freeze the deformation of these surfels.",
                )

    def posed(self, pose: MeshPose) -> ShadedSurfels:
        """The surfels in a pose, in plain torch: the specification of the compiled pass."""
        many = self.posed_batch(MeshPose(*(getattr(pose, field.name)[None] for field in fields(pose))))
        return many.row(0)

    def posed_batch(self, poses: MeshPose) -> ShadedSurfels:
        """The surfels in B poses, [B,M,...], in plain torch; every tensor of ``poses`` begins with B."""
        with torch.no_grad():
            every = self.binding.register(poses.refined)
            surfels = AttachedSurfels(*(v[:, self.sources] for v in _parts(every)))
            if self.static is not None:
                still = len(self.static.offset)
                residuals = self.static.residuals(len(poses.refined))
                settled = deform_reference(surfels.part(slice(still)), residuals)
                surfels = settled.then(surfels.part(slice(still, None)))
            opacities = self.opacities.expand(len(poses.refined), -1)
            if self.deformation is not None:
                start = self.deformed_from
                residuals = self.deformation.residuals(poses.hand_pose, poses.betas)
                moved = deform_reference(surfels.part(slice(start, None)), residuals)
                surfels = surfels.part(slice(start)).then(moved)
                opacities = torch.cat([opacities[:, :start], opacities[:, start:] * residuals.mask], 1)
            colors = shade(self.albedo, self.light, surfels.normals)
            if self.sh.shape[1]:
                away = surfels.means - poses.center.unsqueeze(1)
                directions = torch.nn.functional.normalize(away, dim=-1)
                bones = self.binding.bones[self.sources]
                turned = (directions.unsqueeze(-2) @ poses.bone_rotations[:, bones]).squeeze(-2)
                colors = (colors + evaluate_sh_rest(self.sh, turned)).clamp_min(0.0)
            return ShadedSurfels(*_parts(surfels), opacities, colors)

    def to(self, device: torch.device | str) -> PosableSurfels:
        """The same surfels elsewhere."""
        return PosableSurfels(
            self.binding.to(device),
            self.sources.to(device),
            self.albedo.to(device),
            self.opacities.to(device),
            self.sh.to(device),
            self.light.to(device),
            None if self.deformation is None else self.deformation.to(device),
            self.deformed_from,
            None if self.static is None else self.static.to(device),
        )

    def compiled(self) -> CompiledSurfels:
        """The same laid out for the compiled pass: a copy, later changes of the tensors do not reach it."""
        count, binding = len(self.sources), self.binding
        face = torch.div(self.sources, binding.per_face, rounding_mode="floor")
        # Rows sum to one (means) or zero (tangents): relative to the first corner two numbers are left, and
        # the tangents keep the digits that the hand's distance from the origin would cost them.
        coefficients = torch.zeros(6, _LANES)
        coefficients[:, : binding.per_face] = binding.places[:, :, 1:].reshape(-1, 6).T
        empty = Layers(torch.zeros(_LANES, _LANES), torch.zeros(_LANES), torch.zeros(_LANES, OUTPUTS),
                       torch.zeros(OUTPUTS))  # fmt: skip
        moving = self.deformation
        return CompiledSurfels(
            count,
            _planes(3 * binding.subdivision.faces[face], torch.int32),
            _planes(self.sources % binding.per_face, torch.int32),
            coefficients,
            _planes(binding.bones[self.sources], torch.int32),
            _planes(self.albedo, torch.float32),
            _planes(self.sh.flatten(1), torch.float32),
            _planes(self.opacities, torch.float32),
            self.light.detach().float().clone(),
            moving,
            self.deformed_from if moving is not None else count,
            Layers(*(v.contiguous() for v in moving.layers)) if moving is not None else empty,
            moving.surfel_share.contiguous() if moving is not None else torch.zeros(0, _LANES),
            self._static_planes(),
        )

    def _static_planes(self) -> Tensor:
        """Offset, factors of both tangents and rotation of every surfel [8,S]; none: no planes."""
        if self.static is None:
            return torch.zeros(0, 0)
        found = self.static.residuals(1)
        rows = torch.cat([found.offset[0], found.log_scale[0].exp(), found.rotation[0]], 1)
        none = torch.tensor([0.0, 0, 0, 1, 1, 0, 0, 0])
        return _planes(torch.cat([rows, none.expand(len(self.sources) - len(rows), -1)]), torch.float32)


@dataclass(frozen=True)
class CompiledSurfels:
    """``PosableSurfels`` in the compiled pass's layout: one plane of numbers after another."""

    count: int
    corners: Tensor  # [3,S] int32, 3 times the vertex
    places: Tensor  # [S] int32
    coefficients: Tensor  # [6,16]
    bones: Tensor  # [S] int32
    albedo: Tensor  # [3,S]
    harmonics: Tensor  # [3 K,S]
    opacities: Tensor  # [S]
    light: Tensor
    deformation: FrozenDeformation | None
    deformed_from: int
    layers: Layers
    surfel_share: Tensor
    static: Tensor  # [8,S] offset, factors, rotation; [0,0]: none

    def posed(
        self, pose: MeshPose, *, threads: int | None = None, instruction_set: str = "auto"
    ) -> ShadedSurfels:
        """As ``PosableSurfels.posed``. ``threads``: None is every core this process may use."""
        with torch.no_grad():
            moving = self.deformation
            units, share = [1.0, 1.0], torch.zeros(1, _LANES)
            if moving is not None:
                units = [moving.config.offset_unit, moving.config.rotation_unit]
                share = moving.pose_share(pose.hand_pose[None], pose.betas[None]).contiguous()
            rotations = torch.zeros(9, _LANES)
            rotations[:, : len(pose.bone_rotations)] = pose.bone_rotations.reshape(-1, 9).T
            count = self.count
            out = [torch.empty(count, *shape) for shape in ((3,), (2, 3), (3,), (), (3,))]
            shared_kernels(instruction_set).pose_surfels(  # type: ignore[call-arg]
                pose.refined.float().contiguous(),
                self.corners,
                self.places,
                self.coefficients,
                self.bones,
                rotations,
                self.albedo,
                self.harmonics,
                self.opacities,
                self.light,
                [*pose.center.tolist(), *units],
                self.deformed_from,
                self.static,
                self.surfel_share,
                share,
                *self.layers,
                *out,  # type: ignore[arg-type]
                threads or available_threads(),
            )
            return ShadedSurfels(*out)


def _parts(surfels: AttachedSurfels) -> tuple[Tensor, Tensor, Tensor]:
    return surfels.means, surfels.tangents, surfels.normals


def _planes(rows: Tensor, dtype: torch.dtype) -> Tensor:
    """[M,...] -> [...,M + 16]: a vector that starts at the last surfel is still inside."""
    planes = rows.detach().movedim(0, -1).to(dtype)
    return torch.nn.functional.pad(planes, (0, _LANES)).contiguous()
