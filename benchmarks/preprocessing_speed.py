"""Time and memory of everything before the fit, on a clip enlarged to 720p.

``python benchmarks/preprocessing_speed.py VIDEO... [--rows 720] [--repeat 3]`` enlarges each clip into a
temporary folder, prepares it (read, track, segment, align) and prints milliseconds per frame
read, medians over the repeats, with the stages' shares, and the peak memory of the process. Decoding is part
of tracking and, a second time, of segmenting.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.fitting.report import peak_memory_bytes
from mass_engine.options import FitOptions
from mass_engine.preprocess import prepare
from mass_engine.progress import ProgressMeter
from mass_engine.video.reader import Frame, probe, read_frames
from mass_engine.video.writer import write_video


def enlarged(frames: Iterable[Frame], size: tuple[int, int]) -> Iterator[NDArray[np.uint8]]:
    """Frames uint8 of ``size`` (width, height)."""
    for frame in frames:
        yield np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def measure(video: Path, max_frames: int) -> tuple[int, dict[str, float]]:
    """Frames read, and milliseconds per frame of every stage."""
    meter = ProgressMeter(lambda *_: None)
    clip = prepare(video, replace(FitOptions(), max_frames=max_frames), meter, lambda *_: None)
    meter.close()
    return clip.frames_read, {name: 1e3 * spent / clip.frames_read for name, spent in meter.seconds.items()}


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("videos", type=Path, nargs="+")
    parser.add_argument("--rows", type=int, default=720, help="the shorter side of the enlarged clip")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--max-frames", type=int, default=FitOptions.max_frames)
    arguments = parser.parse_args(argv)
    for video in arguments.videos:
        info = probe(video)
        scale = arguments.rows / min(info.width, info.height)
        width, height = (2 * round(side * scale / 2) for side in (info.width, info.height))
        with tempfile.TemporaryDirectory() as folder:
            large = Path(folder) / "large.mp4"
            write_video(large, enlarged(read_frames(video), (width, height)), round(info.fps))
            runs = [measure(large, arguments.max_frames) for _ in range(arguments.repeat)]
        stages = {name: statistics.median(run[name] for _, run in runs) for name in runs[0][1]}
        whole = statistics.median(sum(run.values()) for _, run in runs)
        shares = ", ".join(f"{name} {spent:.1f}" for name, spent in stages.items())
        print(
            f"{video}: {runs[0][0]} frames of {width}x{height}, {whole:.1f} ms a frame ({shares}); "
            f"{peak_memory_bytes() / 2**20:.0f} MiB at most; load {os.getloadavg()[0]:.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
