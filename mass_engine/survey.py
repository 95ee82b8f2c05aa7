"""The first pass over a video: which hands are in it, where, how well they are seen, through which camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

from mass_engine.camera import Camera
from mass_engine.errors import EngineError
from mass_engine.hand.pose import Side
from mass_engine.hand.template import Template, load_template
from mass_engine.options import FitOptions
from mass_engine.progress import ProgressMeter
from mass_engine.quality import FrameQuality, QualityMeter, check_clip
from mass_engine.template_spec import parse_template
from mass_engine.tracking.contact import mixed_frames
from mass_engine.tracking.imports.load import LoadedTracks, load_tracks
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.sam_hq import Predictor, load_predictor
from mass_engine.tracking.sides import SIDES
from mass_engine.tracking.track import Track, TrackBuilder
from mass_engine.tracking.tracker import TrackerOptions
from mass_engine.tracking.tracks import Tracks
from mass_engine.tracks_spec import parse_tracks
from mass_engine.video.ahead import ahead
from mass_engine.video.limits import VideoLimits
from mass_engine.video.reader import Frame, VideoInfo, VideoWarning, probe, read_frames

#: Field of view of the longer image side when nothing tells it, degrees: a phone's main camera.
ASSUMED_FOV = 60.0

Warn = Callable[[str, str, str], None]


@dataclass(frozen=True)
class SurveyedHand:
    """One hand over the clip: trusted ``marks`` in time order and their ``quality`` by frame.

    ``tracked`` counts the frames that show it; of these the ``doubted`` ones are outliers or mixed up with
    another hand. ``estimated`` are held-out frames among the marks that were misread or lost, and follow from
    their neighbours (no quality). ``others`` is the other hand by frame, where one is followed.
    ``fov_source``: ``given`` by the user, from the file's ``metadata``, known to the imported ``tracks``, or
    ``assumed``.
    """

    side: Side
    marks: list[HandLandmarks]
    quality: Mapping[int, FrameQuality]
    camera: Camera
    fov_source: str
    tracked: int
    doubted: list[int] = field(default_factory=list)
    estimated: list[int] = field(default_factory=list)
    others: Mapping[int, HandLandmarks] = field(default_factory=dict)
    imported: Tracks | None = None


@dataclass(frozen=True)
class Survey:
    """``hands`` to fit (two only when both were asked for); ``times`` in seconds of every frame read;
    ``network`` that refines the masks of all hands, where one was asked for."""

    info: VideoInfo
    template: Template
    times: Mapping[int, float]
    hands: list[SurveyedHand]
    network: Predictor | None = None


def survey(video: Path, options: FitOptions, meter: ProgressMeter, warn: Warn) -> Survey:
    """Read, track and judge. Raises EngineError when the video cannot be used."""
    meter.update("read", 0.0)
    # A wrong checkpoint is told before the long work.
    wanted = None if options.masks is not None else options.segmenter_weights
    network = None if wanted is None else load_predictor(wanted)
    template = load_template(parse_template(options.template))
    for code, message in template.notes:
        warn(code, message, "Look at the result with care.")
    limits = VideoLimits(max_seconds=options.max_seconds)
    info = probe(video, limits)
    camera, source = survey_camera(info, options)
    times: dict[int, float] = {}
    heard: list[VideoWarning] = []

    def frames() -> Iterator[Frame]:
        for frame in ahead(read_frames(video, limits, heard.append)):
            times[frame.index] = frame.time
            if info.frames:
                meter.update("track", frame.index / info.frames)
            yield frame
        for warning in heard:
            if warning.code == "video.truncated":
                raise EngineError(warning.code, warning.message, "Record or upload the whole file again.")
            warn(warning.code, warning.message, "Look at the result with care.")

    seen = QualityMeter()
    if options.tracks is None:
        found = _tracked(frames(), options, seen, camera, source, warn)
    else:
        loaded = _loaded(template, info, options, camera, warn)
        found = _imported(frames(), times, loaded, seen, camera, source, options, warn)
    return Survey(info, template, times, found, network)


def survey_camera(info: VideoInfo, options: FitOptions) -> tuple[Camera, str]:
    """The camera of the clip, and where its field of view is from: ``given``, ``metadata`` or ``assumed``.

    It is not estimated from the hand: the best fit of the landmarks names a field of view that is 8 to 25
    degrees off and moves the joints by less than their error (see BENCHMARKS.md).
    """
    if options.fov is not None:
        return Camera.from_fov(info.width, info.height, options.fov), "given"
    if info.fov is not None:
        return Camera.from_fov(info.width, info.height, info.fov), "metadata"
    return Camera.from_fov(info.width, info.height, ASSUMED_FOV), "assumed"


def _tracked(
    frames: Iterator[Frame],
    options: FitOptions,
    seen: QualityMeter,
    camera: Camera,
    source: str,
    warn: Warn,
) -> list[SurveyedHand]:
    """Follow hands; what ``seen`` measures on the way may explain why there are none."""
    both = options.side == "both"
    # A second hand that is lost should not be missed for long.
    builder = TrackBuilder(HandNetworks.load(), TrackerOptions(look_every=4) if both else None)
    for frame in frames:
        seen.add(frame, builder.add(frame, options.is_heldout(frame.index)))
    try:
        tracks = _chosen(builder, options.side)
    except EngineError as error:
        raise seen.explain(error) from error
    judged = []
    for track, other in tracks:
        others = other.hands if other else {}
        mixed = mixed_frames(track.hands, others)
        marks = [mark for i, mark in track.hands.items() if mark.trusted and i not in mixed]
        doubted = [i for i, mark in track.hands.items() if not mark.trusted or i in mixed]
        estimated = [mark for i, mark in track.estimated.items() if i not in mixed]
        judged.append(
            SurveyedHand(
                track.side,
                sorted([*marks, *estimated], key=lambda mark: mark.index),
                seen.of(marks),
                camera,
                source,
                len(track.hands),
                doubted,
                [mark.index for mark in estimated],
                others,
            )
        )
    same_side = {track.side: track.same_side for track, _ in tracks}
    return _judged(judged, same_side, options, warn)


def _chosen(builder: TrackBuilder, side: str) -> list[tuple[Track, Track | None]]:
    """The tracks to fit, each with that of the other hand."""
    if side == "both":
        pair = builder.finish_both()
        return [(pair[one], pair.get(two)) for one, two in (SIDES, SIDES[::-1]) if one in pair]
    if side != "auto":
        asked = cast("Side", side)
        pair = _pair(builder)
        if pair:
            return [(pair[asked], pair["left" if asked == "right" else "right"])]
        track = builder.finish()
        hands = {i: replace(hand, side=asked) for i, hand in track.hands.items()}
        return [(replace(track, side=asked, hands=hands), None)]
    track = builder.finish()
    pair = _pair(builder)
    if not pair:
        return [(track, None)]
    other = pair["left" if track.side == "right" else "right"]
    # The side of the main hand is voted otherwise than those of two hands: the other one is another track.
    hands = {
        i: hand
        for i, hand in other.hands.items()
        if i not in track.hands or hand.track != track.hands[i].track
    }
    return [(track, replace(other, hands=hands))]


def _pair(builder: TrackBuilder) -> dict[Side, Track]:
    """Both hands where the clip surely shows two: side by side for half of the rarer one's frames."""
    try:
        pair = builder.finish_both()
    except EngineError:
        return {}
    if len(pair) < 2:
        return {}
    one, two = (set(track.hands) for track in pair.values())
    return pair if len(one & two) >= 0.5 * min(len(one), len(two)) else {}


def _loaded(
    template: Template, info: VideoInfo, options: FitOptions, camera: Camera, warn: Warn
) -> list[LoadedTracks]:
    """The imported tracks of every hand asked for."""
    sides = SIDES if options.side == "both" else (options.side,)
    found: list[LoadedTracks] = []
    errors: list[EngineError] = []
    for side in sides:
        try:
            loaded = load_tracks(
                parse_tracks(str(options.tracks)),
                template,
                info,
                side,
                camera,
                options.fov is not None,
                options.is_heldout,
            )
        except EngineError as error:
            if options.side != "both" or error.code != "tracks.no_hand":
                raise
            errors.append(error)
            continue
        found.append(loaded)
    if not found:
        raise errors[0]
    for note in dict.fromkeys(note for loaded in found for note in loaded.notes):
        warn(*note)
    return found


def _imported(
    frames: Iterator[Frame],
    times: Mapping[int, float],
    loaded: list[LoadedTracks],
    seen: QualityMeter,
    camera: Camera,
    source: str,
    options: FitOptions,
    warn: Warn,
) -> list[SurveyedHand]:
    given = [_as_landmarks(one.tracks, number) for number, one in enumerate(loaded)]
    for frame in frames:
        seen.add(frame, [hands[frame.index] for hands in given if frame.index in hands])
    found = []
    for number, one in enumerate(loaded):
        marks = [mark for index, mark in given[number].items() if index in times]
        if len(marks) < 2:
            raise EngineError(
                "tracks.other_video",
                "The tracks name no frames of this video.",
                "Give the tracks of this video.",
            )
        known = one.camera_known and source != "given"
        found.append(
            SurveyedHand(
                one.tracks.pose.side,
                marks,
                seen.of(marks),
                replace(camera, K=one.tracks.K) if known else camera,
                "tracks" if known else source,
                len(marks),
                others=given[1 - number] if len(given) == 2 else {},
                imported=one.tracks,
            )
        )
    return _judged(found, {}, options, warn)


def _as_landmarks(tracks: Tracks, number: int) -> dict[int, HandLandmarks]:
    world = tracks.joints3d - tracks.joints3d.mean(1, keepdims=True)
    return {
        index: HandLandmarks(
            index,
            tracks.pose.side,
            tracks.landmarks2d[row],
            world[row],
            tracks.scores[row],
            0.5,
            number,
            at_joints=tracks.at_joints,
        )
        for row, index in enumerate(tracks.indices)
    }


def _judged(
    hands: list[SurveyedHand], same_side: Mapping[Side, int], options: FitOptions, warn: Warn
) -> list[SurveyedHand]:
    """The ``hands`` that pass the gate. Raises EngineError when none does; of two, one may fail."""
    passed, errors = [], []
    for hand in hands:
        try:
            _judge(hand, same_side.get(hand.side, 0), options, warn)
            passed.append(hand)
        except EngineError as error:
            errors.append(error)
    if not passed:
        raise errors[0]
    if options.side == "both" and len(passed) == 1:
        side = "left" if passed[0].side == "right" else "right"
        reason = f" ({errors[0].message})" if errors else ""
        warn(
            "video.one_hand",
            f"No {side} hand can be fitted{reason}: the other one is.",
            "Film both hands, whole and side by side, or give --side auto.",
        )
    return passed


def _judge(hand: SurveyedHand, same_side: int, options: FitOptions, warn: Warn) -> None:
    train = [mark for mark in hand.marks if not options.is_heldout(mark.index)]
    if len(train) < 2:
        raise EngineError(
            "video.no_hand",
            f"Only {len(train)} frames to fit show a hand.",
            "Film one hand, whole, in good light, for a few seconds.",
        )
    for finding in check_clip(train, {mark.index: hand.quality[mark.index] for mark in train}, same_side):
        if finding.fatal:
            raise EngineError(finding.code, finding.message, finding.advice)
        warn(finding.code, finding.message, finding.advice)
