"""The networks on disk: found, verified, refused when damaged, fetched once."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mass_engine.errors import EngineError
from mass_engine.tracking import models


@pytest.fixture
def networks() -> models.HandNetworks:
    return models.HandNetworks.load()


def _wheel(path: Path, contents: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in contents.items():
            archive.writestr(member, content)
    return path


def _genuine() -> dict[str, bytes]:
    return {file.member: (models.model_dir() / file.name).read_bytes() for file in models.NETWORK_FILES}


def test_the_folder_comes_from_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MASS_MODEL_DIR", str(tmp_path))
    assert models.model_dir() == tmp_path
    monkeypatch.delenv("MASS_MODEL_DIR")
    assert models.model_dir().parts[-2:] == ("mass", "models")


def test_missing_networks_are_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(EngineError, match="make setup") as caught:
        models.HandNetworks.load(tmp_path)
    assert caught.value.code == "tracker.networks_missing"
    assert all(file.name in caught.value.message for file in models.NETWORK_FILES)


def test_a_damaged_network_is_not_loaded(tmp_path: Path) -> None:
    models.extract(_wheel(tmp_path / "genuine.whl", _genuine()), tmp_path / "models")
    assert models.missing_files(tmp_path / "models") == []
    file = tmp_path / "models" / models.HAND_LANDMARK.name
    content = bytearray(file.read_bytes())
    content[1000] ^= 1
    file.write_bytes(content)
    assert models.missing_files(tmp_path / "models") == [models.HAND_LANDMARK]
    with pytest.raises(EngineError, match="networks_missing"):
        models.HandNetworks.load(tmp_path / "models")


def test_a_wheel_with_other_content_leaves_nothing(tmp_path: Path) -> None:
    forged = dict.fromkeys(_genuine(), b"something else")
    with pytest.raises(EngineError, match="networks_damaged"):
        models.extract(_wheel(tmp_path / "forged.whl", forged), tmp_path / "models")
    assert list((tmp_path / "models").iterdir()) == []


def test_fetch_downloads_nothing_when_the_networks_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: Any, **__: Any) -> None:
        raise AssertionError("the package client was started")

    monkeypatch.setattr(subprocess, "run", forbidden)
    assert models.fetch() is False


def test_fetch_takes_the_networks_out_of_what_the_package_client_brings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    genuine = _genuine()

    def bring(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        assert command[0] == sys.executable
        assert command[-1] == models.WHEEL
        assert "--no-deps" in command
        _wheel(Path(command[command.index("--dest") + 1]) / "mediapipe-0.10.21-any.whl", genuine)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", bring)
    assert models.fetch(tmp_path) is True
    assert models.missing_files(tmp_path) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(f.name for f in models.NETWORK_FILES)


def test_a_failing_download_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client = tmp_path / "client"
    client.write_text("#!/bin/sh\necho 'no such wheel' >&2\nexit 1\n")
    client.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(client))
    with pytest.raises(EngineError, match="no such wheel") as caught:
        models.fetch(tmp_path / "models")
    assert caught.value.code == "tracker.fetch_failed"


def test_the_networks_have_the_shapes_the_decoder_expects(networks: models.HandNetworks) -> None:
    grey = np.full((192, 192, 3), 128, np.uint8)
    raw, logits = networks.palm(grey, ("Identity", "Identity_1"))
    assert raw.shape == (2016, 18)
    assert logits.shape == (2016, 1)
    outputs = networks.landmark(
        np.full((224, 224, 3), 128, np.uint8), ("Identity", "Identity_1", "Identity_2", "Identity_3")
    )
    assert [o.shape for o in outputs] == [(63,), (1,), (1,), (63,)]
    assert float(outputs[1][0]) < 0.1, "there is no hand in a grey square"
