"""Following hands through a video: detect when lost, read landmarks, carry each hand's region on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking.landmarks import HandLandmarks, LandmarkReader, Reading, hand_scale, region_of
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.palm import PalmDetector, View
from mass_engine.tracking.region import Region


@dataclass(frozen=True)
class TrackerOptions:
    """Thresholds on the networks' scores, and how much is searched.

    ``keep`` presence to go on following a hand; ``doubt`` presence below which a reading is no guide;
    ``accept`` presence to begin; ``palm_floor`` lowest palm score worth a look, ``max_candidates`` of
    them at once; ``max_hands`` followed at once; ``look_every`` frames between looks for a further hand;
    ``recrop`` region change above which a frame is read a second time.
    """

    keep: float = 0.5
    doubt: float = 0.25
    accept: float = 0.8
    palm_floor: float = 0.05
    max_hands: int = 2
    look_every: int = 10
    recrop: float = 0.15
    max_candidates: int = 6


@dataclass(frozen=True)
class _State:
    """Everything that is carried from frame to frame; never changed, only replaced."""

    regions: tuple[tuple[int, Region], ...] = ()
    next_track: int = 0
    lost: tuple[Region, ...] = ()
    since_look: int = 1_000_000
    misses: int = 0


class HandTracker:
    """Follows up to ``max_hands`` hands. Frames are given in order."""

    def __init__(self, networks: HandNetworks, options: TrackerOptions | None = None) -> None:
        self._detect = PalmDetector(networks.palm)
        self._read = LandmarkReader(networks.landmark)
        self._options = options or TrackerOptions()
        self._state = _State()

    def __call__(self, rgb: NDArray[np.uint8], index: int, *, update: bool = True) -> list[HandLandmarks]:
        """Hands in one upright frame ``rgb`` uint8 [H,W,3], in the order they were first seen.

        With ``update=False`` the frame is read from the present state and leaves it as it was, so what is
        found in any other frame does not depend on this one; hands first seen here have negative tracks.
        """
        state, hands = self._step(rgb, index)
        if update:
            self._state = state
            return hands
        known = self._state.next_track
        return [h if h.track < known else replace(h, track=known - 1 - h.track) for h in hands]

    def _step(self, rgb: NDArray[np.uint8], index: int) -> tuple[_State, list[HandLandmarks]]:
        options, old = self._options, self._state
        found: list[tuple[int, Reading]] = []
        lost: list[Region] = []
        for track, region in old.regions:
            reading = self._follow(rgb, region)
            if reading is None or _is_double(reading, [r for _, r in found]):
                lost.append(region)
            else:
                found.append((track, reading))
        next_track, since_look = old.next_track, old.since_look + 1
        lost = (lost + list(old.lost))[: options.max_hands]
        if not found or (len(found) < options.max_hands and since_look >= options.look_every):
            thorough = not found and (old.misses < 8 or old.misses % 3 == 0)
            for reading in self._search(rgb, [r for _, r in found], lost, thorough):
                found.append((next_track, reading))
                next_track += 1
            since_look = 0
        state = _State(
            tuple((track, region_of(reading.points)) for track, reading in found),
            next_track,
            () if found else tuple(lost),
            since_look,
            0 if found else old.misses + 1,
        )
        return state, [_landmarks(index, track, reading) for track, reading in found]

    def _follow(self, rgb: NDArray[np.uint8], region: Region) -> Reading | None:
        """The hand that was in ``region`` a frame ago; read twice when it moved much.

        A hand that is followed is often read well while its presence is low (a fist from behind, a sleeve in
        front). Before it is given up, slightly changed regions are tried: if one is convincing, it is there.
        """
        options = self._options
        reading = self._read(rgb, region)
        moved = region_of(reading.points)
        if region.difference(moved) > options.recrop and reading.score >= options.doubt:
            reading = self._read(rgb, moved)
        if not _is_plausible(reading, rgb):
            return None
        if reading.score >= options.keep:
            return reading
        others = [self._read(rgb, other) for other in _variants(region)]
        best = max(others, key=lambda other: other.score)
        if best.score < options.keep:
            return None
        # Far from the steady reading, the variant saw something else; trust it only when it is sure.
        if not _is_double(best, [reading]):
            return best if best.score >= options.accept and _is_plausible(best, rgb) else None
        return reading

    def _search(
        self, rgb: NDArray[np.uint8], known: Sequence[Reading], lost: Sequence[Region], thorough: bool
    ) -> list[Reading]:
        """Hands beside the ``known`` ones: palms over several views, then regions tried directly."""
        options = self._options
        room = options.max_hands - len(known)
        views = _views(rgb.shape[0], rgb.shape[1])
        palms = self._detect(rgb, views if thorough else views[:2], options.palm_floor)
        candidates = [palm.region() for palm in palms[: options.max_candidates]]
        new: list[Reading] = []
        for region in [*lost, *candidates] if not known else candidates:
            self._consider(rgb, region, known, new)
        if not new and not known and thorough:
            for region in _direct_regions(rgb.shape[0], rgb.shape[1]):
                self._consider(rgb, region, known, new)
                if new:
                    break
        new.sort(key=lambda reading: -reading.score * hand_scale(reading.points))
        return new[:room]

    def _consider(
        self, rgb: NDArray[np.uint8], region: Region, known: Sequence[Reading], new: list[Reading]
    ) -> None:
        """Append what ``region`` shows to ``new`` if it holds up after two more looks and is not a double."""
        reading = self._read(rgb, region)
        for _ in range(2):
            if reading.score < 0.1:
                return
            reading = self._read(rgb, region_of(reading.points))
        accepted = reading.score >= self._options.accept and _is_plausible(reading, rgb)
        if accepted and not _is_double(reading, [*known, *new]):
            new.append(reading)


def _views(height: int, width: int) -> list[View]:
    """Square windows, most useful first: the whole image, with a wide margin, then overlapping parts."""
    long, short = max(height, width), min(height, width)
    whole = View((width - long) / 2, (height - long) / 2, long)
    wide = View(width / 2 - long, height / 2 - long, 2 * long)
    views = [whole, wide]
    for size in (short, 0.6 * short):
        columns, rows = (max(1, round(1.6 * (side - size) / size)) + 1 for side in (width, height))
        if size == short:
            columns, rows = (1 if side == short else n for side, n in ((width, columns), (height, rows)))
        views += [
            View(float(x), float(y), float(size))
            for y in np.linspace(0, height - size, rows)
            for x in np.linspace(0, width - size, columns)
        ]
    return views


def _direct_regions(height: int, width: int) -> list[Region]:
    """Regions to try without a palm: the middle of the image, large, in four directions."""
    quarter = np.pi / 2
    return [
        Region(width / 2, height / 2, size * min(height, width), turn * quarter)
        for size in (1.2, 0.8)
        for turn in (0, -1, 1, 2)
    ]


def _variants(region: Region) -> list[Region]:
    """Tighter and turned versions of a region."""
    return [
        replace(region, size=0.8 * region.size, angle=region.angle + turn) for turn in (-0.5, 0.0, 0.5)
    ] + [replace(region, angle=region.angle + turn) for turn in (-0.5, 0.5)]


def _is_double(reading: Reading, others: Sequence[Reading]) -> bool:
    """Whether ``reading`` shows the same hand as one of ``others``: landmarks agree or pile up."""
    for other in others:
        size = min(hand_scale(reading.points), hand_scale(other.points))
        apart = float(np.linalg.norm(reading.points - other.points, axis=1).mean())
        centres = float(np.linalg.norm(reading.points.mean(0) - other.points.mean(0)))
        if apart < 0.35 * size or centres < 0.2 * size:
            return True
    return False


def _is_plausible(reading: Reading, rgb: NDArray[np.uint8]) -> bool:
    """Most of the hand inside the image, of a size that can be seen, and not collapsed."""
    height, width = rgb.shape[:2]
    inside = ((reading.points >= 0) & (reading.points < (width, height))).all(1).mean()
    return bool(inside >= 0.4 and 16 <= hand_scale(reading.points) <= 3 * max(height, width))


def _landmarks(index: int, track: int, reading: Reading) -> HandLandmarks:
    return HandLandmarks(
        index,
        "right" if reading.right >= 0.5 else "left",
        reading.points,
        reading.world,
        reading.score,
        reading.right,
        track,
    )
