"""Contact sheet of tracking and masks over a video, and their speed and (with a truth folder) accuracy.

    python benchmarks/tracking_contact_sheet.py VIDEO --out SHEET.png [--count 24] [--truth DIR]

Green: mask outline. Blue tint: ignored (forearm, sleeve). Cyan: landmarks, orange where not trusted.
Red: the true outline, with ``--truth``. Landmark error is the mean distance of the 21 points over the
diagonal of the true points' bounding box; a truth's joint definitions differ from the tracker's.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking.landmarks import BONES, HandLandmarks, hand_scale
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.segmentation import HAND, IGNORE, HandSegmenter
from mass_engine.tracking.track import Track, TrackBuilder
from mass_engine.video.reader import VideoWarning, read_frames

TRUTH_NAMES = (
    "wrist",
    "index-proximal", "index-intermediate", "index-distal",
    "middle-proximal", "middle-intermediate", "middle-distal",
    "pinky-proximal", "pinky-intermediate", "pinky-distal",
    "ring-proximal", "ring-intermediate", "ring-distal",
    "thumb-metacarpal", "thumb-proximal", "thumb-distal",
    "thumb-tip", "index-tip", "middle-tip", "ring-tip", "pinky-tip",
)  # fmt: skip

GREEN, RED, CYAN, ORANGE, WHITE = (0, 255, 0), (0, 0, 255), (255, 255, 0), (0, 140, 255), (255, 255, 255)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=24, help="tiles on the sheet")
    parser.add_argument("--columns", type=int, default=6)
    parser.add_argument("--tile", type=int, default=360, help="tile width in pixels")
    parser.add_argument("--truth", type=Path, help="folder with truth.npz and masks/")
    parser.add_argument("--holdout", type=int, default=8, help="every n-th frame is held out; 0 for none")
    options = parser.parse_args()

    track, ms = follow(options.video, options.holdout)
    print(f"{options.video}: {len(track.times)} frames, hand in {len(track.hands)}, missed {track.missed}")
    doubted = [i for i, hand in track.hands.items() if not hand.trusted]
    print(f"side {track.side} (confidence {track.side_confidence:.2f}), not trusted {doubted}")
    print(
        "ms a frame, median: " + ", ".join(f"{name} {np.median(values):.1f}" for name, values in ms.items())
    )
    segmenter = learn(options.video, track)
    wanted = set(np.linspace(0, len(track.times) - 1, options.count).round().astype(int).tolist())
    truth_points = None if options.truth is None else load_points(options.truth)
    tiles, spent, errors, overlaps, lost = [], [], [], [], []
    for frame in read_frames(options.video):
        hand = track.hands.get(frame.index)
        labels: NDArray[np.uint8] | None = None
        if hand is not None:
            start = time.perf_counter()
            mask = segmenter(frame.rgb, hand)
            spent.append(1e3 * (time.perf_counter() - start))
            labels = mask.full(*frame.rgb.shape[:2])
        truth = None if options.truth is None else load_mask(options.truth, frame.index)
        if truth is not None and truth_points is not None and hand is not None and labels is not None:
            true = truth_points[frame.index]
            errors.append(float(np.linalg.norm(hand.points - true, axis=1).mean()) / hand_scale(true))
            judged = labels != IGNORE
            found = (labels == HAND) & judged
            overlaps.append(float((found & truth).sum() / ((found | truth) & judged).sum()))
            lost.append(float((truth & ~judged).sum() / truth.sum()))
        if frame.index in wanted:
            tiles.append(tile(frame.rgb, frame.index, hand, labels, truth, options.tile))
    print(f"mask ms a frame, median: {np.median(spent):.1f}")
    if errors:
        print(f"landmark error / hand size: mean {np.mean(errors):.3f}, median {np.median(errors):.3f}")
        print(f"mask IoU: mean {np.mean(overlaps):.4f}, median {np.median(overlaps):.4f}, "
              f"worst {min(overlaps):.3f}; true hand ignored {np.mean(lost):.4f}")  # fmt: skip
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out), arrange(tiles, options.columns))


def follow(video: Path, holdout: int) -> tuple[Track, dict[str, list[float]]]:
    """Track the clip; milliseconds per frame of decoding and of tracking."""
    builder = TrackBuilder(HandNetworks.load())
    ms: dict[str, list[float]] = {"decode": [], "track": []}
    mark = time.perf_counter()

    def say(warning: VideoWarning) -> None:
        print(f"{warning.code}: {warning.message}")

    for frame in read_frames(video, on_warning=say):
        decoded = time.perf_counter()
        builder.add(frame, bool(holdout) and frame.index % holdout == holdout - 1)
        tracked = time.perf_counter()
        ms["decode"].append(1e3 * (decoded - mark))
        ms["track"].append(1e3 * (tracked - decoded))
        mark = time.perf_counter()
    return builder.finish(), ms


def learn(video: Path, track: Track, samples: int = 20) -> HandSegmenter:
    """The colour model from frames spread over the trusted ones."""
    chosen = set(track.trusted[:: max(1, len(track.trusted) // samples)])
    pairs = [(frame.rgb, track.hands[frame.index]) for frame in read_frames(video) if frame.index in chosen]
    start = time.perf_counter()
    segmenter = HandSegmenter.train(pairs)
    print(f"colour model from {len(pairs)} frames in {time.perf_counter() - start:.2f} s")
    return segmenter


def load_points(folder: Path) -> NDArray[np.float64]:
    """True joints in our order, pixels [T,21,2]."""
    with np.load(folder / "truth.npz") as truth:
        names = [str(name) for name in truth["joint_names"]]
        joints = truth["joints"][:, [names.index(name) for name in TRUTH_NAMES]]
        camera, K = truth["world_to_camera"], truth["K"]
    seen = np.einsum("tij,tkj->tki", camera[:, :3, :3], joints) + camera[:, None, :3, 3]
    projected = seen @ K.T
    return np.asarray(projected[..., :2] / projected[..., 2:], np.float64)


def load_mask(folder: Path, index: int) -> NDArray[np.bool_]:
    """Hand (80) and ring or watch (160), bool [H,W]."""
    image = cv2.imread(str(folder / "masks" / f"{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
    return np.isin(np.asarray(image), (80, 160))


def tile(
    rgb: NDArray[np.uint8],
    index: int,
    hand: HandLandmarks | None,
    labels: NDArray[np.uint8] | None,
    truth: NDArray[np.bool_] | None,
    width: int,
) -> NDArray[np.uint8]:
    """One annotated frame, BGR."""
    image = np.ascontiguousarray(rgb[..., ::-1])
    if labels is not None:
        ignored = labels == IGNORE
        image[ignored] = (0.6 * image[ignored] + np.array([100, 50, 0])).clip(0, 255).astype(np.uint8)
        outline(image, labels == HAND, GREEN)
    if truth is not None:
        outline(image, truth, RED)
    if hand is not None:
        colour = CYAN if hand.trusted else ORANGE
        for parent, child in BONES:
            ends = [
                (round(float(p[0]) - 0.5), round(float(p[1]) - 0.5)) for p in hand.points[[parent, child]]
            ]
            cv2.line(image, ends[0], ends[1], colour, 1, cv2.LINE_AA)
    height = round(image.shape[0] * width / image.shape[1])
    small = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    cv2.putText(small, str(index), (5, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, WHITE, 1, cv2.LINE_AA)
    return small


def outline(image: NDArray[np.uint8], mask: NDArray[np.bool_], colour: tuple[int, int, int]) -> None:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, colour, 1)


def arrange(tiles: list[NDArray[np.uint8]], columns: int) -> NDArray[np.uint8]:
    """Tiles in rows, the last row filled with black."""
    blank = np.zeros_like(tiles[0])
    padded = tiles + [blank] * (-len(tiles) % columns)
    rows = [np.hstack(padded[i : i + columns]) for i in range(0, len(padded), columns)]
    return np.vstack(rows)


if __name__ == "__main__":
    main()
