"""The subject of a fit: one hand's shape, its personal surface and what its surfels look like."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.deform.residuals import Residuals
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions, RenderOutput, rasterize
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding
from mass_engine.surfel.harmonics import evaluate_sh_rest
from mass_engine.surfel.shading import shade

#: Opacity every surfel starts from: the hand is opaque.
START_OPACITY = 0.95


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit normals [V,3] of a mesh."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    face_normals = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(0, faces[:, corner], face_normals)
    return torch.nn.functional.normalize(total, dim=-1)


def mesh_edges(faces: Tensor) -> Tensor:
    """Unique undirected edges [E,2] of ``faces`` [F,3]."""
    pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges: Tensor = torch.unique(pairs.sort(dim=1).values, dim=0)
    return edges


@dataclass
class Shape:
    """``betas`` [10] and a displacement [V,3] in metres of the rest vertices (the personal surface)."""

    model: HandModel
    betas: Tensor
    displacement: Tensor

    def to(self, device: torch.device | str) -> Shape:
        """The same shape elsewhere (itself if it is there)."""
        if self.betas.device == torch.device(device):
            return self
        return Shape(self.model.to(device), self.betas.to(device), self.displacement.to(device))

    @staticmethod
    def mean(model: HandModel, betas: Tensor) -> Shape:
        """No displacement yet."""
        return Shape(model, betas.clone(), torch.zeros_like(model.template))


@dataclass
class Appearance:
    """Per surfel: ``albedo`` [N,3], ``opacity_logits`` [N], ``sh`` [N,K,3] of degree 1 on in the rest
    frame of the surfel's bone (K = 0, 3, 8 or 15); for the clip: ``light`` [9,3]."""

    albedo: Tensor
    opacity_logits: Tensor
    sh: Tensor
    light: Tensor

    def to(self, device: torch.device | str) -> Appearance:
        """The same look elsewhere (itself if it is there)."""
        if self.albedo.device == torch.device(device):
            return self
        return Appearance(*(getattr(self, field.name).to(device) for field in fields(self)))

    def take(self, other: Appearance) -> None:
        """The values of ``other``, wherever they are."""
        if other is not self:
            for field in fields(self):
                getattr(self, field.name).copy_(getattr(other, field.name).detach())

    @staticmethod
    def plain(count: int, light: Tensor, harmonics: int = 0) -> Appearance:
        """Grey surfels of the opacity every fit starts from, under ``light``."""
        opacity = float(torch.logit(torch.tensor(START_OPACITY)))
        return Appearance(
            torch.full((count, 3), 0.5),
            torch.full((count,), opacity),
            torch.zeros(count, harmonics, 3),
            light.clone(),
        )


@dataclass
class PosedSurfels:
    """Surfels of a batch of poses (means [B,N,3], tangents [B,N,2,3], normals [B,N,3]).

    With ``bone_rotations`` [B,16,3,3], ``joints`` [B,21,3] and the refined mesh's ``outline_vertices``
    [B,V',3]. ``mask`` [B,N] multiplies the opacities (None: ones); ``residuals`` [B,D] moved the last D.
    """

    attached: AttachedSurfels
    outline_vertices: Tensor
    bone_rotations: Tensor
    joints: Tensor
    mask: Tensor | None = None
    residuals: Residuals | None = None

    def row(self, row: int) -> AttachedSurfels:
        """The surfels of one pose of the batch."""
        a = self.attached
        return AttachedSurfels(a.means[row], a.tangents[row], a.normals[row])


def pose_surfels(shape: Shape, binding: MeshBinding, pose: HandPose) -> PosedSurfels:
    """Pose the hand and register a surfel in every small triangle; ``pose`` is batched [B]."""
    posed = shape.model.posed(pose, shape.displacement)
    refined = binding.subdivision.apply(posed.vertices)
    return PosedSurfels(binding.register(refined), refined, posed.bone_transforms[..., :3, :3], posed.joints)


def surfel_colors(
    appearance: Appearance, surfels: AttachedSurfels, bone_rotations: Tensor, bones: Tensor, camera: Camera
) -> Tensor:
    """Colours [N,3] of the surfels of one pose seen by ``camera``.

    ``bone_rotations`` [16,3,3] are the pose's, ``bones`` [N] says which one each surfel follows.
    """
    colors = shade(appearance.albedo, appearance.light, surfels.normals)
    if appearance.sh.shape[1] == 0:
        return colors
    rotation = camera.world_to_camera[:3, :3]
    center = -rotation.T @ camera.world_to_camera[:3, 3]
    directions = torch.nn.functional.normalize(surfels.means.detach() - center, dim=-1)
    # Into the rest frame of the bone: what the skin does with light turns with the skin.
    turned = (directions.unsqueeze(-2) @ bone_rotations.detach()[bones]).squeeze(-2)
    return (colors + evaluate_sh_rest(appearance.sh, turned)).clamp_min(0.0)


def render_row(
    appearance: Appearance,
    surfels: PosedSurfels,
    row: int,
    bones: Tensor,
    camera: Camera,
    options: RasterOptions,
    background: Tensor | None = None,
) -> RenderOutput:
    """Rasterise one pose of the batch."""
    attached = surfels.row(row)
    opacities = torch.sigmoid(appearance.opacity_logits)
    return draw(
        attached,
        opacities if surfels.mask is None else opacities * surfels.mask[row],
        surfel_colors(appearance, attached, surfels.bone_rotations[row], bones, camera),
        camera,
        options,
        background,
    )


def draw(
    surfels: AttachedSurfels,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    options: RasterOptions,
    background: Tensor | None = None,
) -> RenderOutput:
    """Rasterise surfels [N] with ``opacities`` [N] and ``colors`` [N,3]."""
    return rasterize(
        surfels.means, surfels.tangents, opacities, colors, camera, background=background, options=options
    )
