"""How good and how fast masks are, against rendered clips with exact truth.

``python benchmarks/mask_truth.py CLIP_DIR...`` tracks CLIP_DIR/video.mp4, masks every trusted frame and
prints means over frames. IoU, and boundary F at 1 and 2 pixels, where nothing is ignored or worn; ``lost``:
share of the true hand that is ignored; ``worn``: share of ring and watch labelled hand; ``offset``: signed
distance of the edge from the true one, pixels, positive outside, from the soft coverage within 4 pixels of
it; ``error``: absolute coverage error in the same band, per pixel of edge. Milliseconds are of process
time, median.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.evaluation.outlines import border, free_border, signed_distance
from mass_engine.preprocess import MASK_SAMPLES
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.segmentation import HAND, IGNORE, HandMask, HandSegmenter
from mass_engine.tracking.track import track_main_hand
from mass_engine.video.reader import read_frames

_BAND = 4.0
_NAMES = ("IoU", "F 1 px", "F 2 px", "lost", "worn", "offset", "error")


def score(mask: HandMask, truth: NDArray[np.uint8]) -> list[float]:
    """The numbers of ``_NAMES`` for one frame."""
    labels, coverage = mask.full(*truth.shape), mask.full_coverage(*truth.shape)
    worn, hand = truth == 160, truth == 80
    judged = (labels != IGNORE) & ~worn & (truth != 240)
    mine, true = (labels == HAND) & judged, hand & judged
    near = ~free_border(judged)
    to_mine, to_true = signed_distance(labels == HAND), signed_distance(hand)
    my_border, true_border = border(labels == HAND) & ~near, border(hand) & ~near
    fits = []
    for limit in (1.5, 2.5):  # to the centre of a border pixel
        precision = (np.abs(to_true[my_border]) <= limit).mean()
        recall = (np.abs(to_mine[true_border]) <= limit).mean()
        fits.append(2 * precision * recall / max(precision + recall, 1e-9))
    band = (np.abs(to_true) < _BAND) & ~near
    wrong = (coverage - hand)[band]
    length = max(1.0, band.sum() / (2 * _BAND))
    return [
        (mine & true).sum() / max(1, (mine | true).sum()),
        *fits,
        (hand & (labels == IGNORE)).sum() / max(1, hand.sum()),
        (worn & (labels == HAND)).sum() / worn.sum() if worn.sum() > 20 else np.nan,
        wrong.sum() / length,
        np.abs(wrong).sum() / length,
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("clips", type=Path, nargs="+")
    cv2.setNumThreads(1)
    for folder in parser.parse_args().clips:
        video = folder / "video.mp4"
        track = track_main_hand(read_frames(video), HandNetworks.load(), lambda _: False)
        marks = {i: replace(mark, points=mark.as_read) for i, mark in track.hands.items() if mark.trusted}
        frames = {frame.index: frame.rgb for frame in read_frames(video) if frame.index in marks}
        order = list(frames)
        picked = np.unique(np.linspace(0, len(order) - 1, min(MASK_SAMPLES, len(order))).round().astype(int))
        segmenter = HandSegmenter.train([(frames[order[i]], marks[order[i]]) for i in picked])
        rows, spent = [], []
        for index in order:
            start = time.process_time()
            mask = segmenter(frames[index], marks[index])
            spent.append(1e3 * (time.process_time() - start))
            truth = cv2.imread(str(folder / "masks" / f"{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
            rows.append(score(mask, np.asarray(truth, np.uint8)))
        table = np.array(rows)
        worn = table[:, 4]
        table[:, 4] = np.where(np.isnan(worn), np.nanmean(worn) if not np.isnan(worn).all() else 0.0, worn)
        found = ", ".join(f"{name} {value:.3f}" for name, value in zip(_NAMES, table.mean(0), strict=True))
        print(f"{folder.name}: {found}; worst IoU {table[:, 0].min():.3f}; {np.median(spent):.1f} ms a frame")


if __name__ == "__main__":
    main()
