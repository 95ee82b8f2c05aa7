"""The tracker's two pretrained networks: fetched once, verified, run through LiteRT.

Both come from MediaPipe (Apache-2.0) and ship inside one of its Python wheels, so the ordinary
package client can bring them: no model hub, no MediaPipe installation. Each file is checked
against its sha256 every time it is loaded.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import platformdirs
from numpy.typing import NDArray

from mass_engine.errors import EngineError

#: The last MediaPipe release whose wheel carries the networks as plain files.
WHEEL = "mediapipe==0.10.21"

_ADVICE = "Run `make setup`, or put both files into the folder named by MASS_MODEL_DIR."


@dataclass(frozen=True)
class NetworkFile:
    """One network: its file ``name``, its ``member`` path inside the wheel, and its ``sha256``."""

    name: str
    member: str
    sha256: str

    def is_intact(self, directory: Path) -> bool:
        """Whether ``directory`` holds this file with the right content."""
        try:
            return hashlib.sha256((directory / self.name).read_bytes()).hexdigest() == self.sha256
        except OSError:
            return False


PALM_DETECTION = NetworkFile(
    "palm_detection_full.tflite",
    "mediapipe/modules/palm_detection/palm_detection_full.tflite",
    "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
)
HAND_LANDMARK = NetworkFile(
    "hand_landmark_full.tflite",
    "mediapipe/modules/hand_landmark/hand_landmark_full.tflite",
    "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
)
NETWORK_FILES: tuple[NetworkFile, ...] = (PALM_DETECTION, HAND_LANDMARK)


def model_dir() -> Path:
    """``MASS_MODEL_DIR`` when set, else the user's cache folder."""
    override = os.environ.get("MASS_MODEL_DIR")
    return (
        Path(override) if override else Path(platformdirs.user_cache_dir("mass", appauthor=False)) / "models"
    )


def missing_files(directory: Path) -> list[NetworkFile]:
    """The networks that ``directory`` lacks or holds in a damaged form."""
    return [file for file in NETWORK_FILES if not file.is_intact(directory)]


def extract(wheel: Path, directory: Path) -> None:
    """Take both networks out of a downloaded ``wheel``; each appears in ``directory`` whole or not at all.

    Raises EngineError ``tracker.networks_damaged`` when the content is not the expected one.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(wheel) as archive:
        for file in NETWORK_FILES:
            content = archive.read(file.member)
            if hashlib.sha256(content).hexdigest() != file.sha256:
                raise EngineError(
                    "tracker.networks_damaged",
                    f"{file.name} in {wheel.name} is not the expected network.",
                    "Check the package index this machine uses, then run `make setup` again.",
                )
            handle, temporary = tempfile.mkstemp(dir=directory, prefix=f".{file.name}.")
            try:
                with os.fdopen(handle, "wb") as stream:
                    stream.write(content)
                    stream.flush()
                    os.fsync(stream.fileno())
                os.chmod(temporary, 0o644)
                os.replace(temporary, directory / file.name)
            except BaseException:
                Path(temporary).unlink(missing_ok=True)
                raise


def fetch(directory: Path | None = None, timeout: float = 600.0) -> bool:
    """Make sure both networks are in ``directory`` (default :func:`model_dir`).

    Returns False when they already were, True when they had to be downloaded (36 MB, once).
    Raises EngineError ``tracker.fetch_failed`` when the download does not succeed.
    """
    directory = model_dir() if directory is None else directory
    if not missing_files(directory):
        return False
    with tempfile.TemporaryDirectory(prefix="mass-networks-") as temporary:
        # The wheel is only unpacked, never installed, so any host may ask for the Linux build.
        command = [
            sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check",
            "--no-deps", "--only-binary=:all:", "--platform", "manylinux_2_28_x86_64",
            "--python-version", "3.11", "--dest", temporary, WHEEL,
        ]  # fmt: skip
        failure: str | None = None
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
            if done.returncode != 0:
                failure = (done.stderr.strip().splitlines() or ["pip gave no reason"])[-1]
        except subprocess.TimeoutExpired:
            failure = f"no answer within {timeout:.0f} s"
        wheels = sorted(Path(temporary).glob("mediapipe-*.whl"))
        if failure is not None or not wheels:
            raise EngineError(
                "tracker.fetch_failed",
                f"The tracker's networks could not be downloaded ({failure or 'no wheel arrived'}).",
                "Check the network connection and run `make setup` again.",
            )
        extract(wheels[0], directory)
    return True


class Network:
    """One LiteRT network with a single float32 image input [1,S,S,3]; not safe to share between threads."""

    def __init__(self, path: Path, num_threads: int = 1) -> None:
        try:
            from ai_edge_litert.interpreter import Interpreter  # heavy, and absent on some platforms
        except ImportError as error:
            raise EngineError(
                "tracker.runtime_missing",
                f"The LiteRT runtime does not load on this platform ({error}).",
                "Install ai-edge-litert, or give your own tracks with `--tracks FILE`.",
            ) from error
        self._interpreter = Interpreter(model_path=str(path), num_threads=num_threads)
        self._interpreter.allocate_tensors()
        details = self._interpreter.get_input_details()[0]
        self._input = int(details["index"])
        self.size = int(details["shape"][1])
        self._outputs = {str(d["name"]): int(d["index"]) for d in self._interpreter.get_output_details()}

    def __call__(self, image: NDArray[np.uint8], names: Sequence[str]) -> list[NDArray[np.float32]]:
        """Run on ``image`` uint8 [S,S,3] RGB, scaled to 0..1 here; the named outputs, batch axis removed."""
        batch = (image.astype(np.float32) * np.float32(1 / 255))[None]
        self._interpreter.set_tensor(self._input, batch)
        self._interpreter.invoke()
        return [
            np.asarray(self._interpreter.get_tensor(self._outputs[name])[0], np.float32) for name in names
        ]


@dataclass(frozen=True)
class HandNetworks:
    """The two networks of the hand tracker, ready to run."""

    palm: Network
    landmark: Network

    @staticmethod
    def load(directory: Path | None = None, num_threads: int = 1) -> HandNetworks:
        """Load both networks from ``directory`` (default :func:`model_dir`).

        Raises EngineError ``tracker.networks_missing`` when one is absent or damaged.
        """
        directory = model_dir() if directory is None else directory
        missing = missing_files(directory)
        if missing:
            names = " and ".join(file.name for file in missing)
            raise EngineError(
                "tracker.networks_missing", f"The tracker lacks {names} in {directory}.", _ADVICE
            )
        return HandNetworks(
            Network(directory / PALM_DETECTION.name, num_threads),
            Network(directory / HAND_LANDMARK.name, num_threads),
        )


def main() -> int:
    """``python -m mass_engine.tracking.models``: fetch the networks, say so in one line."""
    try:
        fetched = fetch()
    except EngineError as error:
        print(error, file=sys.stderr)
        return 3
    print(f"tracker networks {'fetched into' if fetched else 'present in'} {model_dir()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
