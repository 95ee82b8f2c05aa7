"""MASS: a phone video in, a posable hand of 2-D Gaussian surfels out.

The public names load on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mass_engine.avatar import Avatar
    from mass_engine.camera import Camera
    from mass_engine.errors import BadArgumentError, EngineError
    from mass_engine.options import FitOptions
    from mass_engine.pipeline import fit, fit_hands

__all__ = ["Avatar", "BadArgumentError", "Camera", "EngineError", "FitOptions", "fit", "fit_hands"]

_HOMES = {
    "Avatar": "avatar",
    "BadArgumentError": "errors",
    "Camera": "camera",
    "EngineError": "errors",
    "FitOptions": "options",
    "fit": "pipeline",
    "fit_hands": "pipeline",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
