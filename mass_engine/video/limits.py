"""How much video one job may bring; headers lie, so every cap is also enforced while decoding."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VideoLimits:
    """Caps on one file: its bytes, the pixels of one frame, decoded frames, seconds from first to last.

    An mp4's index may have ``max_index_bytes``, name ``max_samples`` samples over all tracks, and cut them by
    ``max_edits`` entries of an edit list: all far above what a clip of ``max_frames`` needs.
    """

    max_bytes: int = 2_000_000_000
    max_pixels: int = 4096 * 2304
    max_frames: int = 18_000
    max_seconds: float = 600.0
    max_index_bytes: int = 64_000_000
    max_samples: int = 1_000_000
    max_edits: int = 256
