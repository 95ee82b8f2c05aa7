"""The avatar: what a fit returns. A pose in, surfels or a picture out; one safetensors file on disk."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.channels import Channel, ChannelImage, extract, parse_channel, raster_options
from mass_engine.deform.network import DeformationConfig
from mass_engine.deform.posing import CompiledSurfels, MeshPose, PosableSurfels, ShadedSurfels
from mass_engine.deform.static import StaticResiduals
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, PosedSurfels, Shape, surfel_colors
from mass_engine.hand.model import HandModel, PosedHand
from mass_engine.hand.pose import HandPose, Side
from mass_engine.hand.poses import POSE_NAMES, parse_pose
from mass_engine.raster import RasterOptions, RenderOutput, rasterize
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.cloud import SurfelCloud
from mass_engine.surfel.harmonics import rgb_to_sh0
from mass_engine.threads import one_thread
from mass_engine.viewpoint import parse_camera

FILE_NAME = "avatar.safetensors"
_FORMAT = "4"
#: Those of format 3 have no static residuals.
_READABLE = ("3", "4")


@dataclass(frozen=True)
class SourceFrames:
    """The clip's own poses: ``indices`` [F] of the frames, ``heldout`` [F], ``pose`` batched [F].

    ``gains`` [F,3] by which each frame's colours are brighter than the avatar's (exposure, white balance).
    """

    indices: Tensor
    heldout: Tensor
    pose: HandPose
    gains: Tensor

    def pose_of(self, index: int) -> HandPose:
        """The pose of the frame ``index``. Raises BadArgumentError ``pose.no_such_frame``."""
        return row_pose(self.pose, self.row_of(index))

    def gain_of(self, index: int) -> Tensor:
        """The gain [3] of the frame ``index``. Raises BadArgumentError ``pose.no_such_frame``."""
        return self.gains[self.row_of(index)]

    def row_of(self, index: int) -> int:
        """The row of the frame ``index``. Raises BadArgumentError ``pose.no_such_frame``."""
        rows = (self.indices == index).nonzero()
        if len(rows) == 0:
            raise BadArgumentError(
                "pose.no_such_frame",
                f"Frame {index} has no fitted hand.",
                "Use a frame in which the hand was tracked, "
                f"from {int(self.indices.min())} to {int(self.indices.max())}.",
            )
        return int(rows[0])


def _sphere(vertices: Tensor) -> tuple[Tensor, float]:
    """Centre [3] and radius of a sphere around ``vertices`` [V,3]."""
    center = (vertices.amax(0) + vertices.amin(0)) / 2
    return center, float((vertices - center).norm(dim=-1).max())


def row_pose(pose: HandPose, row: int) -> HandPose:
    """One row of a batched pose, as a batch of one."""
    return pose.rows(torch.tensor([row]))


@dataclass
class Avatar:
    """A posable hand: the surfels of ``skin`` and what they look like.

    Finished: once rendered, changes of its tensors no longer reach the picture.
    """

    shape: Shape
    skin: Skin
    appearance: Appearance
    camera: Camera  # the fitted camera, whole picture
    frames: SourceFrames
    best_frame: int  # where the hand is seen best: its orientation serves the named poses

    def posed(self, pose: HandPose) -> PosedSurfels:
        """The surfels of a batch of poses [B]."""
        with torch.no_grad():
            return self.skin.pose(self.shape, pose)

    def render_pose(
        self, pose: HandPose, camera: Camera, options: RasterOptions | None = None
    ) -> RenderOutput:
        """Rasterise one pose (a batch of one) over black."""
        options = options or RasterOptions(cull_backfaces=True)
        return _rasterize(self._shaded(pose, self._hand(pose), camera), camera, options)

    def image(self, pose: HandPose, camera: Camera, channel: Channel = "rgb") -> ChannelImage:
        """One channel of one pose (a batch of one)."""
        return self._image(pose, self._hand(pose), camera, channel)

    def _image(self, pose: HandPose, hand: PosedHand, camera: Camera, channel: Channel) -> ChannelImage:
        surfels = self._shaded(pose, hand, camera)
        out = _rasterize(surfels, camera, raster_options(channel, surfels.means, camera))
        return extract(channel, out, surfels.means, camera)

    def _hand(self, pose: HandPose) -> PosedHand:
        with torch.no_grad(), one_thread():
            return self.shape.model.posed(pose, self.shape.displacement)

    @cached_property
    def _compiled(self) -> CompiledSurfels:
        return self.posable().compiled()

    def posable(self) -> PosableSurfels:
        """The surfels ready for posing, shared."""
        look, skin = self.appearance, self.skin
        return PosableSurfels(
            skin.binding,
            skin.sources,
            look.albedo,
            torch.sigmoid(look.opacity_logits),
            look.sh,
            look.light,
            None if skin.deformation is None else skin.deformation.freeze(),
            skin.detached_from,
            skin.static,
        )

    def _shaded(self, pose: HandPose, hand: PosedHand, camera: Camera) -> ShadedSurfels:
        """The surfels in one pose (a batch of one, and the ``hand`` in it) as ``camera`` sees them."""
        with torch.no_grad(), one_thread():
            refined = self.skin.binding.subdivision.apply(hand.vertices)[0]
            center = -camera.world_to_camera[:3, :3].T @ camera.world_to_camera[:3, 3]
            bones = hand.bone_transforms[0, :, :3, :3]
            return self._compiled.posed(MeshPose(refined, bones, center, pose.hand_pose[0], pose.betas[0]))

    def resolve_pose(self, spec: str) -> HandPose:
        """``frame:N``, a named pose or 48 numbers -> a placed pose with this hand's shape (batch of one).

        A named pose takes the orientation of the frame that shows the hand best; what is not a frame
        stands on the camera's axis at that frame's distance.
        """
        return self._placed(spec)[0]

    def _placed(self, spec: str) -> tuple[HandPose, PosedHand]:
        """The pose of :meth:`resolve_pose`, and the hand in it: posed once, wherever it is then put."""
        text = spec.strip()
        if text.startswith("frame:"):
            number = text.removeprefix("frame:")
            if not (number.isascii() and number.isdigit() and len(number) < 10):
                raise BadArgumentError("pose.invalid", f"{spec[:40]!r} names no frame.", "Use frame:12, say.")
            pose = self.frames.pose_of(int(number))
            return pose, self._hand(pose)
        best = self.frames.pose_of(self.best_frame)
        parsed = parse_pose(text, self.shape.model.side, self.shape.model)
        orient = best.global_orient if text in POSE_NAMES else parsed.global_orient.reshape(1, 3)
        pose = HandPose(
            self.shape.betas.reshape(1, 10),
            orient,
            parsed.hand_pose.reshape(1, 45),
            torch.zeros(1, 3),
            parsed.side,
        )
        hand = self._hand(pose)
        center, _ = _sphere(hand.vertices[0])
        shift = (self.camera_point(float(best.transl[0, 2])) - center)[None]
        placed = HandPose(pose.betas, pose.global_orient, pose.hand_pose, shift, pose.side)
        return placed, hand.moved(shift)

    def camera_point(self, depth: float) -> Tensor:
        """The world point [3] on the fitted camera's axis at ``depth`` metres."""
        rotation, shift = self.camera.world_to_camera[:3, :3], self.camera.world_to_camera[:3, 3]
        return rotation.T @ (torch.tensor([0.0, 0.0, max(depth, 0.1)]) - shift)

    def view(
        self,
        pose_spec: str,
        camera_spec: str = "orbit:0,0",
        width: int = 512,
        height: int = 512,
        channel: str = "rgb",
    ) -> ChannelImage:
        """One channel of a pose seen by a camera. Raises BadArgumentError for a bad specification."""
        wanted = parse_channel(channel)
        pose, hand, camera = self._viewed(pose_spec, camera_spec, width, height)
        return self._image(pose, hand, camera, wanted)

    def resolve_view(
        self, pose_spec: str, camera_spec: str, width: int, height: int
    ) -> tuple[HandPose, Camera]:
        """A placed pose (batch of one) and the camera that sees it. Raises BadArgumentError."""
        pose, _, camera = self._viewed(pose_spec, camera_spec, width, height)
        return pose, camera

    def _viewed(
        self, pose_spec: str, camera_spec: str, width: int, height: int
    ) -> tuple[HandPose, PosedHand, Camera]:
        if not (1 <= width <= 16384 and 1 <= height <= 16384):
            raise BadArgumentError("size.invalid", f"{width}x{height} is not a picture.", "Use 1 to 16384.")
        pose, hand = self._placed(pose_spec)
        center, radius = _sphere(hand.vertices[0])
        return pose, hand, parse_camera(camera_spec, self.camera, width, height, center, radius)

    def render(
        self,
        pose_spec: str,
        camera_spec: str = "orbit:0,0",
        width: int = 512,
        height: int = 512,
        channel: str = "rgb",
    ) -> NDArray[np.uint8]:
        """The picture of :meth:`view`: straight-alpha RGBA uint8 [H,W,4]."""
        with one_thread():
            return self.view(pose_spec, camera_spec, width, height, channel).picture()

    def cloud(self, pose_spec: str = "rest") -> SurfelCloud:
        """The surfels in a pose, shaded as in the clip; hand at the origin for poses that are no frame.

        In the rest pose the view-dependent harmonics come along (a bone's frame is the world's there).
        """
        pose = self.resolve_pose(pose_spec)
        if pose_spec.strip() == "rest":
            rest = HandPose.rest(self.shape.model.side)
            pose = HandPose(
                pose.betas, rest.global_orient[None], rest.hand_pose[None], rest.transl[None], rest.side
            )
        surfels = self.posed(pose)
        plain = Appearance(
            self.appearance.albedo,
            self.appearance.opacity_logits,
            self.appearance.sh[:, :0],
            self.appearance.light,
        )
        attached = surfels.row(0)
        bones = self.skin.bones
        colors = surfel_colors(plain, attached, surfels.bone_rotations[0], bones, self.camera)
        opacities = torch.sigmoid(self.appearance.opacity_logits)
        scales, quats = attached.scales_quats()
        sh = rgb_to_sh0(colors).unsqueeze(1)
        if pose_spec.strip() == "rest":
            sh = torch.cat([sh, self.appearance.sh], 1)
        return SurfelCloud(
            attached.means,
            scales,
            quats,
            opacities if surfels.mask is None else opacities * surfels.mask[0],
            sh,
            self.skin.faces,
        )

    def save(self, path: Path) -> None:
        """Write the avatar to a file, or into a run directory, in one step."""
        target = path / FILE_NAME if path.is_dir() else path
        model, pose = self.shape.model, self.frames.pose
        tensors = {
            "shape.betas": self.shape.betas,
            "shape.displacement": self.shape.displacement,
            "sources": self.skin.sources,
            "albedo": self.appearance.albedo,
            "opacity_logits": self.appearance.opacity_logits,
            "sh": self.appearance.sh,
            "light": self.appearance.light,
            "camera.K": self.camera.K,
            "camera.world_to_camera": self.camera.world_to_camera,
            "frames.indices": self.frames.indices,
            "frames.gains": self.frames.gains,
            "frames.heldout": self.frames.heldout,
            "frames.betas": pose.betas,
            "frames.global_orient": pose.global_orient,
            "frames.hand_pose": pose.hand_pose,
            "frames.transl": pose.transl,
            **{f"model.{name}": value for name, value in model.tensors().items()},
        }
        metadata = {
            "format": _FORMAT,
            "side": model.side,
            "levels": str(self.skin.binding.levels),
            "depth": str(self.skin.binding.depth),
            "widened": str(int(self.skin.binding.widened)),
            "detached_from": str(self.skin.detached_from),
            "best_frame": str(self.best_frame),
            "size": json.dumps([self.camera.width, self.camera.height]),
        }
        moving, static = self.skin.deformation, self.skin.static
        if static is not None:
            tensors |= {f"static.{name}": value for name, value in static.tensors().items()}
        if moving is not None:
            tensors |= {f"deformation.{name}": value for name, value in moving.tensors().items()}
            metadata["deformation"] = json.dumps(moving.config.to_dict())
        partial = target.with_name(target.name + ".partial")
        save_file(
            {name: value.detach().contiguous().clone() for name, value in tensors.items()}, partial, metadata
        )
        os.replace(partial, target)

    @staticmethod
    def load(path: Path | str) -> Avatar:
        """Read an avatar from its file or its run directory.

        Raises EngineError ``avatar.not_found`` or ``avatar.corrupt``.
        """
        source = Path(path)
        source = source / FILE_NAME if source.is_dir() else source
        sides = [side for side in ("right", "left") if (source.parent / side / FILE_NAME).is_file()]
        if not source.is_file() and sides:
            raise EngineError(
                "avatar.not_found",
                f"{source.parent} holds the avatars of a person's hands.",
                f"Choose one: {' or '.join(str(source.parent / side) for side in sides)}.",
            )
        if not source.is_file():
            raise EngineError("avatar.not_found", f"There is no avatar at {source}.", "Fit one first.")
        try:
            with safe_open(source, framework="pt") as file:
                metadata = cast("dict[str, str]", file.metadata() or {})
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
            return _assemble(metadata, tensors)
        except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError, IndexError) as error:
            raise EngineError(
                "avatar.corrupt", f"{source.name} is not a readable avatar ({error}).", "Fit it again."
            ) from error


def _rasterize(surfels: ShadedSurfels, camera: Camera, options: RasterOptions) -> RenderOutput:
    with torch.no_grad():
        return rasterize(
            surfels.means, surfels.tangents, surfels.opacities, surfels.colors, camera, options=options
        )


def _assemble(metadata: dict[str, str], tensors: dict[str, Tensor]) -> Avatar:
    if metadata["format"] not in _READABLE:
        raise ValueError(f"format {metadata['format']!r}, not one of {', '.join(_READABLE)}")
    if metadata["side"] not in ("left", "right"):
        raise ValueError("no side")
    side = cast("Side", metadata["side"])
    prefix = "model."
    model = HandModel.from_tensors(
        side, {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
    )
    shape = Shape(
        model,
        tensors["shape.betas"],
        tensors["shape.displacement"],
    )
    width, height = json.loads(metadata["size"])
    pose = HandPose(
        tensors["frames.betas"],
        tensors["frames.global_orient"],
        tensors["frames.hand_pose"],
        tensors["frames.transl"],
        side,
    )
    return Avatar(
        shape,
        _skin(metadata, tensors, model),
        Appearance(tensors["albedo"], tensors["opacity_logits"], tensors["sh"], tensors["light"]),
        Camera(tensors["camera.K"], tensors["camera.world_to_camera"], int(width), int(height)),
        SourceFrames(tensors["frames.indices"], tensors["frames.heldout"], pose, tensors["frames.gains"]),
        int(metadata["best_frame"]),
    )


def _skin(metadata: dict[str, str], tensors: dict[str, Tensor], model: HandModel) -> Skin:
    levels, depth, widened = (int(metadata[name]) for name in ("levels", "depth", "widened"))
    binding = MeshBinding.build(model, levels, depth, bool(widened))
    sources, start = tensors["sources"], int(metadata["detached_from"])
    if not (len(sources) and 0 <= int(sources.min()) <= int(sources.max()) < binding.count):
        raise ValueError("a surfel is not in the binding")
    if not 0 <= start <= len(sources):
        raise ValueError("detached_from is out of range")
    skin = Skin(binding, sources, start, static=StaticResiduals.read(tensors, start))
    if "deformation" in metadata:
        config = DeformationConfig.from_dict(json.loads(metadata["deformation"]))
        skin.deformation = skin.new_deformation(model, config, 0)
        prefix = "deformation."
        skin.deformation.load_tensors(
            {name.removeprefix(prefix): v for name, v in tensors.items() if name.startswith(prefix)}
        )
    return skin
