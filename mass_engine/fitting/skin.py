"""The surfels of a fit: which of a binding's are attached, which detached, and what moves these."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.deform.network import Deformation, DeformationConfig, UnitCube
from mass_engine.deform.residuals import deform
from mass_engine.deform.static import StaticResiduals
from mass_engine.fitting.subject import PosedSurfels, Shape
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding


@dataclass
class Skin:
    """M surfels of ``binding``: ``sources`` [M] says whose copy each is; attached ones come first, those from
    ``detached_from`` on are detached. ``deformation`` has a row for each detached one, ``static`` for each
    attached one (None: they are where the mesh has them)."""

    binding: MeshBinding
    sources: Tensor
    detached_from: int
    deformation: Deformation | None = None
    static: StaticResiduals | None = None

    @staticmethod
    def attached(binding: MeshBinding) -> Skin:
        """Every surfel of the binding but the widened ones, none detached."""
        every = torch.arange(binding.count)
        if binding.widened:
            every = every[every % binding.per_face != binding.per_face - 1]
        return Skin(binding, every, len(every))

    def with_detached(self, sources: Tensor) -> Skin:
        """Detached copies of the surfels ``sources`` [D] of the binding after the attached ones."""
        attached = self.sources[: self.detached_from]
        return Skin(self.binding, torch.cat([attached, sources]), len(attached))

    def to(self, device: torch.device | str) -> Skin:
        """The same surfels elsewhere, with a deformation of their own (themselves if they are there)."""
        if self.sources.device == torch.device(device):
            return self
        moving = None if self.deformation is None else self.deformation.copied_to(device)
        static = None if self.static is None else self.static.to(device)
        return Skin(self.binding.to(device), self.sources.to(device), self.detached_from, moving, static)

    def take(self, other: Skin) -> None:
        """The residuals' values in ``other``, the same surfels elsewhere."""
        if other is self:
            return
        if self.deformation is not None and other.deformation is not None:
            self.deformation.load_tensors(other.deformation.tensors())
        if self.static is not None and other.static is not None:
            self.static.take(other.static)

    @property
    def count(self) -> int:
        """M."""
        return len(self.sources)

    @property
    def detached(self) -> Tensor:
        """Sources [D] of the detached surfels."""
        return self.sources[self.detached_from :]

    @property
    def bones(self) -> Tensor:
        """The bone each surfel follows [M]."""
        return self.binding.bones[self.sources]

    @property
    def faces(self) -> Tensor:
        """The face of the base mesh each surfel belongs to [M]."""
        return self.binding.surfel_faces[self.sources]

    def new_deformation(self, model: HandModel, config: DeformationConfig, seed: int) -> Deformation:
        """An untrained deformation of the detached surfels: the identity."""
        with torch.no_grad():
            centroids = self.binding.surfels(model.template).means[self.detached]
        return Deformation(
            config,
            centroids,
            self.binding.surfel_faces[self.detached],
            len(self.binding.base_faces),
            UnitCube.around(model.template),
            torch.Generator().manual_seed(seed),
        )

    def pick(self, kept: Tensor, model: HandModel) -> Skin:
        """Only the surfels ``kept`` (bool [M]); this skin stays as it is."""
        attached = int(kept[: self.detached_from].sum())
        picked = Skin(self.binding, self.sources[kept], attached)
        if self.deformation is not None:
            picked.deformation = picked.new_deformation(model, self.deformation.config, 0)
            picked.deformation.load_tensors(self.deformation.tensors())
        if self.static is not None:
            picked.static = self.static.rows(kept[: self.detached_from])
        return picked

    def pose(self, shape: Shape, pose: HandPose) -> PosedSurfels:
        """The surfels of a batch of poses [B]; differentiable in the residuals alone."""
        with torch.no_grad():
            posed = shape.model.posed(pose, shape.displacement)
            refined = self.binding.subdivision.apply(posed.vertices)
            turns = posed.bone_transforms[..., :3, :3]
        return self.on_mesh(refined, turns, posed.joints, pose.hand_pose, pose.betas)

    def on_mesh(
        self, refined: Tensor, bone_rotations: Tensor, joints: Tensor, hand_pose: Tensor, betas: Tensor
    ) -> PosedSurfels:
        """The surfels of posed refined meshes [B,V',3], whose bones and poses these are.

        ``bone_rotations`` [B,16,3,3], ``joints`` [B,21,3], ``hand_pose`` [B,45], ``betas`` [B,10].
        Differentiable in the residuals alone.
        """
        with torch.no_grad():
            surfels = self.binding.register(refined)
            if self.count != self.binding.count or self.detached_from < self.count:
                surfels = AttachedSurfels(
                    surfels.means[:, self.sources],
                    surfels.tangents[:, self.sources],
                    surfels.normals[:, self.sources],
                )
        if self.static is None and self.deformation is None:
            return PosedSurfels(surfels, refined, bone_rotations, joints)
        start = self.detached_from
        attached, detached = surfels.part(slice(start)), surfels.part(slice(start, None))
        if self.static is not None:
            attached = self.static.apply(attached)
        if self.deformation is None:
            return PosedSurfels(attached.then(detached), refined, bone_rotations, joints)
        residuals = self.deformation(hand_pose, betas)
        moved, mask = deform(detached, residuals), residuals.mask
        mask = torch.cat([mask.new_ones(len(mask), start), mask], 1)
        return PosedSurfels(attached.then(moved), refined, bone_rotations, joints, mask, residuals)

    def triangles(self, refined: Tensor) -> Tensor:
        """The refined mesh's faces [B,D,3 corners,3] that the detached surfels come from."""
        faces = self.binding.subdivision.faces[
            torch.div(self.detached, self.binding.per_face, rounding_mode="floor")
        ]
        return refined[:, faces]
