"""Clips of the other hand with exact truth: pictures as a camera would take them, masks, depth, normals."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mass_engine.camera import Camera
from mass_engine.evaluation.demo_clip import ClipOptions, background, motion
from mass_engine.evaluation.mesh_raster import rasterize_mesh
from mass_engine.evaluation.synthetic.hand import BACKGROUND, HAND, OtherHand, Part, torus, tube
from mass_engine.hand.pose import HandPose

Array = NDArray[np.float64]

FOV = 55.0
#: Sub-pixels along a side, and how much of a frame's time the shutter is open.
_FINER, _SHUTTER = 2, 0.4


@dataclass(frozen=True)
class SceneOptions:
    """What is in the clip. ``blur`` is how many instants a frame is the mean of (1: none)."""

    clip: ClipOptions
    wrinkles: bool = True
    moving_light: bool = False
    ring: bool = False
    held: bool = False
    forearm: bool = False
    blur: int = 1


@dataclass(frozen=True)
class TrueFrame:
    """One frame: ``rgb`` uint8 [H,W,3]; ``labels`` [H,W] as user masks (0, 128 worn, held or arm, 255 hand);
    ``coverage`` of the hand [H,W]; ``depth`` [H,W] metres and ``normals`` [H,W,3] (camera axes, to the
    camera) at the middle instant, 0 where no hand is; ``vertices`` [V,3], ``points`` [21,3] in camera
    metres."""

    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    coverage: NDArray[np.float32]
    depth: Array
    normals: Array
    vertices: Array
    points: Array


@dataclass(frozen=True)
class Scene:
    """A hand, a camera and a table."""

    options: SceneOptions
    hand: OtherHand
    camera: Camera
    table: NDArray[np.float32]

    @staticmethod
    def make(options: SceneOptions) -> Scene:
        """The scene of one clip; the seed is the clip's."""
        clip = options.clip
        random = np.random.default_rng(clip.seed)
        table = background(clip.width, clip.height, random)
        grain = random.normal(0, 0.02, table.shape[:2]).astype(np.float32)
        table = np.clip(table + cv2.GaussianBlur(grain, (0, 0), 0.7)[..., None], 0, 1)
        hand = OtherHand.make(clip.seed, options.wrinkles)
        return Scene(options, hand, Camera.from_fov(clip.width, clip.height, FOV), table)

    @property
    def count(self) -> int:
        """Number of frames."""
        return max(2, round(self.options.clip.seconds * self.options.clip.fps))

    def frames(self) -> Iterator[TrueFrame]:
        """All frames in order."""
        random = np.random.default_rng(self.options.clip.seed + 1)
        for number in range(self.count):
            yield self._frame(number, random)

    def pose(self, phase: float) -> HandPose:
        """The hand's pose at ``phase`` 0..1 (a batch of one)."""
        pose = motion(phase, self.hand.model, torch.zeros(10))
        # Half a turn in the middle of the clip: first one side is seen, then the other with its nails.
        share = min(max((phase - 0.3) / 0.4, 0.0), 1.0)
        turn = Rotation.from_rotvec([0.0, math.pi * share * share * (3 - 2 * share), 0.0])
        orient = turn * Rotation.from_rotvec(pose.global_orient[0].double().numpy())
        pose = replace(pose, global_orient=torch.tensor(orient.as_rotvec(), dtype=torch.float32)[None])
        center = self.hand.model.joints(pose)[0].mean(0)
        before = self.hand.model.joints(motion(phase, self.hand.model, torch.zeros(10)))[0].mean(0)
        return replace(pose, transl=pose.transl + (before - center)[None])

    def _frame(self, number: int, random: np.random.Generator) -> TrueFrame:
        o = self.options
        rgb = np.zeros((o.clip.height, o.clip.width, 3))
        kinds = np.zeros((o.clip.height, o.clip.width, 3))  # hand, ignored, background
        for instant in range(o.blur):
            late = ((instant + 0.5) / o.blur - 0.5) * _SHUTTER
            picture, shares = self._shot((number + late) / self.count, _FINER)
            rgb += picture / o.blur
            kinds += shares / o.blur
        rgb = cv2.GaussianBlur(rgb, (0, 0), 0.45) + random.normal(0, 0.006, rgb.shape)
        labels = np.full(rgb.shape[:2], BACKGROUND, np.uint8)
        labels[kinds[..., 0] > 0.5] = HAND
        labels[kinds[..., 1] > 0.02] = 128
        depth, normals, vertices, points = self._geometry(number / self.count)
        return TrueFrame(
            (np.clip(rgb, 0, 1) * 255).round().astype(np.uint8),
            labels,
            np.where(labels == 128, 0, kinds[..., 0]).astype(np.float32),
            depth,
            normals,
            vertices,
            points,
        )

    def _parts(self, pose: HandPose) -> tuple[list[Part], Array]:
        """Everything but the table, the hand first; and the 21 points."""
        vertices, points = self.hand.posed(pose)
        turns, joints = self.hand.frames(pose)
        parts = [self.hand.part(vertices)]
        if self.options.ring:
            along = joints[11] - joints[10]
            bone = along / np.linalg.norm(along)
            parts.append(torus(joints[10] + 0.6 * along - 0.0012 * turns[10][:, 1], bone, 0.0101, 0.0011))
        if self.options.forearm:
            back = turns[0] @ np.array([1.0, 0.0, 0.0])
            parts.append(tube(joints[0] + 0.018 * back, joints[0] + 0.25 * back, (0.026, 0.038)))
        if self.options.held:
            across, down = turns[0] @ np.array([0.25, 0.0, 1.0]), turns[0] @ np.array([0.0, -1.0, 0.0])
            middle = joints[0] + 0.055 * (joints[4] - joints[0]) / np.linalg.norm(joints[4] - joints[0])
            middle = middle + 0.032 * down
            pen = tube(middle - 0.07 * across, middle + 0.08 * across, (0.008, 0.008))
            stripes = 0.5 + 0.5 * np.sign(np.sin(pen.vertices @ across * 300))[:, None]
            color = stripes * [0.1, 0.25, 0.7] + (1 - stripes) * [0.85, 0.8, 0.2]
            parts.append(Part(pen.vertices, pen.faces, color, 0.6, 128))
        return parts, points

    def _shot(self, phase: float, finer: int) -> tuple[Array, Array]:
        """Picture [H,W,3] of one instant, and the shares [H,W,3] of hand, ignored things, background."""
        parts, _ = self._parts(self.pose(phase))
        height, width = self.camera.height, self.camera.width
        camera = self.camera.resized(width * finer, height * finer)
        offsets = np.cumsum([0, *[len(part.vertices) for part in parts]])
        vertices = np.concatenate([part.vertices for part in parts])
        faces = np.concatenate([part.faces + start for part, start in zip(parts, offsets, strict=False)])
        owner = np.concatenate([np.full(len(part.faces), row) for row, part in enumerate(parts)])
        colors = np.concatenate(
            [_lit(part, normals_of(part.vertices, part.faces), self._light(phase)) for part in parts]
        )
        found = rasterize_mesh(vertices, faces, camera)
        hit = found.face >= 0
        picture = np.repeat(np.repeat(self.table.astype(np.float64), finer, 0), finer, 1)
        picture[hit] = found.interpolate(faces, colors)[hit]
        label = np.array([part.label for part in parts])[owner[np.maximum(found.face, 0)]]
        kinds = np.stack([hit & (label == HAND), hit & (label != HAND), ~hit], -1).astype(np.float64)
        return _binned(picture, finer), _binned(kinds, finer)

    def _light(self, phase: float) -> Array:
        """Where the lamp is seen from the hand (unit, camera axes: y down, z away)."""
        swing = 2 * math.pi * phase if self.options.moving_light else 0.0
        lamp = np.array([-0.45 + 0.55 * math.sin(swing), -0.75, -0.55 + 0.35 * math.cos(swing)])
        return np.asarray(lamp / np.linalg.norm(lamp))

    def _geometry(self, phase: float) -> tuple[Array, Array, Array, Array]:
        """Depth and normals of the hand where it is seen, its vertices and points."""
        parts, points = self._parts(self.pose(phase))
        hand = parts[0]
        offsets = np.cumsum([0, *[len(part.vertices) for part in parts]])
        vertices = np.concatenate([part.vertices for part in parts])
        faces = np.concatenate([part.faces + start for part, start in zip(parts, offsets, strict=False)])
        found = rasterize_mesh(vertices, faces, self.camera)
        own = (found.face >= 0) & (found.face < len(hand.faces))
        normals = normals_of(hand.vertices, hand.faces)
        every = np.concatenate([normals, np.zeros((len(vertices) - len(normals), 3))])
        seen = found.interpolate(faces, every)
        return np.where(own, found.depth, 0), np.where(own[..., None], seen, 0), hand.vertices, points


def normals_of(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Area-weighted unit normals [V,3]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, k], flat[:, axis], len(vertices))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))


def _lit(part: Part, normals: Array, lamp: Array) -> Array:
    """Colours [V,3]: sky and table light, one soft lamp, and a highlight that moves with the eye."""
    view = -part.vertices / np.linalg.norm(part.vertices, axis=1, keepdims=True)
    sky = 0.5 - 0.5 * normals[:, 1]
    soft = np.clip((normals @ lamp + 0.25) / 1.25, 0, 1) ** 1.2
    irradiance = 0.26 + 0.16 * sky[:, None] * np.array([0.95, 1.0, 1.08]) + 0.62 * soft[:, None]
    half = lamp + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = part.gloss * 0.22 * np.clip((normals * half).sum(1), 0, 1) ** 24
    return np.asarray(part.albedo * irradiance + shine[:, None])


def _binned(picture: Array, by: int) -> Array:
    height, width = picture.shape[0] // by, picture.shape[1] // by
    return np.asarray(picture.reshape(height, by, width, by, -1).mean((1, 3)))
