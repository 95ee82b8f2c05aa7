"""LPIPS 0.1 (Zhang et al. 2018) from the user's own weights, in the three conventions papers report.

The weights are not ours to distribute. A file is the state dictionary of the published metric for one
network, features and linear layers together, as ``torch.save`` or safetensors write it::

    torch.save(lpips.LPIPS(net="vgg").state_dict(), "lpips-vgg.pth")
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from mass_engine.errors import EngineError

Network = Literal["alex", "vgg"]

#: Name of each convention: its network, and whether 0..1 is stretched to -1..1 before the network.
CONVENTIONS: dict[str, tuple[Network, bool]] = {
    "lpips_alex_01": ("alex", False),  # HARP
    "lpips_vgg_01": ("vgg", False),  # 3D Gaussian splatting
    "lpips_vgg_11": ("vgg", True),  # HandAvatar
}


@dataclass(frozen=True)
class _Stack:
    """A feature stack of torchvision: the numbers of each slice's convolutions, the pool before every slice
    but the first (0: none there), and stride and padding of the convolutions (the rest have 1 and 1)."""

    slices: tuple[tuple[int, ...], ...]
    pools: tuple[int, ...]
    special: Mapping[int, tuple[int, int]]


_STACKS: dict[Network, _Stack] = {
    "alex": _Stack(((0,), (3,), (6,), (8,), (10,)), (0, 3, 3, 0, 0), {0: (4, 2), 3: (1, 2)}),
    "vgg": _Stack(((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28)), (0, 2, 2, 2, 2), {}),
}
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_ADVICE = "Give torch.save(lpips.LPIPS(net='alex').state_dict(), FILE), or the same for net='vgg'."


@dataclass(frozen=True)
class Lpips:
    """One network with its linear layers, ready to compare pictures."""

    network: Network
    weights: Mapping[str, Tensor]

    @staticmethod
    def load(path: Path) -> Lpips:
        """Read a weights file without running it.

        Raises EngineError ``lpips.not_found`` or ``lpips.invalid``.
        """
        try:
            head = path.open("rb").read(2)
        except OSError as error:
            raise EngineError("lpips.not_found", f"{path} cannot be read.", "Check the path.") from error
        try:
            if head in (b"PK", b"\x80\x02"):
                values = torch.load(path, map_location="cpu", weights_only=True)
            else:
                values = load_file(path)
        except (SafetensorError, pickle.UnpicklingError, RuntimeError, ValueError, EOFError) as error:
            raise EngineError("lpips.invalid", f"{path.name} cannot be read.", _ADVICE) from error
        return Lpips.of(values, path.name)

    @staticmethod
    def of(values: object, name: str = "the dictionary") -> Lpips:
        """Check a state dictionary. Raises EngineError ``lpips.invalid``."""
        if not isinstance(values, Mapping):
            raise EngineError("lpips.invalid", f"{name} holds no state dictionary.", _ADVICE)
        first = values.get("net.slice1.0.weight")
        kernel = tuple(first.shape) if isinstance(first, Tensor) else ()
        kinds: dict[tuple[int, ...], Network] = {(64, 3, 11, 11): "alex", (64, 3, 3, 3): "vgg"}
        if kernel not in kinds:
            raise EngineError("lpips.invalid", f"{name} is neither LPIPS's AlexNet nor its VGG16.", _ADVICE)
        network = kinds[kernel]
        wanted = [f"lin{number}.model.1.weight" for number in range(5)]
        for place, numbers in enumerate(_STACKS[network].slices, 1):
            for number in numbers:
                wanted += [f"net.slice{place}.{number}.{part}" for part in ("weight", "bias")]
        missing = [key for key in wanted if not isinstance(values.get(key), Tensor)]
        if missing:
            raise EngineError("lpips.invalid", f"{name} lacks {missing[0]}.", _ADVICE)
        return Lpips(network, {key: values[key].float() for key in wanted})

    def __call__(self, image: Tensor, target: Tensor, *, stretch: bool) -> float:
        """Distance of two pictures [H,W,3] in 0..1, each side at least 64 pixels; ``stretch``: to -1..1."""
        total = 0.0
        with torch.no_grad():
            pictures = torch.stack([image, target]).float().permute(0, 3, 1, 2)
            if stretch:
                pictures = 2 * pictures - 1
            shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (_SHIFT, _SCALE))
            x = (pictures - shift) / scale
            for place in range(1, 6):
                x = self._slice(x, place)
                unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
                apart = (unit[:1] - unit[1:]).square()
                total += float(
                    functional.conv2d(apart, self.weights[f"lin{place - 1}.model.1.weight"]).mean()
                )
        return total

    def _slice(self, x: Tensor, place: int) -> Tensor:
        stack = _STACKS[self.network]
        if stack.pools[place - 1]:
            x = functional.max_pool2d(x, stack.pools[place - 1], 2)
        for number in stack.slices[place - 1]:
            stride, padding = stack.special.get(number, (1, 1))
            kernel, bias = (self.weights[f"net.slice{place}.{number}.{part}"] for part in ("weight", "bias"))
            x = functional.relu(functional.conv2d(x, kernel, bias, stride=stride, padding=padding))
        return x


@dataclass(frozen=True)
class LpipsSet:
    """The networks at hand; conventions whose network is missing are not computed."""

    networks: Mapping[Network, Lpips]

    @staticmethod
    def load(paths: Sequence[Path]) -> LpipsSet:
        """Read one file a network. Raises EngineError ``lpips.*``."""
        return LpipsSet({one.network: one for one in map(Lpips.load, paths)})

    def scores(self, image: Tensor, target: Tensor) -> dict[str, float | None]:
        """Every convention; None means not computed: no weights, or a side under 64 pixels."""
        large = min(image.shape[:2]) >= 64
        return {
            name: self.networks[network](image, target, stretch=stretch)
            if large and network in self.networks
            else None
            for name, (network, stretch) in CONVENTIONS.items()
        }
