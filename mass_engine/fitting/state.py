"""What a fit has found so far, and its checkpoint: a fit that is killed goes on after its last step."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from mass_engine.deform.network import DeformationConfig
from mass_engine.deform.static import StaticResiduals
from mass_engine.fitting.evidence import Evidence
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, Shape
from mass_engine.fitting.views import View
from mass_engine.surfel.binding import MeshBinding

_APPEARANCE = ("albedo", "opacity_logits", "sh", "light")
_EVIDENCE = ("hand", "ignored", "background", "albedo")


@dataclass
class FitState:
    """``steps`` finished; poses, shape, ``light`` [9,3], ``gains`` [F,3]; from the conversion on the surfels.

    ``memory`` is the registration's (each row's last step); ``covered`` are pixels of rows that are ignored
    beside those of the mask, as packed bits; ``notes`` is plain data for the report
    (decisions, validation figures, seconds).
    """

    table: PoseTable
    shape: Shape
    light: Tensor
    gains: Tensor
    steps: list[str] = field(default_factory=list)
    skin: Skin | None = None
    appearance: Appearance | None = None
    evidence: Evidence | None = None
    memory: dict[str, Tensor] = field(default_factory=dict)
    covered: dict[int, Tensor] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)

    def surfels(self) -> tuple[Skin, Appearance]:
        """What the conversion made."""
        if self.skin is None or self.appearance is None:
            raise RuntimeError("the mesh has not been converted yet")
        return self.skin, self.appearance

    def save(self, path: Path, fingerprints: tuple[str, str]) -> None:
        """Write it to ``path`` in one step; ``fingerprints``: of the registration, and of the whole fit."""
        tensors = {f"table.{name}": value for name, value in self.table.values.items()}
        tensors |= {
            "shape.betas": self.shape.betas,
            "shape.displacement": self.shape.displacement,
            "light": self.light,
            "gains": self.gains,
        }
        tensors |= {f"memory.{name}": value for name, value in self.memory.items()}
        tensors |= {f"covered.{row}": bits for row, bits in self.covered.items()}
        metadata: dict[str, Any] = {"fingerprints": fingerprints, "steps": self.steps, "notes": self.notes}
        if self.appearance is not None and self.skin is not None:
            tensors |= {f"appearance.{name}": getattr(self.appearance, name) for name in _APPEARANCE}
            tensors["skin.sources"] = self.skin.sources
            binding = self.skin.binding
            metadata["binding"] = [binding.levels, binding.depth, binding.widened]
            metadata["detached_from"] = self.skin.detached_from
            if self.skin.deformation is not None:
                tensors |= {f"deformation.{n}": v for n, v in self.skin.deformation.tensors().items()}
                metadata["deformation"] = asdict(self.skin.deformation.config)
            if self.skin.static is not None:
                tensors |= {f"static.{name}": value for name, value in self.skin.static.tensors().items()}
        if self.evidence is not None:
            tensors |= {f"evidence.{name}": getattr(self.evidence, name) for name in _EVIDENCE}
        partial = path.with_name(path.name + ".partial")
        # A copy each: the format refuses tensors that share memory.
        copies = {name: value.detach().contiguous().clone() for name, value in tensors.items()}
        save_file(copies, partial, {"state": json.dumps(metadata)})
        os.replace(partial, path)

    def load(self, path: Path, fingerprints: tuple[str, str]) -> bool:
        """Take over the checkpoint at ``path``; False, and nothing changed, if it is none of this fit.

        Before the conversion to surfels it is enough that the registration is the same.
        """
        if not path.is_file():
            return False
        try:
            with safe_open(path, framework="pt") as file:
                metadata = json.loads((file.metadata() or {})["state"])
                registration, whole = metadata["fingerprints"]
                early = "binding" not in metadata and registration == fingerprints[0]
                if not early and whole != fingerprints[1]:
                    return False
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
        except (SafetensorError, KeyError, ValueError, OSError):
            return False
        for name, value in self.table.values.items():
            value.copy_(tensors[f"table.{name}"])
        self.shape.betas.copy_(tensors["shape.betas"])
        self.shape.displacement.copy_(tensors["shape.displacement"])
        self.light, self.gains = tensors["light"], tensors["gains"]
        self.steps, self.notes = list(metadata["steps"]), dict(metadata["notes"])
        if "binding" in metadata:
            binding = MeshBinding.build(self.shape.model, *metadata["binding"])
            self.skin = Skin(binding, tensors["skin.sources"], int(metadata["detached_from"]))
            if "deformation" in metadata:
                config = DeformationConfig.from_dict(metadata["deformation"])
                self.skin.deformation = self.skin.new_deformation(self.shape.model, config, 0)
                prefix = "deformation."
                self.skin.deformation.load_tensors(
                    {n.removeprefix(prefix): v for n, v in tensors.items() if n.startswith(prefix)}
                )
            self.skin.static = StaticResiduals.read(tensors, self.skin.detached_from)
            self.appearance = Appearance(*(tensors[f"appearance.{name}"] for name in _APPEARANCE))
        self.memory = {
            name.removeprefix("memory."): value
            for name, value in tensors.items()
            if name.startswith("memory.")
        }
        self.covered = {
            int(name.removeprefix("covered.")): bits
            for name, bits in tensors.items()
            if name.startswith("covered.")
        }
        if "evidence.hand" in tensors:
            self.evidence = Evidence(*(tensors[f"evidence.{name}"] for name in _EVIDENCE))
        return True


def fingerprint_of(views: list[View], start: Tensor, settings: str) -> str:
    """A digest of everything a fit depends on: pixels, masks, start poses and settings."""
    digest = hashlib.sha256(settings.encode())
    for view in views:
        digest.update(f"{view.index} {view.time} {view.heldout} {view.score}".encode())
        for array in (view.rgb, view.labels, view.points, view.coverage):
            digest.update(b"" if array is None else array.tobytes())
    digest.update(start.detach().numpy().tobytes())
    digest.update(torch.__version__.encode())
    return digest.hexdigest()
