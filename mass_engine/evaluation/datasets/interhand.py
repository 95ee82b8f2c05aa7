"""InterHand2.6M (Moon et al. 2020) at 5 frames a second, as HandAvatar (Chen et al. 2023) evaluates on it.

``images/val/Capture0/<sequence>/cam<id>/image<frame>.jpg``, and in ``annotations/val``
``InterHand2.6M_val_camera.json`` and ``InterHand2.6M_val_MANO_NeuralAnnot.json``. Trained on
ROM04_RT_Occlusion, tested on every 160th picture of ROM03_RT_No_Occlusion; right hand, square box 1.3 times
the projected mesh, 256x256, black around the mesh.

Every picture is a view of its own in its camera's axes; that views of one instant show one pose is not used,
as in the paper.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mass_engine.avatar import Avatar
from mass_engine.camera import Camera
from mass_engine.errors import EngineError
from mass_engine.evaluation.datasets.outcome import (
    DatasetResult,
    EvalOptions,
    OurRow,
    Tell,
    missing,
    needs_mano,
)
from mass_engine.evaluation.datasets.paper import INTERHAND
from mass_engine.evaluation.heldout import score_frames
from mass_engine.evaluation.mesh_raster import mesh_mask
from mass_engine.evaluation.refine import RefineOptions
from mass_engine.evaluation.scores import Frame
from mass_engine.fitting.components import Components
from mass_engine.fitting.schedule import schedule_for
from mass_engine.fitting.trainer import fit_hand
from mass_engine.fitting.views import View
from mass_engine.hand.mano import ManoFile, read_mano
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RenderOutput
from mass_engine.tracking.segmentation import BACKGROUND, HAND

Array = NDArray[np.float64]

CAPTURE, TRAIN, TEST = "Capture0", "ROM04_RT_Occlusion", "ROM03_RT_No_Occlusion"
#: Every so many pictures of the test sequence one is scored.
TEST_STEP = 160
SIDE, GROWTH = 256, 1.3
#: HandAvatar's limits, pixels: the box from the picture's edge, the box's side, the mask at 256x256.
_EDGE, _LEAST_SIDE, _LEAST_MASK = 10, 80, 3000
#: What counts as dark (mean grey value in the mask) and as grey (mean spread of the channels): ours.
_DARK, _GREY = 15.0, 2.0
_LAYOUT = (
    "images/val/Capture0/ROM04_RT_Occlusion/cam400262/image12345.jpg and annotations/val/"
    "InterHand2.6M_val_camera.json, InterHand2.6M_val_MANO_NeuralAnnot.json"
)

_PROTOCOL = (
    "HandAvatar's: trained on val/Capture0/ROM04_RT_Occlusion, tested on every 160th accepted picture of "
    "ROM03_RT_No_Occlusion, right hand, square box x1.3 of the projected mesh, 256x256, black background.",
    "Rejected: a box nearer than 10 px to the picture's edge or under 80 px, a mask under 3000 px, dark "
    "pictures (mean under 15 of 255), grey cameras.",
    "Training views are cameras, evenly spread over the sorted names of those with accepted pictures; which "
    "ones the paper took is not known. Of their pictures at most --max-frames, evenly spread, are fitted.",
    "PSNR on 8-bit values over the whole 256x256 picture, SSIM valid, LPIPS VGG on [-1, 1]. Test poses are "
    "the data set's own.",
)


@dataclass(frozen=True)
class Sample:
    """One accepted picture: its ``view`` and pose (a batch of one) in its camera's axes."""

    name: str
    camera: str
    view: View
    pose: HandPose


def evaluate(options: EvalOptions, tell: Tell) -> DatasetResult:
    """Fit and score. Raises EngineError ``eval.*``."""
    if options.mano is None:
        raise needs_mano("InterHand2.6M")
    data = InterHand(options.root, read_mano(options.mano))
    train = _chosen(data, options.views, options.max_frames)
    tell(f"{len(train)} training pictures of {len({sample.camera for sample in train})} cameras")
    views = [
        # Pictures of different cameras are no motion: far apart in time.
        replace(sample.view, index=row, time=10.0 * row)
        for row, sample in enumerate(train)
    ]
    betas = torch.cat([sample.pose.betas for sample in train]).mean(0, keepdim=True)
    start = HandPose(
        betas.expand(len(train), 10),
        torch.cat([sample.pose.global_orient for sample in train]),
        torch.cat([sample.pose.hand_pose for sample in train]),
        torch.cat([sample.pose.transl for sample in train]),
        "right",
    )
    # Pictures of many cameras are not one clip whose exposure drifts.
    parts = Components(exposure="off")
    schedule = schedule_for(options.preset)
    result = fit_hand(
        views, start, data.model, views[0].camera, schedule, options.seed, lambda *_: None, parts
    )
    options.out.mkdir(parents=True, exist_ok=True)
    result.avatar.save(options.out)
    test = _tested(data)
    tell(f"{len(test)} test pictures")
    frames: list[Frame] = [
        (
            Through(result.avatar, sample.view.camera),
            replace(sample.view, index=row),
            replace(sample.pose, betas=result.avatar.shape.betas[None]),
        )
        for row, sample in enumerate(test)
    ]
    scores = score_frames(frames, options.lpips, RefineOptions() if options.refine else None)
    columns = {
        "psnr": "psnr_hand_on_black",
        "ssim": "ssim_hand_on_black",
        "lpips": "lpips_vgg_11_hand_on_black",
    }
    cameras = len({sample.camera for sample in train})
    own = OurRow(f"val/{CAPTURE}", len(train), scores, cameras)
    return DatasetResult("InterHand2.6M, 5 fps", _PROTOCOL, columns, INTERHAND, [own])


@dataclass(frozen=True)
class Through:
    """An avatar of many cameras, seen by one of them."""

    avatar: Avatar
    camera: Camera

    def render_pose(self, pose: HandPose, camera: Camera) -> RenderOutput:
        """As the avatar."""
        return self.avatar.render_pose(pose, camera)


class InterHand:
    """The annotations, and pictures on request."""

    def __init__(self, root: Path, mano: ManoFile) -> None:
        self.root = root
        self.mano, self.model = mano, _right(mano)
        folder = root / "annotations" / "val"
        capture = CAPTURE.removeprefix("Capture")
        self._cameras = _json(folder / "InterHand2.6M_val_camera.json", capture)
        self._poses = _json(folder / "InterHand2.6M_val_MANO_NeuralAnnot.json", capture)

    def pictures(self, sequence: str) -> list[str]:
        """``cam/image`` names of a sequence, by camera, then by frame."""
        folder = self.root / "images" / "val" / CAPTURE / sequence
        found = sorted(
            path.relative_to(folder.parent).as_posix()
            for path in folder.glob("cam*/image*.jpg")
            if re.fullmatch(r"image\d+\.jpg", path.name)
        )
        if not found:
            raise missing("InterHand2.6M", f"there are no pictures of {sequence}", _LAYOUT)
        return found

    def sample(self, name: str) -> Sample | None:
        """One picture by the protocol; None where it is rejected or has no right hand."""
        parts = re.fullmatch(r"[^/]+/cam(\d+)/image(\d+)\.jpg", name)
        assert parts is not None
        camera, pose = self._camera(parts[1]), self._pose(parts[2], parts[1])
        if camera is None or pose is None:
            return None
        picture = cv2.imread(str(self.root / "images" / "val" / CAPTURE / name), cv2.IMREAD_COLOR)
        if picture is None:
            raise missing("InterHand2.6M", f"{name} is no picture", _LAYOUT)
        height, width = picture.shape[:2]
        camera = replace(camera, width=width, height=height)
        with torch.no_grad():
            vertices, joints = self.model(pose)
        pixels = camera.project(vertices[0]).numpy()
        low, high = pixels.min(0), pixels.max(0)
        if (low < _EDGE).any() or (high > np.array([width, height]) - _EDGE).any():
            return None
        side = float((high - low).max())
        if side < _LEAST_SIDE:
            return None
        crop, seen = _square(picture, camera, (low + high) / 2, GROWTH * side)
        mask = mesh_mask(vertices[0].double().numpy(), self.model.faces.numpy(), seen)
        spread = (crop.max(-1).astype(np.float64) - crop.min(-1))[mask]
        if mask.sum() < _LEAST_MASK or crop[mask].mean() < _DARK or spread.mean() < _GREY:
            return None
        crop = np.where(mask[..., None], crop, 0)
        view = View(
            int(parts[2]),
            0.0,
            False,
            np.ascontiguousarray(crop[..., ::-1], np.uint8),
            np.where(mask, HAND, BACKGROUND).astype(np.uint8),
            seen,
            seen.project(joints[0]).numpy().astype(np.float32),
            1.0,
            True,
            mask.astype(np.float32),
        )
        return Sample(name, parts[1], view, pose)

    def _camera(self, name: str) -> Camera | None:
        """The camera, looking along its own axes."""
        try:
            focal, center = self._cameras["focal"][name], self._cameras["princpt"][name]
        except (KeyError, TypeError):
            return None
        # Calibrated with pixel centres at whole numbers.
        K = torch.tensor([[focal[0], 0, center[0] + 0.5], [0, focal[1], center[1] + 0.5], [0, 0, 1.0]])
        return Camera(K, torch.eye(4), 0, 0)

    def _pose(self, frame: str, camera: str) -> HandPose | None:
        """The right hand's pose in the camera's axes."""
        hand = (self._poses.get(frame) or {}).get("right")
        if hand is None:
            return None
        try:
            pose = np.asarray(hand["pose"], np.float64).reshape(48)
            betas = np.asarray(hand["shape"], np.float64).reshape(10)
            trans = np.asarray(hand["trans"], np.float64).reshape(3)
            turn = np.asarray(self._cameras["camrot"][camera], np.float64).reshape(3, 3)
            place = np.asarray(self._cameras["campos"][camera], np.float64).reshape(3) / 1000
        except (KeyError, TypeError, ValueError) as error:
            raise missing(
                "InterHand2.6M", f"frame {frame} or camera {camera} is not annotated", _LAYOUT
            ) from error
        shaped = self.model.joint_shape_basis[0].double().numpy() @ betas
        wrist = self.model.joint_template[0].double().numpy() + shaped
        orient = (Rotation.from_matrix(turn) * Rotation.from_rotvec(pose[:3])).as_rotvec()
        transl = turn @ (wrist + trans - place) - wrist
        parts = (betas, orient, pose[3:] + self.mano.hands_mean, transl)
        rows = [torch.tensor(part, dtype=torch.float32)[None] for part in parts]
        return HandPose(rows[0], rows[1], rows[2], rows[3], "right")


def _right(mano: ManoFile) -> HandModel:
    if mano.side != "right":
        raise EngineError("eval.needs_mano", "The protocol is of right hands.", "Give MANO_RIGHT.pkl.")
    return mano.model()


def _json(path: Path, capture: str) -> Mapping[str, Any]:
    try:
        return dict(json.loads(path.read_text())[capture])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise missing("InterHand2.6M", f"{path.name} cannot be read", _LAYOUT) from error


def _square(
    picture: NDArray[np.uint8] | Any, camera: Camera, middle: Array, side: float
) -> tuple[NDArray[np.uint8], Camera]:
    """The square of ``side`` about ``middle``, at 256x256, and its camera."""
    k = SIDE / side
    corner = middle - side / 2
    # From pixels of the square (centres at whole numbers, as OpenCV has it) to those of the picture.
    matrix = np.array([[1 / k, 0, corner[0] + 0.5 / k - 0.5], [0, 1 / k, corner[1] + 0.5 / k - 0.5]])
    if k < 1:  # no lines that vanish
        picture = cv2.GaussianBlur(picture, (0, 0), 0.5 * np.sqrt(1 / k**2 - 1) + 1e-3)
    crop = cv2.warpAffine(picture, matrix, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    K = camera.K.clone()
    K[0, 2] -= float(corner[0])
    K[1, 2] -= float(corner[1])
    K[:2] *= k
    return np.asarray(crop, np.uint8), Camera(K, camera.world_to_camera, SIDE, SIDE)


def _chosen(data: InterHand, cameras: int, most: int) -> list[Sample]:
    """At most ``most`` accepted pictures of ``cameras`` cameras, both evenly spread."""
    by_camera: dict[str, list[str]] = {}
    for name in data.pictures(TRAIN):
        by_camera.setdefault(name.split("/")[1], []).append(name)
    usable = [
        names for _, names in sorted(by_camera.items()) if any(data.sample(n) is not None for n in names)
    ]
    if not usable:
        raise missing("InterHand2.6M", f"{TRAIN} has no usable picture", _LAYOUT)
    names = [name for row in _spread(len(usable), cameras) for name in usable[row]]
    # Some are rejected: look at twice as many as are wanted.
    looked = (data.sample(names[row]) for row in _spread(len(names), 2 * most))
    found = [sample for sample in looked if sample is not None]
    return [found[row] for row in _spread(len(found), most)]


def _tested(data: InterHand) -> list[Sample]:
    """Every 160th accepted picture of the test sequence."""
    found, accepted = [], 0
    for name in data.pictures(TEST):
        sample = data.sample(name)
        if sample is not None:
            if accepted % TEST_STEP == 0:
                found.append(sample)
            accepted += 1
    if not found:
        raise missing("InterHand2.6M", f"{TEST} has no usable picture", _LAYOUT)
    return found


def _spread(count: int, wanted: int) -> list[int]:
    rows = np.linspace(0, count - 1, min(wanted, count)).round().astype(int)
    return [int(row) for row in np.unique(rows)]
