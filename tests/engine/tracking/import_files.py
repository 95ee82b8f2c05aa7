"""Poses written as WiLoR, HaMeR, ARCTIC and HARP write them, from MANO's formulas and theirs alone."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mass_engine.hand.pose import JOINT_PARENTS, Side

Array = NDArray[np.float64]

SIZE = (640, 480)
#: smplx's fingertips: thumb, index, middle, ring, pinky.
TIPS = [744, 320, 443, 554, 671]
#: Our 21 points in the order of OpenPose: wrist, thumb, index, middle, ring, little finger.
OPENPOSE = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
FLIP = np.array([-1.0, 1.0, 1.0])
MIRROR = np.tile([1.0, -1.0, -1.0], 16)


def points21(arrays: dict[str, Any], betas: Array, pose: Array) -> Array:
    """MANO's 16 joints and 5 tips [21,3] of an absolute ``pose`` [48], without translation."""
    shaped = arrays["v_template"] + arrays["shapedirs"] @ betas
    joints = arrays["J_regressor"] @ shaped
    local = Rotation.from_rotvec(pose.reshape(16, 3)).as_matrix()
    world: list[Array] = []
    for joint, parent in enumerate(JOINT_PARENTS):
        here = np.eye(4)
        here[:3, :3] = local[joint]
        here[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        world.append(world[parent] @ here if parent >= 0 else here)
    # The tips are moved by their finger's last bone alone: as the fit's model has them.
    ends = []
    for tip, bone in zip(TIPS, (15, 3, 6, 12, 9), strict=True):
        ends.append(world[bone][:3, :3] @ (shaped[tip] - joints[bone]) + world[bone][:3, 3])
    return np.array([matrix[:3, 3] for matrix in world] + ends)


@dataclass
class Clip:
    """F frames of one hand: ``pose`` [F,48] of its own side, ``betas`` [10], ``transl`` [F,3] in the virtual
    camera, ``local`` [F,21,3] before it."""

    side: Side
    pose: Array
    betas: Array
    transl: Array
    local: Array

    @property
    def focal(self) -> float:
        return 5000 / 256 * max(SIZE)

    def pixels(self) -> Array:
        """Where the virtual camera of WiLoR and HaMeR sees the 21 points [F,21,2]."""
        seen = self.local + self.transl[:, None]
        return self.focal * seen[..., :2] / seen[..., 2:] + np.array(SIZE) / 2


def make_clip(arrays: dict[str, Any], side: Side = "right", frames: int = 5, seed: int = 0) -> Clip:
    """``arrays``: the MANO of ``side``. Hands seen from the back or the palm, somewhere in the picture."""
    random = np.random.default_rng(seed)
    pose = random.normal(0, 0.25, (frames, 48))
    pose[:, :3] = random.normal(0, 0.7, (frames, 3))
    betas = random.normal(0, 1, 10)
    local = np.stack([points21(arrays, betas, row) for row in pose])
    depth = random.uniform(8, 14, frames)
    focal = 5000 / 256 * max(SIZE)
    at = np.stack([random.uniform(-110, 110, frames), random.uniform(-60, 60, frames)], 1)
    transl = np.concatenate([at / focal * depth[:, None], depth[:, None]], 1)
    middle = local.mean(1)
    transl[:, :2] -= middle[:, :2]
    return Clip(side, pose, betas, transl, local)


def network_output(clip: Clip, *, flipped_tx: bool = True, joints: bool = True) -> dict[str, Any]:
    """The networks' dictionary for all frames: the right hand in the (for left hands mirrored) crop.

    ``flipped_tx``: as the demos leave pred_cam of left hands, else as the network gives it.
    """
    left = clip.side == "left"
    own = clip.pose * (MIRROR if left else 1)
    matrices = Rotation.from_rotvec(own.reshape(-1, 3)).as_matrix().reshape(-1, 16, 3, 3)
    pixels = clip.pixels()
    low, high = pixels.min(1), pixels.max(1)
    centre, box = (low + high) / 2, 2.0 * (high - low).max(1)
    scale = 2 * clip.focal / (box * clip.transl[:, 2])
    weak = np.stack(
        [
            scale,
            clip.transl[:, 0] - 2 * (centre[:, 0] - SIZE[0] / 2) / (box * scale),
            clip.transl[:, 1] - 2 * (centre[:, 1] - SIZE[1] / 2) / (box * scale),
        ],
        1,
    )
    if left and not flipped_tx:
        weak[:, 1] *= -1
    count = len(own)
    result: dict[str, Any] = {
        "pred_mano_params": {
            "global_orient": matrices[:, :1],
            "hand_pose": matrices[:, 1:],
            "betas": np.tile(clip.betas, (count, 1)),
        },
        "pred_cam": weak,
        "box_center": centre,
        "box_size": box,
        "img_size": np.tile(np.array(SIZE, float), (count, 1)),
        "right": np.full(count, 0.0 if left else 1.0),
    }
    if joints:
        result["pred_keypoints_3d"] = (clip.local * (FLIP if left else 1))[:, OPENPOSE]
    return result


def flat(output: dict[str, Any]) -> dict[str, Any]:
    """Without nesting, as an .npz has it."""
    return {**output["pred_mano_params"], **{k: v for k, v in output.items() if k != "pred_mano_params"}}


def rows(output: dict[str, Any], row: int) -> dict[str, Any]:
    """One frame of it, a batch of one."""
    return {
        name: rows(value, row) if isinstance(value, dict) else value[row : row + 1]
        for name, value in output.items()
    }


def wilor_mini(clip: Clip) -> list[list[dict[str, Any]]]:
    """WiLoR-mini's results, frame by frame: axis-angles and joints of the hand's own side."""
    result = []
    for row, pose in enumerate(clip.pose):
        predictions = {
            "global_orient": pose[None, None, :3],
            "hand_pose": pose[3:].reshape(1, 15, 3),
            "betas": clip.betas[None],
            "pred_keypoints_3d": clip.local[row : row + 1, OPENPOSE],
            "pred_cam_t_full": clip.transl[row : row + 1],
            "scaled_focal_length": clip.focal,
        }
        hand = {"hand_bbox": [0.0, 0.0, 1.0, 1.0], "is_right": float(clip.side == "right")}
        result.append([{**hand, "wilor_preds": predictions}])
    return result


def write_arctic(
    root: Path, arrays: dict[Side, dict[str, Any]], poses: dict[Side, Array], ahead: int = 0
) -> tuple[Path, dict[Side, Array], dict[str, Any]]:
    """A sequence under ``root``; returns its file, the points [F,21,3] in the camera, and the camera.

    ``poses`` [F,48] absolute; written relative to the mean pose, in a world the camera moves through.
    """
    random = np.random.default_rng(5)
    frames = len(next(iter(poses.values())))
    turn = Rotation.from_rotvec(random.normal(0, 1, (frames, 3))).as_matrix()
    shift = random.normal(0, 0.5, (frames, 3))
    hands, seen = {}, {}
    for side, pose in poses.items():
        betas = random.normal(0, 1, 10)
        mano = arrays[side]
        place = random.uniform((-0.08, -0.05, 0.5), (0.08, 0.05, 0.7), (frames, 3))
        world_place = np.einsum("fji,fj->fi", turn, place - shift)
        local = np.stack([points21(mano, betas, row) for row in pose])
        trans = world_place - local.mean(1)
        world = local + trans[:, None]
        seen[side] = np.einsum("fij,fnj->fni", turn, world) + shift[:, None]
        hands[side] = {
            "rot": pose[:, :3].astype(np.float32),
            "pose": (pose[:, 3:] - mano["hands_mean"]).astype(np.float32),
            "trans": trans.astype(np.float32),
            "shape": betas.astype(np.float32),
            "fitting_err": [0.0] * frames,
        }
    camera = {
        "R_k_cam_np": turn,
        "T_k_cam_np": shift[..., None],
        "intrinsics": np.array([[2000.0, 0, 1390.0], [0, 2010.0, 1003.0], [0, 0, 1]]),
        "dist8": np.array([0.09, -0.02, 0.001, -0.0008, 0.004, 0.05, -0.03, 0.002]),
        "ego_markers.label": ["a", "b"],
    }
    folder = root / "raw_seqs" / "s01"
    folder.mkdir(parents=True)
    path = folder / "box_grab_01.mano.npy"
    np.save(path, np.array(hands, dtype=object), allow_pickle=True)
    np.save(folder / "box_grab_01.egocam.dist.npy", np.array(camera, dtype=object), allow_pickle=True)
    if ahead:
        (root / "meta").mkdir()
        (root / "meta" / "misc.json").write_text(json.dumps({"s01": {"ioi_offset": ahead}}))
    return path, seen, camera


def bent(points: Array, camera: dict[str, Any]) -> Array:
    """OpenCV's rational lens: camera points [...,3] to pixels of 2800x2000, centres at whole numbers."""
    k1, k2, p1, p2, k3, k4, k5, k6 = camera["dist8"]
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    r = x * x + y * y
    ratio = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    u = x * ratio + 2 * p1 * x * y + p2 * (r + 2 * x * x)
    v = y * ratio + p1 * (r + 2 * y * y) + 2 * p2 * x * y
    K = camera["intrinsics"]
    return np.stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]], -1)


def write_harp(
    folder: Path, arrays: dict[str, Any], pose: Array, *, joints: bool = True
) -> tuple[Array, Array]:
    """``pose`` [F,48] absolute as HARP's pickles; returns pixels [F,21,2] at 448 and the points before trans.

    The pixels are computed in PyTorch3D's axes: x left, y up.
    """
    random = np.random.default_rng(8)
    folder.mkdir(parents=True)
    pixels, locals_ = [], []
    betas = random.normal(0, 1, 10)
    for row, absolute in enumerate(pose):
        local = points21(arrays, betas, absolute)
        trans = random.normal(0, 0.02, 3) - local.mean(0)
        scale, tx, ty = random.uniform(4, 6), *random.normal(0, 0.02, 2)
        content: dict[str, Any] = {
            "rot": absolute[None, :3],
            "pose": absolute[None, 3:] - arrays["hands_mean"],
            "shape": betas[None],
            "trans": trans[None],
            "cam": np.array([scale, tx, ty]),
            "verts": np.zeros((1, 778, 3)),
        }
        if joints:
            content["joints"] = (local + trans)[None, OPENPOSE] * 1000
        (folder / f"{row:04d}_mano.pkl").write_bytes(pickle.dumps(content))
        p3d = (local + trans) * [-1, -1, 1] + [-tx, -ty, 2 * 2000 / (448 * scale)]
        pixels.append(224 - 2000 * p3d[:, :2] / p3d[:, 2:])
        locals_.append(local)
    return np.array(pixels), np.array(locals_)
