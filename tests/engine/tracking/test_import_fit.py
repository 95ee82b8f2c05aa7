"""Imported poses enter the fit where its own would."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mass_engine.options import FitOptions
from mass_engine.preprocess import prepare
from mass_engine.progress import ProgressMeter
from mass_engine.survey import survey
from mass_engine.tracking.alignment import align_landmarks
from mass_engine.tracking.imports.placing import project, solve_translation
from mass_engine.tracking.tracks import read_tracks
from tests.engine.hand.files import mano_arrays, write_mano
from tests.engine.tracking.import_files import OPENPOSE


@pytest.mark.parametrize("kind", ["mano", "builtin", "rotations"])
def test_a_fit_starts_from_wilor_s_poses(demo_clip: Path, draft_run: Path, tmp_path: Path, kind: str) -> None:
    own = read_tracks(draft_run / "tracks.json", "auto", (480, 360))
    # The same hand where WiLoR's far camera would see it in the same places.
    local = own.joints3d - own.pose.transl.numpy()[:, None]
    focal = 5000 / 256 * 480
    far = np.array([[focal, 0, 240], [0, focal, 180], [0, 0, 1.0]])
    seen = project(own.joints3d.astype(np.float64), own.K.double().numpy())
    transl = solve_translation(local.astype(np.float64), seen, far)
    vectors = torch.cat([own.pose.global_orient, own.pose.hand_pose], -1).double().numpy().reshape(-1, 3)
    matrices = Rotation.from_rotvec(vectors).as_matrix().reshape(-1, 16, 3, 3)
    if kind == "rotations":  # only there does MANO's own wrist count
        transl += local[:, 0] - [0.0957, 0.0064, 0.0062]
    output = {
        "global_orient": matrices[:, :1],
        "hand_pose": matrices[:, 1:],
        "betas": own.pose.betas.numpy(),
        "pred_cam_t_full": transl,
        "is_right": np.ones(len(transl)),
        "frame_ids": np.array(own.indices),
    }
    if kind == "builtin":
        output["pred_keypoints_3d"] = local[:, OPENPOSE]
    np.savez(tmp_path / "wilor.npz", allow_pickle=False, **output)
    template = "builtin"
    if kind == "mano":  # the built-in hand's own arrays in MANO's form
        template = f"mano:{write_mano(tmp_path / 'MANO_RIGHT.pkl', mano_arrays(1, vertices=None))}"
    warned: list[str] = []
    options = FitOptions(template=template, tracks=tmp_path / "wilor.npz", max_frames=8)
    clip = prepare(demo_clip, options, ProgressMeter(lambda _: None), lambda code, *_: warned.append(code))
    assert clip.fov_source == "assumed"
    expected = {"mano": [], "builtin": ["tracks.joints_only"], "rotations": ["tracks.rotations_only"]}
    assert warned == expected[kind]
    rows = [own.indices.index(view.index) for view in clip.views]
    if kind != "builtin":
        torch.testing.assert_close(clip.start.hand_pose, own.pose.hand_pose[rows], atol=1e-5, rtol=0)
    if kind == "builtin":  # fitted to the file's joints, but from its rotations, not from a flat hand
        found = survey(demo_clip, options, ProgressMeter(lambda _: None), lambda *_: None)
        marks = [mark for mark in found.hands[0].marks if mark.index in {view.index for view in clip.views}]
        times = [found.times[mark.index] for mark in marks]
        scratch = align_landmarks(clip.model, marks, times, clip.camera).pose
        off = [
            float((pose.hand_pose - own.pose.hand_pose[rows]).abs().mean()) for pose in (clip.start, scratch)
        ]
        assert off[0] < 0.9 * off[1], off
    placed = clip.camera.project(clip.model.joints(clip.start)).numpy()
    size = (seen[rows].max(1) - seen[rows].min(1)).max(1)
    off = np.linalg.norm(placed - seen[rows], axis=-1).mean(1) / size
    assert np.median(off) < 0.05
