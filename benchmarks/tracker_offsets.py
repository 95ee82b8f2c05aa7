"""Measure where the tracker puts its 21 points on the built-in hand: the table in tracking/offsets.py.

``python benchmarks/tracker_offsets.py [--renders 3000]`` renders the built-in hand with random shapes, poses,
skin and light, tracks it, and solves for the offset of every point from its joint in the frame of its bone
(iteratively reweighted least squares on the pixels). It prints the offsets in millimetres and the error on
renders that were not used, before and after.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mass_engine.camera import Camera
from mass_engine.fitting.subject import Shape, draw, pose_surfels
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import JOINT_NAMES, HandPose
from mass_engine.hand.poses import POSE_NAMES, named_pose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import shade, white_light
from mass_engine.tracking.landmarks import LandmarkReader, region_of
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.offsets import BONE_OF_POINT

Array = NDArray[np.float64]
_SIDE = 384


@dataclass(frozen=True)
class Sample:
    """One tracked render: pixels tracked [21,2], joints [21,3] camera metres, bone turns [16,3,3], size."""

    score: float
    tracked: Array
    joints: Array
    turns: Array
    size: float


class Renderer:
    """Random hands in front of random backgrounds."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.torch = torch.Generator().manual_seed(seed)
        self.model = load_builtin("right")
        self.binding = MeshBinding.build(self.model, 1, 1)
        self.camera = Camera.from_fov(_SIDE, _SIDE, 45.0)
        self.poses = [named_pose(name, "right").hand_pose.reshape(45) for name in POSE_NAMES]
        self.read = LandmarkReader(HandNetworks.load().landmark)

    def normal(self, *shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=self.torch)

    def sample(self) -> Sample:
        """Pose, render and track one hand."""
        first, second = self.random.choice(len(self.poses), 2)
        mix = float(self.random.random())
        fingers = self.poses[first] * mix + self.poses[second] * (1 - mix) + 0.12 * self.normal(45)
        turn = Rotation.from_quat(self.random.normal(size=4)).as_rotvec()
        orient, betas = torch.tensor(turn, dtype=torch.float32)[None], 0.7 * self.normal(1, 10)
        pose = HandPose(betas, orient, fingers[None], torch.zeros(1, 3), "right")
        joints = self.model.joints(pose)[0]
        distance = torch.tensor([0.0, 0.0, 0.35 + 0.15 * float(self.random.random())])
        place = distance - (joints.amax(0) + joints.amin(0)) / 2
        pose = HandPose(betas, orient, fingers[None], place[None], "right")
        posed = pose_surfels(Shape.mean(self.model, betas[0]), self.binding, pose)
        surfels, count = posed.row(0), self.binding.count
        light = white_light() * 0.75
        light[1:4] = 0.25 * self.normal(3, 1)
        light[4:] = 0.03 * self.normal(5, 1)
        tone = torch.tensor([0.85, 0.62, 0.5]) * (0.35 + 0.75 * float(self.random.random()))
        colors = shade((tone + 0.03 * self.normal(count, 1)).clamp(0, 1), light, surfels.normals).clamp(0, 1)
        spots = cv2.resize(self.random.random((6, 6, 3)), (_SIDE, _SIDE), interpolation=cv2.INTER_CUBIC)
        background = torch.from_numpy(spots).float().clamp(0, 1) * 0.8 + 0.1
        options = RasterOptions(cull_backfaces=True)
        out = draw(surfels, torch.full((count,), 0.98), colors, self.camera, options, background)
        image = (out.rgb.clamp(0, 1) * 255).to(torch.uint8).numpy()
        pixels = self.camera.project(posed.joints[0]).numpy()
        reading = self.read(image, region_of(pixels))
        if reading.score > 0.5:
            reading = self.read(image, region_of(reading.points))
        return Sample(
            reading.score,
            reading.points.astype(np.float64),
            posed.joints[0].double().numpy(),
            posed.bone_rotations[0].double().numpy(),
            float(np.ptp(pixels, axis=0).max()),
        )


def errors(samples: Sequence[Sample], offsets: Array, K: Array) -> Array:
    """Distance [S,21] between tracked points and offset joints, in hand sizes."""
    found = []
    for s in samples:
        moved = s.joints + (s.turns[list(BONE_OF_POINT)] @ offsets[..., None])[..., 0]
        pixels = moved[:, :2] / moved[:, 2:] @ K[:2, :2].T + K[:2, 2]
        found.append(np.linalg.norm(s.tracked - pixels, axis=-1) / s.size)
    return np.array(found)


def solve(samples: Sequence[Sample], K: Array) -> Array:
    """Offsets [21,3] in metres."""
    offsets = np.zeros((21, 3))
    for point, bone in enumerate(BONE_OF_POINT):
        rows, sides = [], []
        for s in samples:
            x, y, z = s.joints[point]
            J = np.array([[K[0, 0] / z, 0, -K[0, 0] * x / z**2], [0, K[1, 1] / z, -K[1, 1] * y / z**2]])
            pixel = np.array([x, y]) / z @ K[:2, :2].T + K[:2, 2]
            rows.append(J @ s.turns[bone] / s.size)
            sides.append((s.tracked[point] - pixel) / s.size)
        A, b = np.concatenate(rows), np.concatenate(sides)
        weight = np.ones(len(b))
        for _ in range(8):
            offsets[point] = np.linalg.lstsq(A * weight[:, None], b * weight, rcond=None)[0]
            weight = (1 + ((A @ offsets[point] - b) / 0.03) ** 2) ** -0.5
    return offsets


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--renders", type=int, default=3000)
    renderer = Renderer(0)
    with torch.no_grad():
        samples = [renderer.sample() for _ in range(parser.parse_args().renders)]
    K = renderer.camera.K.double().numpy()
    # What the tracker got wrong says nothing of where it puts its points.
    right = [s for s in samples if s.score > 0.85 and errors([s], np.zeros((21, 3)), K).mean() < 0.1]
    print(f"{len(samples)} renders, {len(right)} of them read well")
    even, odd = solve(right[::2], K), solve(right[1::2], K)
    nothing = np.zeros((21, 3))
    unseen = (errors(right[1::2], nothing, K).mean(), errors(right[1::2], even, K).mean())
    print(f"error on the other half: {unseen[0]:.2%} -> {unseen[1]:.2%} of hand size")
    print(
        f"the halves' offsets differ by {1e3 * np.linalg.norm(even - odd, axis=1).mean():.1f} mm on average"
    )
    for name, offset in zip(JOINT_NAMES, solve(right, K), strict=True):
        print(f"    ({', '.join(f'{1e3 * v:.1f}' for v in offset)}),  # {name}")


if __name__ == "__main__":
    main()
