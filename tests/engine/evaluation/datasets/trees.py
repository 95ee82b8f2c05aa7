"""Small data sets in the layouts of the real ones: a textured hand moves over a cluttered table."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mass_engine.camera import Camera
from mass_engine.evaluation.mesh_raster import rasterize_mesh
from mass_engine.hand.mano import read_mano
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from tests.engine.hand.files import mano_arrays, write_mano
from tests.engine.tracking.import_files import bent

Array = NDArray[np.float64]

#: Fingers up, the back of the hand to the camera.
UPRIGHT = Rotation.from_rotvec([1.2092, 1.2092, 1.2092])


def moving_poses(count: int) -> Array:
    """Absolute poses [F,48]: the hand sways and closes a little."""
    share = np.linspace(0, 1, count)
    poses = np.zeros((count, 48))
    for row, s in enumerate(share):
        sway = Rotation.from_rotvec([0.25 * np.sin(4 * s), 0.5 * (s - 0.5), 0.1 * np.cos(5 * s)])
        poses[row, :3] = (sway * UPRIGHT).as_rotvec()
    poses[:, 5:48:9] = 0.4 * share[:, None]  # first joints of the fingers
    return poses


def mano_file(folder: Path) -> tuple[Path, dict[str, Any]]:
    """A MANO file with the built-in hand's geometry, and its arrays."""
    folder.mkdir(exist_ok=True)
    arrays = mano_arrays(1, vertices=None)
    arrays["hands_mean"] = 0.3 * arrays["hands_mean"]
    arrays["posedirs"] = 0.1 * arrays["posedirs"]
    return write_mano(folder / "MANO_RIGHT.pkl", arrays), arrays


def skin(model: HandModel) -> Array:
    """A colour [V,3] for every vertex."""
    places = model.template.double().numpy()
    waves = np.sin(places @ np.array([[350.0, 120, 40], [-60, 300, 280], [90, -200, 410]]))
    return np.asarray(np.array([0.75, 0.55, 0.45]) + 0.12 * waves)


def picture(
    vertices: Array, model: HandModel, camera: Camera, seed: int = 0
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The hand over a table [H,W,3] RGB, and its mask. ``vertices`` in the camera's axes."""
    faces = model.faces.numpy()
    found = rasterize_mesh(vertices, faces, camera)
    random = np.random.default_rng(seed)
    low = random.uniform(0.1, 0.4, (camera.height // 40 + 1, camera.width // 40 + 1, 1)) * [100, 200, 180]
    result = np.asarray(cv2.resize(low.astype(np.uint8), (camera.width, camera.height)), np.uint8)
    mask = found.face >= 0
    color = found.interpolate(faces, skin(model))[mask] * 255
    result[mask] = color.round().clip(0, 255).astype(np.uint8)
    return result, mask


def posed(model: HandModel, pose: Array, betas: Array, transl: Array) -> tuple[Array, Array]:
    """Vertices and joints of one absolute pose [48]."""
    rows = [torch.tensor(part, dtype=torch.float32) for part in (betas, pose[:3], pose[3:], transl)]
    with torch.no_grad():
        vertices, joints = model(HandPose(rows[0], rows[1], rows[2], rows[3]))
    return vertices.double().numpy(), joints.double().numpy()


def write_image(path: Path, rgb: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])


#: ARCTIC's egocentric camera, and a lens of its form (OpenCV's rational model).
LENS = {
    "intrinsics": np.array([[2000.0, 0, 1390.0], [0, 2010.0, 1003.0], [0, 0, 1]]),
    "dist8": np.array([0.09, -0.02, 0.001, -0.0008, 0.004, 0.05, -0.03, 0.002]),
}


def arctic_tree(root: Path, frames: int = 10, ahead: int = 3) -> Path:
    """ARCTIC with one sequence, s01/box_grab_01, bent by its lens; returns the MANO file.

    Head and hand move through the world; before the camera the hand moves little.
    """
    mano, arrays = mano_file(root)
    model = read_mano(mano).model()
    share = np.linspace(0, 1, frames)
    turn = Rotation.from_rotvec(np.stack([0.8 * share, 1.5 - share, 0.4 * share], 1)).as_matrix()
    shift = np.stack([0.5 - 0.3 * share, 0.2 * share, 1.0 + 0.1 * share], 1)
    betas = np.random.default_rng(5).normal(0, 0.5, 10)
    poses, trans = moving_poses(frames), np.zeros((frames, 3))
    K = LENS["intrinsics"].copy()
    K[:2, 2] += 0.5
    seen = Camera(torch.tensor(K), torch.eye(4), 2800, 2000)
    for row in range(frames):
        world = poses[row].copy()
        world[:3] = (Rotation.from_matrix(turn[row].T) * Rotation.from_rotvec(world[:3])).as_rotvec()
        place = np.array([0.05 * share[row], 0.03, 0.62])
        local, _ = posed(model, world, betas, np.zeros(3))
        trans[row] = turn[row].T @ (place - shift[row]) - local.mean(0)
        inside = (local + trans[row]) @ turn[row].T + shift[row]
        # A pinhole that shows the bent picture.
        pixels = bent(inside, LENS) + 0.5
        flat = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(K).T
        rgb, _ = picture(flat * inside[:, 2:], model, seen)
        write_image(root / "images" / "s01" / "box_grab_01" / "0" / f"{row + ahead:05d}.jpg", rgb)
        poses[row] = world
    hand = {
        "rot": poses[:, :3],
        "pose": poses[:, 3:] - arrays["hands_mean"],
        "trans": trans,
        "shape": betas,
        "fitting_err": [0.0] * frames,
    }
    camera = {"R_k_cam_np": turn, "T_k_cam_np": shift[..., None], **LENS}
    folder = root / "raw_seqs" / "s01"
    folder.mkdir(parents=True)
    for name, content in (("mano", {"right": hand}), ("egocam.dist", camera)):
        np.save(folder / f"box_grab_01.{name}.npy", np.array(content, dtype=object), allow_pickle=True)
    (root / "meta").mkdir()
    (root / "meta" / "misc.json").write_text(json.dumps({"s01": {"ioi_offset": ahead}}))
    return mano


def hand_appearance_tree(root: Path, frames: int = 12) -> Path:
    """Hand Appearance with one sequence, subject_1/1; returns the MANO file."""
    mano, arrays = mano_file(root)
    model = read_mano(mano).model()
    sequence = root / "subject_1" / "1"
    K = torch.tensor([[2000.0, 0, 224], [0, 2000, 224], [0, 0, 1]])
    camera = Camera(K, torch.eye(4), 448, 448)
    betas = np.random.default_rng(8).normal(0, 0.5, 10)
    (sequence / "metro_mano").mkdir(parents=True)
    for row, pose in enumerate(moving_poses(frames)):
        share = row / frames
        trans = np.array([0.01 * share, 0.02, -0.01])
        scale, tx, ty = 4.5 + 0.3 * share, 0.02 * share, 0.08
        content = {
            "rot": pose[None, :3],
            "pose": pose[None, 3:] - arrays["hands_mean"],
            "shape": betas[None],
            "trans": trans[None],
            "cam": np.array([scale, tx, ty]),
        }
        (sequence / "metro_mano" / f"{row:04d}_mano.pkl").write_bytes(pickle.dumps(content))
        vertices, _ = posed(model, pose, betas, trans)
        # HARP's renderer, in PyTorch3D's axes: x left, y up.
        theirs = vertices * [-1, -1, 1] + np.array([-tx, -ty, 2 * 2000 / (448 * scale)])
        vertices = theirs * [-1, -1, 1]
        rgb, mask = picture(vertices, model, camera)
        arm = np.zeros_like(mask)
        arm[330:, 190:260] = True  # some arm that belongs to the masks
        rgb[arm & ~mask] = (190, 140, 110)
        write_image(sequence / "unscreen_cropped" / f"{row:04d}.jpg", rgb)
        both = np.repeat((mask | arm)[..., None] * np.uint8(255), 3, -1)
        write_image(sequence / "mask" / f"{row:04d}_mask.jpg", both)
    return mano


def interhand_tree(root: Path, frames: int = 3) -> Path:
    """InterHand2.6M with three colour cameras and a grey one; returns the MANO file."""
    mano, arrays = mano_file(root)
    model = read_mano(mano).model()
    cameras: dict[str, dict[str, Any]] = {"campos": {}, "camrot": {}, "focal": {}, "princpt": {}}
    poses: dict[str, Any] = {}
    betas = np.random.default_rng(2).normal(0, 0.5, 10)
    numbers: dict[str, list[int]] = {"ROM04_RT_Occlusion": [], "ROM03_RT_No_Occlusion": []}
    number = 1000
    trans = np.array([0.1, 0.9, 0.4])
    middle = trans - np.array([0.0, 0.1, 0.0])
    for sequence in numbers:
        for pose in moving_poses(frames):
            poses[str(number)] = {
                "right": {
                    "pose": (pose - np.concatenate([np.zeros(3), arrays["hands_mean"]])).tolist(),
                    "shape": betas.tolist(),
                    "trans": trans.tolist(),
                },
                "left": None,
            }
            numbers[sequence].append(number)
            number += 3
    poses[str(number)] = {"right": None, "left": None}
    for name, angle in (("400262", -0.4), ("400263", 0.0), ("400264", 0.4), ("410001", 0.2)):
        turn = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
        place = middle - turn.T @ np.array([0.0, 0.0, 1.2])
        cameras["camrot"][name], cameras["campos"][name] = turn.tolist(), (1000 * place).tolist()
        cameras["focal"][name], cameras["princpt"][name] = [1200.0, 1210.0], [167.0, 256.0]
        K = torch.tensor([[1200.0, 0, 167.5], [0, 1210, 256.5], [0, 0, 1]])
        seen = Camera(K, torch.eye(4), 334, 512)
        for sequence, rows in numbers.items():
            for row, frame in enumerate(rows):
                world, _ = posed(model, moving_poses(frames)[row], betas, trans)
                rgb, _ = picture((world - place) @ turn.T, model, seen)
                if name.startswith("41"):
                    rgb = np.repeat(rgb.mean(-1, keepdims=True).astype(np.uint8), 3, -1)
                folder = root / "images" / "val" / "Capture0" / sequence
                write_image(folder / f"cam{name}" / f"image{frame}.jpg", rgb)
    annotations = root / "annotations" / "val"
    annotations.mkdir(parents=True)
    (annotations / "InterHand2.6M_val_camera.json").write_text(json.dumps({"0": cameras}))
    (annotations / "InterHand2.6M_val_MANO_NeuralAnnot.json").write_text(json.dumps({"0": poses}))
    return mano
