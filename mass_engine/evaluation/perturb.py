"""What goes wrong with clips, as functions of a prepared clip. Held-out frames keep clean pictures and masks.

An exposure drift is no exception, but their share of it (:attr:`Level.gains`) belongs to them: a render that
is right there is darker than their clean picture by as much.

Poses are another matter: noise on them is on the held-out ones, too. With *pose noise* the landmarks become
the noisy poses' own joints, as if a tracker that saw nothing better had given both; with *start noise* they
stay what the tracker saw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.evaluation.bench_clips import rows_of
from mass_engine.fitting.kinematics import turned
from mass_engine.fitting.views import View
from mass_engine.hand.model import mirror_pose
from mass_engine.hand.pose import HandPose
from mass_engine.preprocess import Clip
from mass_engine.tracking.imports.placing import solve_translation
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE

Random = np.random.Generator
Change = Callable[[Clip, Random], Clip]
Masks = Callable[
    [NDArray[np.uint8], NDArray[np.float32], Random], tuple[NDArray[np.uint8], NDArray[np.float32]]
]


@dataclass(frozen=True)
class Level:
    """One strength of one perturbation: its place on the axis, its name, and what it does. The fit's own
    seed is moved by ``reseed``; ``gains`` of so many frames [F] are what it does to their exposure."""

    value: float
    name: str
    change: Change
    reseed: int = 0
    gains: Callable[[int], NDArray[np.float64]] = np.ones


def axes() -> dict[str, list[Level]]:
    """Every axis with its levels; the first level of each is the clip itself."""
    same = Level(0.0, "as it is", lambda clip, _: clip)
    found: dict[str, list[Level]] = {
        "pose noise, rad": [Level(s, f"{s:g}", _pose_noise(s)) for s in (0.05, 0.1, 0.2, 0.3, 0.4)],
        "start noise, rad": [Level(s, f"{s:g}", _start_noise(s)) for s in (0.1, 0.2, 0.3)],
        "masks eroded, px": [Level(p, f"{p:g}", _masks(_grown(-p))) for p in (1, 2, 4, 8)],
        "masks dilated, px": [Level(p, f"{p:g}", _masks(_grown(p))) for p in (1, 2, 4, 8)],
        "masks punched, holes": [Level(n, f"{n:g}", _masks(_punched(n))) for n in (2, 5, 10)],
        "masks missing, share": [Level(s, f"{s:g}", _missing(s)) for s in (0.1, 0.3, 0.5)],
        "blur, px": [Level(s, f"{s:g}", _blurred(s)) for s in (1, 2, 4)],
        "exposure drift, stops": [_exposed(s) for s in (0.5, 1.0, 2.0)],
        "occluders": [Level(n, f"{n:g}", _occluded(n)) for n in (1, 2, 4)],
        "frames dropped, share": [Level(s, f"{s:g}", _dropped(s)) for s in (0.3, 0.6, 0.8)],
        "frames fitted": [Level(n, f"{n:g}", _few(n)) for n in (40, 20, 10, 5)],
        "only fists, share of frames": [Level(s, f"{s:g}", _fists(s)) for s in (0.5, 0.25)],
        "only one side seen": [Level(1, "back", _one_side(True)), Level(2, "palm", _one_side(False))],
        "field of view, factor": [Level(f, f"{f:g}", _field_of_view(f)) for f in (0.6, 0.8, 1.25, 1.6)],
        "hand side": [Level(1, "wrong", _wrong_side)],
        "random seed": [Level(n, f"+{n}", lambda clip, _: clip, 1000 * n) for n in (1, 2, 3)],
    }
    return {name: [same, *levels] for name, levels in found.items()}


def _trained(clip: Clip) -> list[int]:
    return [row for row, view in enumerate(clip.views) if not view.heldout]


def _on_views(clip: Clip, change: Callable[[int, View], View]) -> Clip:
    """``change`` of every training view."""
    rows = set(_trained(clip))
    views = [change(row, view) if row in rows else view for row, view in enumerate(clip.views)]
    return replace(clip, views=views)


def _fresh(view: View, **parts: NDArray[np.generic]) -> View:
    return replace(view, **parts, _levels={}, _outline=None)  # type: ignore[arg-type]


def _rows(clip: Clip, wanted: list[int]) -> Clip:
    """The clip with these training rows alone, and every held-out one."""
    return rows_of(clip, [*wanted, *(row for row, view in enumerate(clip.views) if view.heldout)])


def _posed(clip: Clip, start: HandPose) -> Clip:
    """The clip with other start poses, whose joints are the landmarks."""
    with torch.no_grad():
        pixels = clip.camera.project(clip.model.joints(start)).numpy().astype(np.float32)
    views = [replace(view, points=pixels[row], at_joints=True) for row, view in enumerate(clip.views)]
    return replace(clip, views=views, start=start)


def _shaken(clip: Clip, sigma: float, random: Random) -> HandPose:
    """The start poses with noise on every joint's and the wrist's rotation."""
    step = torch.zeros(len(clip.views), 51)
    step[:, :48] = torch.from_numpy(random.normal(0, sigma, (len(clip.views), 48))).float()
    return turned(clip.start, step)


def _pose_noise(sigma: float) -> Change:
    return lambda clip, random: _posed(clip, _shaken(clip, sigma, random))


def _start_noise(sigma: float) -> Change:
    return lambda clip, random: replace(clip, start=_shaken(clip, sigma, random))


def _masks(of: Masks) -> Change:
    def change(clip: Clip, random: Random) -> Clip:
        def one(_: int, view: View) -> View:
            cover = (view.labels == HAND).astype(np.float32) if view.coverage is None else view.coverage
            labels, coverage = of(view.labels, cover, random)
            return _fresh(view, labels=labels, coverage=coverage)

        return _on_views(clip, one)

    return change


def _grown(pixels: float) -> Masks:
    size = 2 * round(abs(pixels)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))

    def of(
        labels: NDArray[np.uint8], cover: NDArray[np.float32], _: Random
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        moved = np.asarray((cv2.dilate if pixels > 0 else cv2.erode)(cover, disc), np.float32)
        moved[labels == IGNORE] = 0
        hand = np.where(moved > 0.5, HAND, BACKGROUND)
        return np.where(labels == IGNORE, IGNORE, hand).astype(np.uint8), moved

    return of


def _punched(holes: float) -> Masks:
    def of(
        labels: NDArray[np.uint8], cover: NDArray[np.float32], random: Random
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        labels, cover = labels.copy(), cover.copy()
        inside = np.argwhere(labels == HAND)
        size = max(2, round(0.06 * max(labels.shape)))
        for row, column in inside[random.integers(len(inside), size=round(holes))] if len(inside) else ():
            hole = np.zeros_like(labels)
            cv2.circle(hole, (int(column), int(row)), size, 1, -1)
            spot = (hole > 0) & (labels == HAND)
            labels[spot], cover[spot] = BACKGROUND, 0
        return labels, cover

    return of


def _missing(share: float) -> Change:
    """Nothing is known about some frames: everything is ignored in them."""

    def change(clip: Clip, random: Random) -> Clip:
        lost = set(random.permutation(_trained(clip))[: round(share * len(_trained(clip)))].tolist())

        def one(row: int, view: View) -> View:
            if row not in lost:
                return view
            nothing = np.full_like(view.labels, IGNORE)
            return _fresh(view, labels=nothing, coverage=np.zeros(nothing.shape, np.float32))

        return _on_views(clip, one)

    return change


def _blurred(sigma: float) -> Change:
    return lambda clip, _: _on_views(
        clip,
        lambda _, view: _fresh(view, rgb=np.asarray(cv2.GaussianBlur(view.rgb, (0, 0), sigma), np.uint8)),
    )


def _exposed(stops: float) -> Level:
    """The exposure falls and rises again by so many stops over the clip (in code values)."""

    def gains(count: int) -> NDArray[np.float64]:
        return np.asarray(2 ** (-stops / 2.2 * np.sin(np.pi * np.arange(count) / max(count - 1, 1))))

    def change(clip: Clip, _: Random) -> Clip:
        of = gains(len(clip.views))

        def one(row: int, view: View) -> View:
            return _fresh(view, rgb=(view.rgb * of[row]).round().clip(0, 255).astype(np.uint8))

        return _on_views(clip, one)

    return Level(stops, f"{stops:g}", change, gains=gains)


def _occluded(count: float) -> Change:
    """Striped things before the hand, which the masks call background, as a segmenter would."""

    def change(clip: Clip, random: Random) -> Clip:
        def one(_: int, view: View) -> View:
            rgb, labels = view.rgb.copy(), view.labels.copy()
            cover = (labels == HAND).astype(np.float32) if view.coverage is None else view.coverage.copy()
            height, width = labels.shape
            for _ in range(round(count)):
                middle = random.uniform((0.2 * width, 0.2 * height), (0.8 * width, 0.8 * height))
                size = random.uniform(0.08, 0.25, 2) * max(height, width)
                corners = cv2.boxPoints((tuple(middle), tuple(size), float(random.uniform(0, 180))))
                spot = np.zeros_like(labels)
                cv2.fillPoly(spot, [corners.astype(np.int32)], 1)
                rows, columns = np.nonzero(spot)
                stripes = ((rows + columns) // 6 % 2)[:, None]
                rgb[rows, columns] = np.where(stripes, random.integers(0, 256, 3), random.integers(0, 256, 3))
                labels[rows, columns], cover[rows, columns] = BACKGROUND, 0
            return _fresh(view, rgb=rgb, labels=labels, coverage=cover)

        return _on_views(clip, one)

    return change


def _dropped(share: float) -> Change:
    """Runs of frames are gone, as when the tracker loses the hand."""

    def change(clip: Clip, random: Random) -> Clip:
        rows = _trained(clip)
        run = max(1, len(rows) // 12)
        blocks = [rows[start : start + run] for start in range(0, len(rows), run)]
        kept = sorted(random.permutation(len(blocks))[: max(2, round((1 - share) * len(blocks)))].tolist())
        return _rows(clip, [row for block in kept for row in blocks[block]])

    return change


def _few(count: float) -> Change:
    def change(clip: Clip, _: Random) -> Clip:
        rows = _trained(clip)
        picked = np.unique(np.linspace(0, len(rows) - 1, min(round(count), len(rows))).round().astype(int))
        return _rows(clip, [rows[place] for place in picked])

    return change


def _fists(share: float) -> Change:
    """Only the frames with the most bent fingers."""

    def change(clip: Clip, _: Random) -> Clip:
        rows = _trained(clip)
        bent = clip.start.hand_pose[torch.tensor(rows), :36].unflatten(-1, (12, 3)).norm(dim=-1).sum(-1)
        order = bent.argsort(descending=True)[: max(2, round(share * len(rows)))]
        return _rows(clip, sorted(rows[int(place)] for place in order))

    return change


def _one_side(back: bool) -> Change:
    """Only the frames in which the hand's back (or palm) looks at the camera most."""

    def change(clip: Clip, _: Random) -> Clip:
        rows = _trained(clip)
        index = torch.tensor(rows)
        with torch.no_grad():
            points = clip.model.joints(clip.start)[index]
        across = torch.linalg.cross(points[:, 4] - points[:, 0], points[:, 7] - points[:, 0])
        sign = 1.0 if clip.model.side == "right" else -1.0
        facing = sign * (across * points.mean(1)).sum(-1)  # along the view or against it
        order = facing.argsort(descending=not back)[: max(2, len(rows) // 2)]
        return _rows(clip, sorted(rows[int(place)] for place in order))

    return change


def _field_of_view(factor: float) -> Change:
    """A camera of another focal length; hands are placed where it sees them."""

    def change(clip: Clip, _: Random) -> Clip:
        scale = torch.tensor([1 / factor, 1 / factor, 1.0])

        def other(K: torch.Tensor) -> torch.Tensor:
            wide = K.clone()
            wide[0, 0], wide[1, 1] = K[0, 0] * scale[0], K[1, 1] * scale[1]
            return wide

        camera = replace(clip.camera, K=other(clip.camera.K))
        with torch.no_grad():
            joints = clip.model.joints(clip.start)
            pixels = clip.camera.project(joints).double().numpy()
        local = (joints - clip.start.transl.unsqueeze(1)).double().numpy()
        transl = solve_translation(local, pixels, camera.K.double().numpy())
        # A crop's principal point moves with the zoom about that of the whole picture: it stays where it is.
        views = [
            replace(view, camera=replace(view.camera, K=other(view.camera.K)), _levels={}, _outline=None)
            for view in clip.views
        ]
        start = replace(clip.start, transl=torch.tensor(transl, dtype=torch.float32))
        return replace(clip, camera=camera, views=views, start=start)

    return change


def _wrong_side(clip: Clip, _: Random) -> Clip:
    """The other hand's model, in mirrored poses, put where the landmarks are."""
    model = clip.model.mirrored()
    pose = clip.start
    start = HandPose(
        pose.betas, pose.global_orient, mirror_pose(pose.hand_pose), torch.zeros_like(pose.transl), model.side
    )
    with torch.no_grad():
        local = model.joints(start).double().numpy()
    points = np.stack([view.points for view in clip.views]).astype(np.float64)
    transl = solve_translation(local, points, clip.camera.K.double().numpy())
    transl[:, 2] = np.maximum(transl[:, 2], 0.1)
    return replace(clip, model=model, start=replace(start, transl=torch.tensor(transl, dtype=torch.float32)))
