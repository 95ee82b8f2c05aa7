"""SurfelCloud: surfels as numbers, for export and for other tools."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from mass_engine.errors import EngineError

#: Coefficients a colour channel has at each harmonic degree.
SH_COUNTS = (1, 4, 9, 16)


@dataclass(frozen=True)
class SurfelCloud:
    """``means`` [N,3] metres, ``scales`` [N,2] standard deviations in metres, ``quats`` [N,4] wxyz,
    ``opacities`` [N] in 0..1, ``sh`` [N,K,3] with K = 1, 4, 9 or 16, ``face_index`` [N] of the base mesh.

    Raises EngineError ``surfels.shape`` when the parts do not fit together.
    """

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    sh: Tensor
    face_index: Tensor

    def __post_init__(self) -> None:
        n = len(self.means)
        wanted = {
            "means": (n, 3),
            "scales": (n, 2),
            "quats": (n, 4),
            "opacities": (n,),
            "face_index": (n,),
        }
        for name, shape in wanted.items():
            if tuple(getattr(self, name).shape) != shape:
                raise EngineError(
                    "surfels.shape",
                    f"{name} is {tuple(getattr(self, name).shape)}, not {shape}.",
                    "Give one row per surfel.",
                )
        if (
            self.sh.ndim != 3
            or self.sh.shape[0] != n
            or self.sh.shape[1] not in SH_COUNTS
            or self.sh.shape[2] != 3
        ):
            raise EngineError(
                "surfels.shape", f"sh is {tuple(self.sh.shape)}.", "Give [N,K,3] with K = 1, 4, 9 or 16."
            )

    def __len__(self) -> int:
        return len(self.means)
