"""Looks at the hand while it is fitted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.fitting.evidence import Scene
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, render_row

#: Longer side of a look, pixels.
LOOK_SIDE = 320

#: Told what the hand looks like now, uint8 [H,W,3].
Show = Callable[[NDArray[np.uint8]], None]


class Looks:
    """Small pictures of one row on white, a tenth of a pass apart; they change nothing in the fit."""

    def __init__(self, scene: Scene, row: int, skin: Skin, appearance: Appearance, show: Show | None) -> None:
        self._scene, self._row, self._show = scene, row, show
        self._skin, self._appearance = skin, appearance

    def beside(self, progress: Callable[[float], None]) -> Callable[[float], None]:
        """``progress``, with a look whenever the next one is due."""
        due = 0.0

        def report(fraction: float) -> None:
            nonlocal due
            progress(fraction)
            if self._show is not None and fraction >= due:
                due = fraction + 0.1
                self._show(self._picture())

        return report

    def _picture(self) -> NDArray[np.uint8]:
        scene, skin = self._scene, self._skin
        with torch.no_grad():
            camera = scene.views[self._row].level(LOOK_SIDE).camera
            surfels = scene.surfels(skin, self._row)
            out = render_row(self._appearance, surfels, 0, skin.bones, camera, scene.raster, torch.ones(3))
            picture: NDArray[np.uint8] = (255 * out.rgb.clamp(0, 1)).round().to(torch.uint8).numpy()
        return picture
