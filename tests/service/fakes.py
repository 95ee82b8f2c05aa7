"""A renderer that behaves or misbehaves as the pose says. Loaded by reference in the render processes."""

from __future__ import annotations

import hashlib
import os
import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.rendering import RenderRefusedError


class FakeAvatar:
    """Flat pictures whose colour depends on everything asked for; left half transparent. Notes widths."""

    def __init__(self, folder: Path, content: bytes) -> None:
        self._folder = folder
        self._content = content

    def render(self, pose: str, camera: str, width: int, height: int, channel: str) -> NDArray[np.uint8]:
        if pose == "die":
            os._exit(9)
        if pose == "hang":
            threading.Event().wait()
        if pose == "wait":
            # Opening a FIFO blocks until the test opens its other end.
            (self._folder / "gate").read_bytes()
        if pose == "bug":
            raise ValueError("a bug in the renderer")
        if pose == "unknown":
            raise RenderRefusedError("pose.unknown", "No such pose.", "Use another.", argument=True)
        with (self._folder / "drawn").open("a") as file:
            file.write(f"{width}\n")
        digest = hashlib.sha256(self._content + f"{pose}|{camera}|{channel}".encode()).digest()
        image = np.empty((height, width, 4), np.uint8)
        image[...] = (*digest[:3], 255)
        image[:, : width // 2, 3] = 0
        return image


def load(path: Path) -> FakeAvatar:
    """Reads the file; notes each load beside it."""
    with (path.parent / "loads").open("a") as file:
        file.write(f"{os.getpid()}\n")
    content = path.read_bytes()
    if content == b"broken":
        raise RenderRefusedError("avatar.corrupt", "It cannot be read.", "Fit again.", argument=False)
    return FakeAvatar(path.parent, content)
