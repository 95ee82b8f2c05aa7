"""PLY files of surfels, as splat viewers read them: binary little endian, every property float32."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.surfel.cloud import SurfelCloud
from mass_engine.surfel.inellipse import quat_to_matrix

Flavour = Literal["2dgs", "3dgs"]

#: The third log-scale of the 3dgs flavour: viewers take anything under -30 for a flat disk.
FLAT = -40.0
_HARMONICS = 45  # f_rest_0 .. f_rest_44, unused degrees zero


def _names(flavour: Flavour) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(_HARMONICS)]
    scales = ["scale_0", "scale_1"] + (["scale_2"] if flavour == "3dgs" else [])
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *rest,
        "opacity",
        *scales,
        *("rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def write_ply(cloud: SurfelCloud, path: Path, flavour: Flavour = "2dgs") -> None:
    """Write the surfels in one step: opacity as logit, scales as logarithms, harmonics channel by channel.

    ``3dgs`` adds a third, vanishing scale for viewers of 3-D Gaussians.
    """
    n, terms = len(cloud), cloud.sh.shape[1]
    rest = torch.zeros(n, 3, _HARMONICS // 3)
    rest[:, :, : terms - 1] = cloud.sh[:, 1:].transpose(1, 2)
    columns = [
        cloud.means,
        quat_to_matrix(cloud.quats)[..., 2],
        cloud.sh[:, 0],
        rest.reshape(n, -1),
        torch.logit(cloud.opacities.clamp(1e-6, 1 - 1e-6)).unsqueeze(1),
        cloud.scales.clamp_min(1e-12).log(),
        *([torch.full((n, 1), FLAT)] if flavour == "3dgs" else []),
        cloud.quats,
    ]
    table = torch.cat([column.detach().float() for column in columns], 1).numpy().astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in _names(flavour)] + ["end_header", ""]
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            file.write("\n".join(header).encode("ascii"))
            file.write(np.ascontiguousarray(table).tobytes())
        os.replace(partial, path)
    except OSError as error:
        raise EngineError(
            "export.out", f"{path} cannot be written ({error.strerror}).", "Check the path."
        ) from error


def read_ply(path: Path) -> SurfelCloud:
    """Read what :func:`write_ply` wrote, of either flavour. ``face_index`` is not kept by the format (zeros).

    Raises EngineError ``ply.invalid``.
    """
    data = path.read_bytes()
    head, mark, body = data.partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in head.splitlines() if line.startswith(b"property float ")]
    flavour: Flavour = "3dgs" if "scale_2" in names else "2dgs"
    if not mark or names != _names(flavour) or len(body) % (4 * len(names)):
        raise EngineError(
            "ply.invalid", f"{path.name} is not a surfel PLY.", "Give a file written by export."
        )
    table: NDArray[np.float32] = np.frombuffer(body, "<f4").reshape(-1, len(names)).astype(np.float32)
    column = {name: place for place, name in enumerate(names)}
    values = torch.from_numpy(table)
    rest = values[:, column["f_rest_0"] : column["f_rest_0"] + _HARMONICS].reshape(-1, 3, 15).transpose(1, 2)
    first = column["f_dc_0"]
    return SurfelCloud(
        values[:, :3],
        values[:, column["scale_0"] : column["scale_0"] + 2].exp(),
        values[:, -4:],
        torch.sigmoid(values[:, column["opacity"]]),
        torch.cat([values[:, first : first + 3].unsqueeze(1), rest], 1),
        torch.zeros(len(values), dtype=torch.int64),
    )
