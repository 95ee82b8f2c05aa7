"""The field of view from the focal length that some cameras write into a video."""

from __future__ import annotations

import math
from collections.abc import Mapping

#: Keys of the 35 mm equivalent focal length, in millimetres: QuickTime's, and EXIF's where a tool copied it.
_KEYS = ("com.apple.quicktime.camera.focal_length.35mm_equivalent", "focallengthin35mmfilm")
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
#: Fields of view outside of this, in degrees, are no hand-held camera's: a wrong entry.
_PLAUSIBLE = (10.0, 130.0)


def field_of_view(metadata: Mapping[str, str], width: int, height: int) -> float | None:
    """Degrees over the longer side of ``width`` x ``height`` pixels, None where ``metadata`` does not say.

    Equivalence is by the diagonal: the picture's diagonal sees what that of film would.
    """
    lower = {key.lower(): value for key, value in metadata.items()}
    for key in _KEYS:
        try:
            focal = float(lower[key].split()[0])
        except (KeyError, ValueError, IndexError):
            continue
        if not (math.isfinite(focal) and focal > 0):
            continue
        half = 0.5 * _FILM_DIAGONAL / focal * max(width, height) / math.hypot(width, height)
        degrees = math.degrees(2 * math.atan(half))
        if _PLAUSIBLE[0] <= degrees <= _PLAUSIBLE[1]:
            return degrees
    return None
