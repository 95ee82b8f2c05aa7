"""From the hands of a survey to what the fit starts from: crops, masks, and one aligned pose a frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.camera import Camera
from mass_engine.errors import EngineError
from mass_engine.fitting.views import View
from mass_engine.frame_choice import FrameChoice, choose_frames
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.options import FitOptions
from mass_engine.progress import ProgressMeter
from mass_engine.quality import FrameQuality
from mass_engine.survey import Survey, SurveyedHand, Warn, survey
from mass_engine.tracking.alignment import align_landmarks, interpolate_pose
from mass_engine.tracking.contact import hide_other, is_apart
from mass_engine.tracking.imports.placing import solve_translation
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.sam_hq import Predictor, SamHqSegmenter
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE, HandMask, HandSegmenter, hand_box
from mass_engine.tracking.tracks import Tracks
from mass_engine.video.ahead import ahead
from mass_engine.video.limits import VideoLimits
from mass_engine.video.reader import VideoInfo, read_frames

#: Crops larger than this on a side are reduced: a fit in minutes cannot use more.
CROP_LIMIT = 640
#: Frames the colour model of the masks is trained on.
MASK_SAMPLES = 24
#: At most so many held-out frames are kept, evenly spread (or ``max_frames``, if that is more): memory.
HELDOUT_LIMIT = 160


@dataclass(frozen=True)
class Clip:
    """``views`` in time order with their ``start`` poses [F]; ``tracked`` counts frames with the hand, of
    which those of ``doubted`` are not used; ``estimated``: see :class:`mass_engine.survey.SurveyedHand`.

    ``template`` is the name of what ``model`` comes from; ``choice`` says why these frames are fitted;
    ``fov_source`` see :class:`mass_engine.survey.SurveyedHand`.
    """

    info: VideoInfo
    camera: Camera
    fov_source: str
    template: str
    model: HandModel
    views: list[View]
    start: HandPose
    frames_read: int
    tracked: int
    doubted: list[int]
    estimated: list[int]
    choice: FrameChoice


def prepare(video: Path, options: FitOptions, meter: ProgressMeter, warn: Warn) -> Clip:
    """Read, track, judge, segment and align one hand. Raises EngineError when the video cannot be used."""
    found = survey(video, options, meter, warn)
    return prepare_hand(video, found, found.hands[0], options, meter)


def prepare_hand(
    video: Path, found: Survey, hand: SurveyedHand, options: FitOptions, meter: ProgressMeter
) -> Clip:
    """Segment and align one of the hands ``found``."""
    template = found.template
    model = template.model(hand.side)
    chosen, choice = _choose(hand.marks, hand.quality, found.times, options)
    views = _cut_views(video, chosen, hand.others, found.times, hand.camera, options, found.network, meter)
    imported = hand.imported
    # Shape parameters mean something else on another template: then only the landmarks are of use.
    if imported is not None and imported.template == template.name:
        start = _rows_of(imported, [view.index for view in views])
    else:
        begin = None if imported is None else _begin(imported, model, chosen, hand.camera)
        start = _align(model, views, chosen, hand.camera, begin, meter)
    return Clip(
        found.info,
        hand.camera,
        hand.fov_source,
        template.name,
        model,
        views,
        start,
        len(found.times),
        hand.tracked,
        hand.doubted,
        hand.estimated,
        choice,
    )


def _choose(
    marks: Sequence[HandLandmarks],
    quality: Mapping[int, FrameQuality],
    times: Mapping[int, float],
    options: FitOptions,
) -> tuple[list[HandLandmarks], FrameChoice]:
    """The held-out frames, and at most ``max_frames`` others, the best; in time order."""
    train = [mark for mark in marks if not options.is_heldout(mark.index)]
    held = [mark.index for mark in marks if options.is_heldout(mark.index)]
    limit = max(HELDOUT_LIMIT, options.max_frames)
    if len(held) > limit:
        held = [held[row] for row in np.linspace(0, len(held) - 1, limit).round().astype(int)]
    choice = choose_frames(train, quality, times, options.max_frames)
    keep = {*choice.frames, *held}
    return [mark for mark in marks if mark.index in keep], choice


def _cut_views(
    video: Path,
    marks: Sequence[HandLandmarks],
    others: Mapping[int, HandLandmarks],
    times: Mapping[int, float],
    camera: Camera,
    options: FitOptions,
    network: Predictor | None,
    meter: ProgressMeter,
) -> list[View]:
    """Second pass over the video: crops around the hand, then their masks, without the other hand."""
    crops: list[tuple[HandLandmarks, tuple[int, int, int, int], NDArray[np.uint8]]] = []
    wanted = {mark.index: mark for mark in marks}
    last = max(wanted)
    for frame in ahead(read_frames(video, VideoLimits(max_seconds=options.max_seconds))):
        mark = wanted.get(frame.index)
        if mark is not None:
            x, y, w, h = box = hand_box(mark.points, *frame.rgb.shape[:2])
            crops.append((mark, box, frame.rgb[y : y + h, x : x + w].copy()))
            meter.update("segment", 0.2 * len(crops) / len(marks))
        if frame.index >= last:
            break
    moved = [replace(mark, points=mark.as_read - np.array(box[:2], np.float32)) for mark, box, _ in crops]
    if options.masks is None:
        train = [row for row, (mark, _, _) in enumerate(crops) if not options.is_heldout(mark.index)]
        # Beside another hand, skin would be learnt as background, too.
        alone = [row for row in train if is_apart(crops[row][0], others.get(crops[row][0].index))]
        train = alone if len(alone) >= 4 else train
        picked = np.unique(np.linspace(0, len(train) - 1, min(MASK_SAMPLES, len(train))).round().astype(int))
        segmenter: HandSegmenter | SamHqSegmenter
        segmenter = HandSegmenter.train([(crops[train[i]][2], moved[train[i]]) for i in picked])
        if network is not None:
            segmenter = SamHqSegmenter(segmenter, network)
        with ThreadPoolExecutor(2) as pool:
            masks = []
            for done, mask in enumerate(
                pool.map(lambda i: segmenter(crops[i][2], moved[i]), range(len(crops)))
            ):
                masks.append(mask)
                meter.update("segment", 0.2 + 0.8 * (done + 1) / len(crops))
    else:
        folder = options.masks / marks[0].side if options.side == "both" else options.masks
        masks = [_user_mask(folder, mark.index, box, camera) for mark, box, _ in crops]
        others = {}
    views = []
    for (mark, box, rgb), mask in zip(crops, masks, strict=True):
        size = rgb.shape[0], rgb.shape[1]
        labels = hide_other(mask.full(*size), mark, others.get(mark.index), box[:2])
        coverage = np.where(labels == IGNORE, np.float32(0), mask.full_coverage(*size))
        heldout = options.is_heldout(mark.index)
        views.append(_view(mark, times[mark.index], heldout, box, rgb, labels, coverage, camera))
    return views


def _view(
    mark: HandLandmarks,
    time: float,
    heldout: bool,
    box: tuple[int, int, int, int],
    rgb: NDArray[np.uint8],
    labels: NDArray[np.uint8],
    coverage: NDArray[np.float32],
    camera: Camera,
) -> View:
    height, width = rgb.shape[:2]
    view_camera = camera.crop(*box)
    scale = CROP_LIMIT / max(height, width)
    if scale < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        labels = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        coverage = np.asarray(cv2.resize(coverage, size, interpolation=cv2.INTER_AREA), np.float32)
        # Where the reduced coverage decides, so do the labels.
        labels = np.where(labels == IGNORE, IGNORE, np.where(coverage > 0.5, HAND, BACKGROUND)).astype(
            np.uint8
        )
        view_camera = view_camera.resized(*size)
    return View(
        mark.index,
        time,
        heldout,
        rgb,
        labels,
        view_camera,
        mark.points,
        mark.score,
        mark.at_joints,
        coverage,
    )


def _user_mask(directory: Path, index: int, box: tuple[int, int, int, int], camera: Camera) -> HandMask:
    """The user's mask DIR/%06d.png: 0 background, 255 hand, anything between: ignored."""
    path = directory / f"{index:06d}.png"
    full = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if full is None:
        raise EngineError(
            "masks.missing",
            f"There is no readable mask {path.name}.",
            "Give one 8-bit grey PNG per frame, named by its index with six digits.",
        )
    if full.shape != (camera.height, camera.width):
        raise EngineError(
            "masks.wrong_size",
            f"{path.name} is {full.shape[1]}x{full.shape[0]}, the video {camera.width}x{camera.height}.",
            "Give masks at the video's upright size.",
        )
    x, y, w, h = box
    part = full[y : y + h, x : x + w]
    labels = np.full(part.shape, IGNORE, np.uint8)
    labels[part == 0] = BACKGROUND
    labels[part == 255] = HAND
    return HandMask((0, 0, w, h), labels, (labels == HAND).astype(np.float32))


def _align(
    model: HandModel,
    views: list[View],
    marks: Sequence[HandLandmarks],
    camera: Camera,
    begin: HandPose | None,
    meter: ProgressMeter,
) -> HandPose:
    """Shape and poses of the training frames first; then held-out poses under that shape. ``begin`` [F] where
    poses are known roughly."""
    train = [row for row, view in enumerate(views) if not view.heldout]
    held = [row for row, view in enumerate(views) if view.heldout]
    main = align_landmarks(
        model,
        [marks[row] for row in train],
        [views[row].time for row in train],
        camera,
        start=None if begin is None else _rows(begin, train),
        progress=lambda fraction: meter.update("align", 0.8 * fraction),
    ).pose
    if not held:
        return main
    start = (
        interpolate_pose(main, [views[row].time for row in train], [views[row].time for row in held])
        if begin is None
        else _rows(begin, held)
    )
    rest = align_landmarks(
        model,
        [marks[row] for row in held],
        [views[row].time for row in held],
        camera,
        betas=main.betas[0],
        start=start,
        iterations=100,
        progress=lambda fraction: meter.update("align", 0.8 + 0.2 * fraction),
    ).pose
    order = torch.tensor(train + held).argsort()
    return HandPose(
        main.betas[:1].expand(len(views), 10),
        torch.cat([main.global_orient, rest.global_orient])[order],
        torch.cat([main.hand_pose, rest.hand_pose])[order],
        torch.cat([main.transl, rest.transl])[order],
        main.side,
    )


def _begin(
    tracks: Tracks, model: HandModel, marks: Sequence[HandLandmarks], camera: Camera
) -> HandPose | None:
    """The imported rotations on this hand of mean shape, each where its points are; None without them."""
    if not tracks.rotations:
        return None
    known = _rows_of(tracks, [mark.index for mark in marks])
    pose = replace(known, betas=torch.zeros_like(known.betas), transl=torch.zeros_like(known.transl))
    points = np.stack([mark.points for mark in marks]).astype(np.float64)
    local = model.joints(pose).double().numpy()
    transl = solve_translation(local, points, camera.K.double().numpy())
    if not np.isfinite(transl).all() or (transl[:, 2] < 0.05).any():
        return None
    return replace(pose, transl=torch.tensor(transl, dtype=torch.float32))


def _rows(pose: HandPose, rows: Sequence[int]) -> HandPose:
    index = torch.tensor(rows)
    return HandPose(
        pose.betas[index], pose.global_orient[index], pose.hand_pose[index], pose.transl[index], pose.side
    )


def _rows_of(tracks: Tracks, indices: Sequence[int]) -> HandPose:
    rows = torch.tensor([tracks.indices.index(index) for index in indices])
    pose = tracks.pose
    return HandPose(
        pose.betas.mean(0, keepdim=True).expand(len(rows), 10),
        pose.global_orient[rows],
        pose.hand_pose[rows],
        pose.transl[rows],
        pose.side,
    )
