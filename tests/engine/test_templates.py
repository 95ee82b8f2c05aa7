"""A fit from somebody else's hand: from the video to the avatar, its file and its pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from mass_engine import Avatar
from mass_engine.hand.template import load_template
from mass_engine.options import FitOptions
from mass_engine.pipeline import fit_to_directory
from mass_engine.preprocess import prepare
from mass_engine.progress import ProgressMeter
from mass_engine.template_spec import parse_template
from mass_engine.tracking.tracks import read_tracks
from tests.engine.hand.files import builtin_rig, mano_arrays, write_glb, write_mano
from tests.engine.hand.rigs import rig_name


@pytest.mark.parametrize("kind", ["mano", "gltf"])
def test_a_fit_from_another_template(demo_clip: Path, tmp_path: Path, kind: str) -> None:
    if kind == "mano":
        arrays = mano_arrays(1, vertices=None)
        arrays["posedirs"] *= 0
        path = write_mano(tmp_path / "MANO_RIGHT.pkl", arrays)
    else:
        rig = builtin_rig().renamed(lambda joint: rig_name("webxr", joint, "right"))
        path = write_glb(tmp_path / "hand.glb", rig)
    options = FitOptions(template=f"{kind}:{path}", preset="draft", holdout=4, max_frames=16)
    report = fit_to_directory(demo_clip, tmp_path / "run", options)
    # The clip shows the built-in hand, and that is what both templates were made of.
    for metric, least in (("silhouette_iou", 0.85), ("psnr_in_mask", 17.0)):
        assert (report.metrics[metric] or 0.0) > least
    avatar = Avatar.load(tmp_path / "run")
    model = load_template(parse_template(options.template)).model("right")
    assert torch.equal(avatar.shape.model.template, model.template)
    pictures = [avatar.render(pose, "orbit:20,10", 96, 96) for pose in ("rest", "fist", "frame:4")]
    assert all(0.01 < (picture[..., 3] > 127).mean() < 0.9 for picture in pictures)
    assert not np.array_equal(pictures[0], pictures[1])

    # Its tracks are taken as they are by the same template; another one starts again from the landmarks.
    tracks = tmp_path / "run" / "tracks.json"
    assert json.loads(tracks.read_text())["template"].startswith(f"{kind}:")
    size = (480, 360)
    known = read_tracks(tracks, "auto", size)
    again = [
        prepare(
            demo_clip,
            FitOptions(template=template, tracks=tracks, max_frames=8, masks=None),
            ProgressMeter(lambda _: None),
            lambda *_: None,
        ).start
        for template in (options.template, "builtin")
    ]
    torch.testing.assert_close(again[0].betas[0], known.pose.betas[0], atol=1e-5, rtol=0)
    assert not torch.allclose(again[1].betas[0], known.pose.betas[0], atol=1e-3)
