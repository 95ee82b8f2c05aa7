"""Many poses of one avatar at full throughput: pose to pixels as one graph on a GPU, several at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby

import torch
from torch import Tensor

from mass_engine.avatar import Avatar
from mass_engine.camera import Camera
from mass_engine.channels import Channel, ChannelImage, extract, raster_options
from mass_engine.deform.posing import MeshPose, PosableSurfels, ShadedSurfels
from mass_engine.errors import BadArgumentError
from mass_engine.fitting.subject import Shape
from mass_engine.graphs import Replayed
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions, RenderOutput, cuda, rasterize
from mass_engine.raster.cuda import MOST_PAIRS, STATUS

#: Poses drawn by one launch.
BATCH = 8


class ManyPoses:
    """Draws poses of the ``surfels`` of a hand over black, ``batch`` at a time, in pictures of one size.

    Everything lies on ``device`` at fixed addresses. On a GPU posing, deforming, shading and rasterising a
    batch are one graph; on a CPU the same operators run one by one (``Avatar.render_pose`` is faster there).
    """

    def __init__(
        self,
        shape: Shape,
        surfels: PosableSurfels,
        width: int,
        height: int,
        device: torch.device,
        batch: int = BATCH,
        options: RasterOptions | None = None,
    ) -> None:
        if batch < 1:
            raise BadArgumentError("render.batch", f"A batch of {batch} poses.", "Use 1 or more.")
        self.batch, self.device = batch, device
        self._size = width, height
        self._options = options or RasterOptions(cull_backfaces=True)
        self._shape, self._surfels = shape.to(device), surfels.to(device)
        betas, orient, fingers, transl = (torch.zeros(batch, n, device=device) for n in (10, 3, 45, 3))
        self._pose = HandPose(betas, orient, fingers, transl, shape.model.side)
        self._K = torch.eye(3, device=device).repeat(batch, 1, 1)
        self._world_to_camera = torch.eye(4, device=device).repeat(batch, 1, 1)
        self._step: Replayed[list[tuple[ShadedSurfels, RenderOutput]]] | None = None

    def draw(self, pose: HandPose, cameras: Sequence[Camera]) -> list[tuple[ShadedSurfels, RenderOutput]]:
        """Up to ``batch`` poses, each before its camera: surfels and picture.

        On a GPU nobody has waited for it, and it lies in memory that the next call overwrites.
        """
        count = len(pose.transl)
        if not 0 < count <= self.batch or len(cameras) != count:
            raise BadArgumentError(
                "render.batch",
                f"{count} poses and {len(cameras)} cameras.",
                f"Give 1 to {self.batch} poses and a camera for each.",
            )
        for camera in cameras:
            if (camera.width, camera.height) != self._size:
                raise BadArgumentError(
                    "size.invalid",
                    f"A camera of {camera.width}x{camera.height}.",
                    f"All pictures are {self._size[0]}x{self._size[1]}.",
                )
        # What is left of a batch repeats the last pose: it draws something of the same size.
        for name in ("betas", "global_orient", "hand_pose", "transl"):
            _fill(getattr(self._pose, name), getattr(pose, name))
        _fill(self._K, torch.stack([camera.K for camera in cameras]))
        _fill(self._world_to_camera, torch.stack([camera.world_to_camera for camera in cameras]))
        if self._step is None:
            self._make_room()
            self._step = Replayed(self._draw, self.device)
        return self._step()[:count]

    def lacked_room(self, drawn: Sequence[tuple[ShadedSurfels, RenderOutput]]) -> bool:
        """Wait for what was drawn: did it need more room than there was? Then draw it again: there is now."""
        status = [out.counters[STATUS] for _, out in drawn if out.counters is not None]
        if not status or not bool(torch.stack(status).any()):
            return False
        self._step = None
        return True

    def render(self, poses: HandPose, cameras: Sequence[Camera]) -> Iterator[tuple[Tensor, RenderOutput]]:
        """All ``poses`` [P], each before its camera, one after the other: means [M,3] of the surfels and the
        picture, valid until the next is asked for."""
        for start in range(0, len(poses.transl), self.batch):
            part = slice(start, start + self.batch)
            some = HandPose(
                poses.betas[part],
                poses.global_orient[part],
                poses.hand_pose[part],
                poses.transl[part],
                poses.side,
            )
            drawn = self.draw(some, cameras[part])
            if self.lacked_room(drawn):
                drawn = self.draw(some, cameras[part])
            for surfels, out in drawn:
                yield surfels.means, out

    def _make_room(self) -> None:
        """A GPU's memory is given out before the graph is made: draw these poses once and see."""
        if self.device.type != "cuda":
            return
        self._options = replace(self._options, pair_capacity=None)
        self._draw()
        room = 2 * cuda.shared_backend().room(len(self._surfels.sources))
        self._options = replace(self._options, pair_capacity=min(room, MOST_PAIRS))

    def _draw(self) -> list[tuple[ShadedSurfels, RenderOutput]]:
        pose, (width, height) = self._pose, self._size
        with torch.no_grad():
            hand = self._shape.model.posed(pose, self._shape.displacement)
            refined = self._surfels.binding.subdivision.apply(hand.vertices)
            turn, shift = self._world_to_camera[:, :3, :3], self._world_to_camera[:, :3, 3]
            center = -(turn.mT @ shift.unsqueeze(-1)).squeeze(-1)
            bones = hand.bone_transforms[..., :3, :3]
            many = self._surfels.posed_batch(MeshPose(refined, bones, center, pose.hand_pose, pose.betas))
            return [self._drawn(many.row(row), row, width, height) for row in range(self.batch)]

    def _drawn(
        self, surfels: ShadedSurfels, row: int, width: int, height: int
    ) -> tuple[ShadedSurfels, RenderOutput]:
        camera = Camera(self._K[row], self._world_to_camera[row], width, height)
        out = rasterize(
            surfels.means,
            surfels.tangents,
            surfels.opacities,
            surfels.colors,
            camera,
            options=self._options,
        )
        return surfels, out


def draw_images(
    avatar: Avatar,
    poses: Sequence[HandPose],
    cameras: Sequence[Camera],
    channel: Channel,
    device: torch.device,
) -> Iterator[ChannelImage]:
    """One channel of each pose (a batch of one) before its camera, in their order.

    On a CPU one by one, as they are asked for; on a GPU in batches of pictures of one size. Channels whose
    scale is the picture's own are drawn one by one there, too.
    """
    if device.type == "cpu":
        yield from (avatar.image(pose, camera, channel) for pose, camera in zip(poses, cameras, strict=True))
        return
    surfels = avatar.posable()
    runs = groupby(zip(poses, cameras, strict=True), key=lambda pair: (pair[1].width, pair[1].height))
    for (width, height), pairs in runs:
        some = list(pairs)
        if channel in ("rgb", "alpha", "depth"):
            batch, options = min(BATCH, len(some)), RasterOptions(cull_backfaces=True)
            many = ManyPoses(avatar.shape, surfels, width, height, device, batch, options)
            drawn = many.render(_joined([pose for pose, _ in some]), [camera for _, camera in some])
            for (means, out), (_, camera) in zip(drawn, some, strict=True):
                yield _on_cpu(extract(channel, out, means, camera.to(device)))
            continue
        for pose, camera in some:
            with torch.no_grad():
                means = avatar.posed(pose).attached.means[0]
            options = raster_options(channel, means, camera)
            one = ManyPoses(avatar.shape, surfels, width, height, device, 1, options)
            ((means, out),) = one.render(pose, [camera])
            yield _on_cpu(extract(channel, out, means, camera.to(device)))


def _fill(buffer: Tensor, values: Tensor) -> None:
    count = len(values)
    buffer[:count].copy_(values, non_blocking=True)
    if count < len(buffer):
        buffer[count:].copy_(values[-1:].expand_as(buffer[count:]), non_blocking=True)


def _joined(poses: Sequence[HandPose]) -> HandPose:
    return HandPose(
        torch.cat([pose.betas for pose in poses]),
        torch.cat([pose.global_orient for pose in poses]),
        torch.cat([pose.hand_pose for pose in poses]),
        torch.cat([pose.transl for pose in poses]),
        poses[0].side,
    )


def _on_cpu(image: ChannelImage) -> ChannelImage:
    return ChannelImage(image.channel, image.values.cpu(), image.alpha.cpu())
