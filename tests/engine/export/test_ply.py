"""Surfels as PLY: bytes, conventions, other readers, bad files."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from mass_engine.errors import EngineError
from mass_engine.export.ply import Flavour, read_ply, write_ply
from mass_engine.surfel.cloud import SurfelCloud
from mass_engine.surfel.inellipse import quat_to_matrix

FLAVOURS: tuple[Flavour, ...] = ("2dgs", "3dgs")


def cloud(count: int = 37, terms: int = 16) -> SurfelCloud:
    random = torch.Generator().manual_seed(0)
    return SurfelCloud(
        torch.randn(count, 3, generator=random) * 0.1,
        torch.rand(count, 2, generator=random) * 1e-3 + 1e-5,
        torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=1),
        torch.rand(count, generator=random) * 0.98 + 0.01,
        torch.randn(count, terms, 3, generator=random),
        torch.arange(count),
    )


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("terms", [1, 4, 16])
def test_round_trip(tmp_path: Path, flavour: Flavour, terms: int) -> None:
    written = cloud(terms=terms)
    write_ply(written, tmp_path / "a.ply", flavour)
    read = read_ply(tmp_path / "a.ply")
    assert torch.equal(read.means, written.means)
    assert torch.allclose(read.scales, written.scales, rtol=1e-5)
    assert torch.allclose(read.quats, written.quats)
    assert torch.allclose(read.opacities, written.opacities, atol=1e-6)
    assert torch.equal(read.sh[:, :terms], written.sh)
    assert torch.equal(read.sh[:, terms:], torch.zeros(37, 16 - terms, 3))


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_layout_is_the_one_viewers_read(tmp_path: Path, flavour: Flavour) -> None:
    written = cloud()
    write_ply(written, tmp_path / "a.ply", flavour)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 37" in lines
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    scales = ["scale_0", "scale_1"] + ["scale_2"] * (flavour == "3dgs")
    assert names == [
        *["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"],
        *(f"f_rest_{i}" for i in range(45)),
        "opacity",
        *scales,
        *["rot_0", "rot_1", "rot_2", "rot_3"],
    ]
    row = dict(zip(names, struct.unpack_from(f"<{len(names)}f", body, 4 * len(names) * 5), strict=True))
    assert row["x"] == pytest.approx(float(written.means[5, 0]))
    assert row["opacity"] == pytest.approx(
        math.log(float(written.opacities[5] / (1 - written.opacities[5]))), rel=1e-4
    )
    assert row["scale_1"] == pytest.approx(math.log(float(written.scales[5, 1])), rel=1e-5)
    assert row["rot_0"] == pytest.approx(float(written.quats[5, 0]))
    # All of red, then green, then blue.
    assert row["f_rest_1"] == pytest.approx(float(written.sh[5, 2, 0]))
    assert row["f_rest_15"] == pytest.approx(float(written.sh[5, 1, 1]))
    assert row["f_rest_44"] == pytest.approx(float(written.sh[5, 15, 2]))
    normal = quat_to_matrix(written.quats)[5, :, 2]
    assert [row["nx"], row["ny"], row["nz"]] == pytest.approx(normal.tolist(), abs=1e-6)
    if flavour == "3dgs":
        assert row["scale_2"] == -40.0


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_trimesh_reads_it(tmp_path: Path, flavour: Flavour) -> None:
    written = cloud()
    write_ply(written, tmp_path / "a.ply", flavour)
    loaded = trimesh.load(tmp_path / "a.ply")
    assert isinstance(loaded, trimesh.PointCloud)
    assert np.allclose(np.asarray(loaded.vertices), written.means.numpy())


def test_extreme_values_stay_finite(tmp_path: Path) -> None:
    base = cloud(3)
    extreme = SurfelCloud(
        base.means, torch.zeros(3, 2), base.quats, torch.tensor([0.0, 1.0, 0.5]), base.sh, base.face_index
    )
    write_ply(extreme, tmp_path / "a.ply")
    read = read_ply(tmp_path / "a.ply")
    assert torch.isfinite(read.scales).all()
    assert torch.allclose(read.opacities, extreme.opacities, atol=1e-5)


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    write_ply(cloud(), tmp_path / "a.ply")
    before = (tmp_path / "a.ply").read_bytes()
    write_ply(cloud(5), tmp_path / "a.ply")
    assert len(read_ply(tmp_path / "a.ply")) == 5
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    assert (tmp_path / "a.ply").read_bytes() != before
    with pytest.raises(EngineError) as caught:
        write_ply(cloud(), tmp_path / "missing" / "a.ply")
    assert caught.value.code == "export.out"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a ply",
        b"ply\nformat ascii 1.0\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n\0\0\0\0",
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(content)
    with pytest.raises(EngineError) as caught:
        read_ply(path)
    assert caught.value.code == "ply.invalid"


def test_a_cut_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.ply"
    write_ply(cloud(), path)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(EngineError) as caught:
        read_ply(path)
    assert caught.value.code == "ply.invalid"


@pytest.mark.parametrize("field", ["means", "scales", "quats", "opacities", "sh", "face_index"])
def test_a_cloud_whose_parts_do_not_fit_is_refused(field: str) -> None:
    good = vars(cloud(6))
    with pytest.raises(EngineError) as caught:
        SurfelCloud(**{**good, field: good[field][:5]})
    assert caught.value.code == "surfels.shape"


def test_a_cloud_with_an_odd_number_of_harmonics_is_refused() -> None:
    good = vars(cloud(6))
    with pytest.raises(EngineError) as caught:
        SurfelCloud(**{**good, "sh": torch.zeros(6, 5, 3)})
    assert caught.value.code == "surfels.shape"
