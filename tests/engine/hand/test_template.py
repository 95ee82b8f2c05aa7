"""``--template``: what it may say, and that whatever it names serves the whole engine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.hand.builtin import joint_limits, load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose, Side
from mass_engine.hand.poses import POSE_NAMES, named_pose
from mass_engine.hand.template import Template, load_template
from mass_engine.options import FitOptions
from mass_engine.template_spec import parse_template
from tests.engine.hand.files import builtin_rig, left_arrays, mano_arrays, write_glb, write_mano


def test_the_option_is_taken_apart(tmp_path: Path) -> None:
    hand, names = tmp_path / "a,b=c.glb", tmp_path / "map.json"
    hand.touch()
    names.touch()
    spec = parse_template(f"gltf:{hand},joints={names},side=left")
    assert (spec.kind, spec.path, spec.joints, spec.side) == ("gltf", hand, names, "left")
    spec = parse_template(f"mano:{hand},tips=manopth")
    assert (spec.kind, spec.path, spec.tips) == ("mano", hand, "manopth")
    assert parse_template("builtin").path is None


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "template.invalid"),
        ("mano", "template.invalid"),
        ("mano:", "template.invalid"),
        ("smpl:HERE", "template.invalid"),
        ("builtin:HERE", "template.invalid"),
        ("mano:HERE,tips=nails", "template.invalid"),
        ("gltf:HERE,side=top", "template.invalid"),
        ("gltf:HERE,side=left,side=left", "template.invalid"),
        ("gltf:HERE,tips=smplx", "template.not_found"),
        ("gltf:HERE,joints=none.json", "template.not_found"),
        ("mano:none.pkl", "template.not_found"),
        ("mano:.", "template.not_found"),
    ],
)
def test_bad_options_are_bad_arguments(tmp_path: Path, text: str, code: str) -> None:
    (tmp_path / "hand").touch()
    with pytest.raises(BadArgumentError) as caught:
        FitOptions(template=text.replace("HERE", str(tmp_path / "hand")))
    assert caught.value.code == code


@pytest.fixture(scope="module", params=["builtin", "mano", "mano left", "gltf"])
def template(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Template:
    path = tmp_path_factory.mktemp("template")
    if request.param == "builtin":
        return load_template(parse_template("builtin"))
    if request.param == "gltf":
        return load_template(parse_template(f"gltf:{write_glb(path / 'hand.glb', builtin_rig())}"))
    arrays = mano_arrays(1, vertices=None)
    arrays["posedirs"] *= 0
    arrays = left_arrays(arrays, fault=True) if request.param == "mano left" else arrays
    return load_template(parse_template(f"mano:{write_mano(path / 'm.pkl', arrays)}"))


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("name", POSE_NAMES)
def test_named_poses_look_alike_on_every_template(template: Template, name: str, side: Side) -> None:
    model = template.model(side)
    assert model.side == side
    own = load_builtin(side)
    wanted = own.joints(named_pose(name, side))
    found = model.joints(named_pose(name, side, model))
    assert (wanted - wanted[0] - found + found[0]).norm(dim=1).max() < 0.006
    assert torch.isfinite(model(named_pose(name, side, model))[0]).all()
    assert joint_limits().shape == (15, 3, 2)


def test_the_other_side_is_the_mirror_image(template: Template) -> None:
    right, left = template.model("right"), template.model("left")
    flip = torch.tensor([-1.0, 1.0, 1.0])
    assert torch.equal(right.template * flip, left.template)
    assert {right.side, left.side} == {"left", "right"}


def test_a_template_survives_the_avatar_s_tensors(template: Template) -> None:
    again = HandModel.from_tensors(template.hand.side, template.hand.tensors())
    pose = replace(HandPose.rest(template.hand.side), betas=torch.ones(10))
    assert torch.equal(again(pose)[0], template.hand(pose)[0])
    assert all(value.dtype in (torch.float32, torch.int64) for value in template.hand.tensors().values())


def test_names_tell_templates_apart(template: Template, tmp_path: Path) -> None:
    assert str(tmp_path.parent) not in template.name
    other = load_template(parse_template(f"mano:{write_mano(tmp_path / 'm.pkl', mano_arrays(9))}"))
    assert other.name != template.name
    assert other.mano is not None
    np.testing.assert_array_equal(other.mano.hands_mean, mano_arrays(9)["hands_mean"])


def test_the_left_hand_s_fault_is_said(tmp_path: Path) -> None:
    path = write_mano(tmp_path / "MANO_LEFT.pkl", left_arrays(mano_arrays(2), fault=True))
    assert [code for code, _ in load_template(parse_template(f"mano:{path}")).notes] == ["template.mano_left"]


def test_a_file_of_the_wrong_kind_is_unusable_input(tmp_path: Path) -> None:
    path = write_glb(tmp_path / "hand.glb", builtin_rig())
    with pytest.raises(EngineError) as caught:
        load_template(parse_template(f"mano:{path}"))
    assert caught.value.code == "template.unreadable"
    assert not isinstance(caught.value, BadArgumentError)
