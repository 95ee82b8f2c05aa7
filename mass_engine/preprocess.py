"""From a video to what the fit starts from: crops, masks, and one aligned pose a frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.camera import Camera
from mass_engine.errors import EngineError
from mass_engine.fitting.views import View
from mass_engine.frame_choice import FrameChoice, choose_frames
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose, Side
from mass_engine.hand.template import load_template
from mass_engine.options import FitOptions
from mass_engine.progress import ProgressMeter
from mass_engine.quality import FrameQuality, QualityMeter, check_clip
from mass_engine.template_spec import parse_template
from mass_engine.tracking.alignment import align_landmarks, interpolate_pose
from mass_engine.tracking.imports.load import load_tracks
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.sam_hq import Predictor, SamHqSegmenter, load_predictor
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE, HandMask, HandSegmenter, hand_box
from mass_engine.tracking.track import Track, TrackBuilder
from mass_engine.tracking.tracks import Tracks
from mass_engine.tracks_spec import parse_tracks
from mass_engine.video.reader import Frame, VideoInfo, VideoWarning, probe, read_frames

#: Field of view of the longer image side when the user gives none, degrees: a phone's main camera.
ASSUMED_FOV = 60.0
#: Crops larger than this on a side are reduced: a fit in minutes cannot use more.
CROP_LIMIT = 640
#: Frames the colour model of the masks is trained on.
MASK_SAMPLES = 24

Warn = Callable[[str, str, str], None]


@dataclass(frozen=True)
class Clip:
    """``views`` in time order with their ``start`` poses [F]; ``tracked`` counts frames with a hand.

    ``template`` is the name of what ``model`` comes from; ``choice`` says why these frames are fitted.
    """

    info: VideoInfo
    camera: Camera
    fov_assumed: bool
    template: str
    model: HandModel
    views: list[View]
    start: HandPose
    frames_read: int
    tracked: int
    choice: FrameChoice


def prepare(video: Path, options: FitOptions, meter: ProgressMeter, warn: Warn) -> Clip:
    """Read, track, judge, segment and align. Raises EngineError when the video cannot be used."""
    meter.update("read", 0.0)
    # A wrong checkpoint is told before the long work.
    wanted = None if options.masks is not None else options.segmenter_weights
    network = None if wanted is None else load_predictor(wanted)
    template = load_template(parse_template(options.template))
    for code, message in template.notes:
        warn(code, message, "Look at the result with care.")
    info = probe(video)
    camera = Camera.from_fov(info.width, info.height, options.fov or ASSUMED_FOV)
    fov_assumed = options.fov is None
    imported = None
    if options.tracks is not None:
        loaded = load_tracks(
            parse_tracks(str(options.tracks)),
            template,
            info,
            options.side,
            camera,
            options.fov is not None,
            options.is_heldout,
        )
        for note in loaded.notes:
            warn(*note)
        imported = loaded.tracks
        if fov_assumed and loaded.camera_known:
            camera, fov_assumed = replace(camera, K=imported.K), False
    marks, times, quality = _landmarks(video, info, options, imported, meter, warn)
    model = template.model(marks[0].side)
    chosen, choice = _choose(marks, quality, times, options)
    views = _cut_views(video, chosen, times, camera, options, network, meter)
    # Shape parameters mean something else on another template: then only the landmarks are of use.
    if imported is None or imported.template != template.name:
        start = _align(model, views, chosen, camera, meter)
    else:
        start = _rows_of(imported, [view.index for view in views])
    return Clip(
        info,
        camera,
        fov_assumed,
        template.name,
        model,
        views,
        start,
        len(times),
        len(marks),
        choice,
    )


def _landmarks(
    video: Path,
    info: VideoInfo,
    options: FitOptions,
    imported: Tracks | None,
    meter: ProgressMeter,
    warn: Warn,
) -> tuple[list[HandLandmarks], dict[int, float], dict[int, FrameQuality]]:
    """Trusted landmarks of the main hand in time order, the time of every frame read, and the quality of the
    frames with landmarks. A clip that cannot give a hand is refused here; the rest of the gate warns."""
    seen = QualityMeter()
    times: dict[int, float] = {}

    def hear(warning: VideoWarning) -> None:
        if warning.code == "video.truncated":
            raise EngineError(warning.code, warning.message, "Record or upload the whole file again.")
        warn(warning.code, warning.message, "Look at the result with care.")

    def frames() -> Iterator[Frame]:
        for frame in read_frames(video, on_warning=hear):
            times[frame.index] = frame.time
            if info.frames:
                meter.update("track", frame.index / info.frames)
            yield frame

    if imported is None:
        track = _track(frames(), options, seen)
        side = track.side if options.side == "auto" else cast("Side", options.side)
        marks = [replace(mark, side=side) for mark in track.hands.values() if mark.trusted]
        return _judged(marks, seen, track.same_side, options, warn), times, seen.of(marks)
    world = imported.joints3d - imported.joints3d.mean(1, keepdims=True)
    given = {
        index: HandLandmarks(
            index,
            imported.pose.side,
            imported.landmarks2d[row],
            world[row],
            imported.scores[row],
            0.5,
            at_joints=imported.at_joints,
        )
        for row, index in enumerate(imported.indices)
    }
    for frame in frames():
        seen.add(frame, [given[frame.index]] if frame.index in given else [])
    marks = [mark for index, mark in given.items() if index in times]
    if len(marks) < 2:
        raise EngineError(
            "tracks.other_video", "The tracks name no frames of this video.", "Give the tracks of this video."
        )
    return _judged(marks, seen, 0, options, warn), times, seen.of(marks)


def _track(frames: Iterator[Frame], options: FitOptions, seen: QualityMeter) -> Track:
    """Follow the main hand; what ``seen`` measures on the way may explain why there is none."""
    builder = TrackBuilder(HandNetworks.load())
    for frame in frames:
        seen.add(frame, builder.add(frame, options.is_heldout(frame.index)))
    try:
        return builder.finish()
    except EngineError as error:
        raise seen.explain(error) from error


def _judged(
    marks: list[HandLandmarks], seen: QualityMeter, same_side: int, options: FitOptions, warn: Warn
) -> list[HandLandmarks]:
    """``marks``, once their frames to fit have passed the gate. Raises EngineError for what is fatal."""
    train = [mark for mark in marks if not options.is_heldout(mark.index)]
    if len(train) < 2:
        raise EngineError(
            "video.no_hand",
            f"Only {len(train)} frames to fit show a hand.",
            "Film one hand, whole, in good light, for a few seconds.",
        )
    for finding in check_clip(train, seen.of(train), same_side):
        if finding.fatal:
            raise EngineError(finding.code, finding.message, finding.advice)
        warn(finding.code, finding.message, finding.advice)
    return marks


def _choose(
    marks: Sequence[HandLandmarks],
    quality: Mapping[int, FrameQuality],
    times: Mapping[int, float],
    options: FitOptions,
) -> tuple[list[HandLandmarks], FrameChoice]:
    """Every held-out frame, and at most ``max_frames`` others, the best; in time order."""
    train = [mark for mark in marks if not options.is_heldout(mark.index)]
    choice = choose_frames(train, quality, times, options.max_frames)
    keep = set(choice.frames)
    return [mark for mark in marks if mark.index in keep or options.is_heldout(mark.index)], choice


def _cut_views(
    video: Path,
    marks: Sequence[HandLandmarks],
    times: dict[int, float],
    camera: Camera,
    options: FitOptions,
    network: Predictor | None,
    meter: ProgressMeter,
) -> list[View]:
    """Second pass over the video: crops around the hand, then their masks."""
    crops: list[tuple[HandLandmarks, tuple[int, int, int, int], NDArray[np.uint8]]] = []
    wanted = {mark.index: mark for mark in marks}
    last = max(wanted)
    for frame in read_frames(video):
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
        masks = [_user_mask(options.masks, mark.index, box, camera) for mark, box, _ in crops]
    return [
        _view(mark, times[mark.index], options.is_heldout(mark.index), box, rgb, mask, camera)
        for (mark, box, rgb), mask in zip(crops, masks, strict=True)
    ]


def _view(
    mark: HandLandmarks,
    time: float,
    heldout: bool,
    box: tuple[int, int, int, int],
    rgb: NDArray[np.uint8],
    mask: HandMask,
    camera: Camera,
) -> View:
    height, width = rgb.shape[:2]
    labels, coverage = mask.full(height, width), mask.full_coverage(height, width)
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
    model: HandModel, views: list[View], marks: Sequence[HandLandmarks], camera: Camera, meter: ProgressMeter
) -> HandPose:
    """Shape and poses of the training frames first; then held-out poses under that shape."""
    train = [row for row, view in enumerate(views) if not view.heldout]
    held = [row for row, view in enumerate(views) if view.heldout]
    main = align_landmarks(
        model,
        [marks[row] for row in train],
        [views[row].time for row in train],
        camera,
        progress=lambda fraction: meter.update("align", 0.8 * fraction),
    ).pose
    if not held:
        return main
    start = interpolate_pose(main, [views[row].time for row in train], [views[row].time for row in held])
    rest = align_landmarks(
        model,
        [marks[row] for row in held],
        [views[row].time for row in held],
        camera,
        betas=main.betas[0],
        start=start,
        iterations=150,
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
