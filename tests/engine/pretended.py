"""A device that is not there: torch's "meta", which has shapes and no values, in a GPU's place.

Whatever asks it for a number fails, and so does, watched, whatever touches a tensor of the host.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mass_engine import gpu
from mass_engine.camera import Camera
from mass_engine.raster import Extras, RasterOptions, RenderOutput


class _Watch(TorchDispatchMode):
    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = function(*args, **(kwargs or {}))
        for value in tree_leaves((args, kwargs, out)):
            if isinstance(value, Tensor):
                assert value.device.type == "meta", f"{function} touches the host"
        return out


@contextmanager
def nothing_of_the_host() -> Iterator[None]:
    """Fail where an operator takes or makes a tensor that is not on "meta"."""
    with _Watch():  # type: ignore[no-untyped-call]
        yield


def painted(
    means: Tensor,
    tangents: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    options: RasterOptions,
    background: Tensor | None = None,
) -> RenderOutput:
    """Pictures that depend on everything, in place of a rasteriser that needs a GPU."""
    number = means.sum() + tangents.sum() + (opacities.unsqueeze(-1) * colors).sum()
    number = number + camera.K.sum() + camera.world_to_camera.sum()
    picture = number.expand(camera.height, camera.width)
    rgb = torch.stack([picture] * 3, -1)
    counters = torch.zeros(3, dtype=torch.int32, device=means.device)
    extras = None
    if options.outputs == "all":
        extras = Extras(picture, rgb, picture, opacities.detach())
    return RenderOutput(
        rgb if background is None else rgb + background, picture, picture, -1, extras, counters
    )


def pretend_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU, where sparse products, the deformation and the structural loss have kernels."""
    monkeypatch.setattr(gpu, "kernels_for", lambda _: gpu)
    monkeypatch.setattr(gpu, "sparse_product", lambda _, m, d: d.new_zeros(m.shape[0], d.shape[1]))
    monkeypatch.setattr(gpu, "DECODER_WIDTHS", ())
    monkeypatch.setattr(gpu, "deform_passes", lambda _: (lambda *_: None, lambda *_: None))
    monkeypatch.setattr(gpu, "dssim", lambda _, seen, wanted, inside: (seen.sum(-1) * inside).sum())
