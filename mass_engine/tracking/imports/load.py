"""``--tracks``: our own tracks.json or another program's poses, made ready for the fit.

What other programs give is turned into points in the picture first (their joints through their camera). Then,
when the template is the user's MANO, their parameters are kept as they are and only the translation is solved
again, for the camera of this clip. On any other hand shape parameters mean nothing and a bone of the same
rotation ends elsewhere: there the fit's own alignment to the points begins with the rotations of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mass_engine.camera import Camera
from mass_engine.errors import EngineError
from mass_engine.hand.mano import read_mano
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.hand.template import Template
from mass_engine.tracking.imports.arctic import is_arctic, picture_offset, read_arctic
from mass_engine.tracking.imports.hand_track import Array, HandTrack, Kinematics, Note, invalid
from mass_engine.tracking.imports.harp import is_harp, read_harp
from mass_engine.tracking.imports.placing import project, seen_in, solve_translation
from mass_engine.tracking.imports.regression import is_regression, read_regression
from mass_engine.tracking.imports.values import folder_files, read_values
from mass_engine.tracking.tracks import Tracks, read_tracks
from mass_engine.tracks_spec import Kind, TracksSpec
from mass_engine.video.reader import VideoInfo

#: The wrist joint of MANO's mean right hand about the origin of its mesh, metres.
_MANO_WRIST = np.array([0.0957, 0.0064, 0.0062])
#: A hand of which fewer of its points lie in the picture is not fitted to.
_LEAST_SEEN = 0.6
#: Joints of a file further (median, metres) than this from those of its parameters: other conventions.
_DISAGREE = 0.01
#: Wrist to the farthest fingertip, metres: less than any child's fist, more than any hand.
_LENGTHS = (0.03, 0.4)
_LOOK = "Look at the result with care."


@dataclass(frozen=True)
class LoadedTracks:
    """``tracks`` for the fit; ``camera_known``: their K is the clip's own, not assumed; ``notes`` warn."""

    tracks: Tracks
    camera_known: bool
    notes: tuple[Note, ...] = ()


def load_tracks(
    spec: TracksSpec,
    template: Template,
    info: VideoInfo,
    side: str,
    assumed: Camera,
    fov_given: bool,
    is_heldout: Callable[[int], bool],
) -> LoadedTracks:
    """Read ``spec`` for a video (``info``) and a fit that starts from ``template``.

    ``assumed``: the camera to solve for where the file does not know the real one, or where the user gave the
    field of view (``fov_given``). Shapes are averaged over frames that are not held out. Raises EngineError
    ``tracks.*``, and ``template.*`` for the MANO file.
    """
    size = (info.width, info.height)
    kind, values = _read(spec)
    if kind == "tracks":
        own = read_tracks(spec.path, side, size)
        return LoadedTracks(_for_camera(own, assumed) if fov_given else own, True)
    mano = _kinematics(spec, template)

    def one(track: HandTrack) -> LoadedTracks:
        track, notes = _in_video(track, spec, kind, info.frames)
        camera_known = track.real and not fov_given
        K = track.K if camera_known else assumed.K.double().numpy()
        tracks, placed = _place(track, template, mano, K, size, is_heldout)
        times = [index / max(info.fps, 1e-6) for index in tracks.indices]
        tracks = replace(tracks, fps=info.fps, times=times, at_joints=True)
        return LoadedTracks(tracks, camera_known, (*track.notes, *notes, *placed))

    if kind == "arctic":
        return _fuller(one, read_arctic(values, spec.path, side, size, mano, undistorted=spec.undistorted))
    if kind == "harp":
        return one(read_harp(values, side, size, mano))
    return one(read_regression(values, side, size))


def _fuller(place: Callable[[HandTrack], LoadedTracks], hands: Sequence[HandTrack]) -> LoadedTracks:
    """The hand that is in the picture in more frames; the first of equal ones."""
    placed, errors = [], []
    for track in hands:
        try:
            placed.append(place(track))
        except EngineError as error:
            errors.append(error)
    if not placed:
        raise errors[0]
    return max(placed, key=lambda loaded: len(loaded.tracks.indices))


def _for_camera(tracks: Tracks, camera: Camera) -> Tracks:
    """The same hands where another ``camera`` sees them in the same places."""
    joints, transl = (part.astype(np.float64) for part in (tracks.joints3d, tracks.pose.transl.numpy()))
    local = joints - transl[:, None]
    K = camera.K.double().numpy()
    moved = solve_translation(local, project(joints, tracks.K.double().numpy()), K)
    return replace(
        tracks,
        K=camera.K,
        pose=replace(tracks.pose, transl=torch.tensor(moved, dtype=torch.float32)),
        joints3d=(local + moved[:, None]).astype(np.float32),
    )


def _read(spec: TracksSpec) -> tuple[Kind, Any]:
    """The kind and the values of what ``spec`` names."""
    path, kind = spec.path, spec.kind
    if path.is_dir():
        inner = path / "metro_mano"
        folder = inner if inner.is_dir() and kind in ("auto", "harp") else path
        values: Any = {file.name: read_values(file) for file in folder_files(folder)}
    elif kind == "tracks" or (kind == "auto" and _is_text(path)):
        return "tracks", None
    else:
        values = read_values(path)
    if kind != "auto":
        return kind, values
    kinds: tuple[tuple[Kind, Callable[[Any], bool]], ...] = (
        ("arctic", is_arctic),
        ("harp", is_harp),
        ("wilor", is_regression),
    )
    for known, fits in kinds:
        if fits(values):
            return known, values
    held = list(values)[:8] if isinstance(values, Mapping) else type(values).__name__
    raise EngineError(
        "tracks.unknown_kind",
        f"{path.name} is neither tracks.json nor a known program's poses; it holds {str(held)[:120]}.",
        "Say what it is: wilor:, hamer:, arctic: or harp: before the path; the README lists what each holds.",
    )


def _is_text(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(64).lstrip()[:1] in (b"{", b"[")
    except OSError as error:
        raise EngineError("tracks.not_found", f"{path} cannot be read.", "Check the path.") from error


def _kinematics(spec: TracksSpec, template: Template) -> Kinematics | None:
    if template.mano is not None:
        return Kinematics(template.mano, template.hand)
    if spec.mano is None:
        return None
    file = read_mano(spec.mano)
    return Kinematics(file, file.model(dtype=torch.float64))


def _in_video(
    track: HandTrack, spec: TracksSpec, kind: Kind, frames: int | None
) -> tuple[HandTrack, list[Note]]:
    """The rows of the video's frames, counted from its first one."""
    notes: list[Note] = []
    offset = spec.offset
    if offset is None and kind == "arctic":
        offset, note = picture_offset(spec.path)
        notes.append(note)
    elif offset is None:
        # Pictures numbered from 1 have one that the video would not.
        offset = int(track.counted and min(track.numbers) >= 1 and max(track.numbers) == frames)
        if not offset and track.counted and min(track.numbers) == 1:
            notes.append(
                (
                    "tracks.offset_assumed",
                    "The file's lowest frame is 1: taken as the video's second frame.",
                    "If its frames are numbered from 1, give ,offset=1.",
                )
            )
    indices = np.array(track.numbers) - offset
    track = replace(track, numbers=indices.tolist())
    keep = (indices >= 0) & (indices < (frames or 1 << 40))
    if not keep.any():
        raise EngineError(
            "tracks.other_video",
            "The tracks name no frames of this video.",
            "Give the tracks of this video, or ,offset=N for the number of its first frame.",
        )
    return track.rows(keep), notes


def _place(
    track: HandTrack,
    template: Template,
    mano: Kinematics | None,
    K: Array,
    size: tuple[int, int],
    is_heldout: Callable[[int], bool],
) -> tuple[Tracks, list[Note]]:
    model = template.model(track.side).to("cpu", torch.float64)
    track, points, notes = _points(track, model, mano)
    long = np.linalg.norm(points - points[:, :1], axis=-1).max(1)
    sound = (long > _LENGTHS[0]) & (long < _LENGTHS[1])
    if not sound.any():
        raise invalid(f"its hands are {float(np.median(long)):.3g} m long")
    if not sound.all():
        notes.append(
            ("tracks.frames_dropped", f"{int((~sound).sum())} hands of no sound size left out.", _LOOK)
        )
    track, points = track.rows(sound), points[sound]
    pixels = project(points + track.transl[:, None], track.K, track.distortion)
    # A lens model folds what is far outside back into the picture: the pinhole's points must be near, too.
    straight = project(points + track.transl[:, None], track.K)
    near = seen_in(straight + np.array(size) / 2, (2 * size[0], 2 * size[1])) >= 1
    keep = (
        near
        & (seen_in(pixels, size) >= _LEAST_SEEN)
        & ((points[..., 2] + track.transl[:, None, 2]) > 0).all(1)
    )
    if not keep.any():
        raise EngineError(
            "tracks.other_video",
            "In no frame do the tracks put the hand into the picture.",
            "Give the tracks of this video, whole and uncropped.",
        )
    if not keep.all():
        notes.append(
            ("tracks.frames_dropped", f"{int((~keep).sum())} frames have the hand out of the picture.", _LOOK)
        )
    track, points, pixels = track.rows(keep), points[keep], pixels[keep]

    rotations = track.flat and not any(n[0] == "tracks.parameters_differ" for n in notes)
    exact = template.mano is not None and rotations
    carried = mano is None and track.flat and track.joints is None
    pose = track.pose()
    if exact:
        fitted = [row for row, index in enumerate(track.numbers) if not is_heldout(index)]
        betas = pose.betas[fitted or slice(None)].mean(0)
    else:
        betas = torch.zeros(10, dtype=torch.float64)
    pose = replace(pose, betas=betas.expand(len(pixels), 10), transl=torch.zeros_like(pose.transl))
    local = model.joints(pose).numpy() if exact or carried else points
    try:
        transl = solve_translation(local, pixels, K)
    except np.linalg.LinAlgError as error:
        raise invalid("a hand cannot be placed before this camera") from error
    if not np.isfinite(transl).all() or (transl[:, 2] + local[..., 2].min(1) <= 0.02).any():
        raise invalid("a hand would be behind the camera")
    notes += _summary(track, exact, carried, local + transl[:, None], pixels, K)
    parts = [
        torch.tensor(part, dtype=torch.float32)
        for part in (pose.betas.numpy(), track.orient, track.fingers, transl)
    ]
    tracks = Tracks(
        "",
        0.0,
        size,
        torch.tensor(K, dtype=torch.float32),
        track.numbers,
        [0.0] * len(track.numbers),
        HandPose(parts[0], parts[1], parts[2], parts[3], track.side),
        (local + transl[:, None]).astype(np.float32),
        pixels.astype(np.float32),
        track.scores.tolist(),
        template.name if exact or carried else "points only",
        rotations=rotations,
    )
    return tracks, notes


def _points(
    track: HandTrack, model: HandModel, mano: Kinematics | None
) -> tuple[HandTrack, Array, list[Note]]:
    """The 21 points [F,21,3] before translation: MANO's own, else the file's, else the template's."""
    notes: list[Note] = []
    still = replace(track.pose(), transl=torch.zeros(len(track.numbers), 3, dtype=torch.float64))
    if mano is not None:
        points = mano.model(track.side).joints(still).numpy()
    else:
        points = model.joints(replace(still, betas=torch.zeros_like(still.betas))).numpy()
        wrist = _MANO_WRIST * (1 if track.side == "right" else np.array([-1, 1, 1]))
        points = points + wrist - points[:, :1]
    if track.joints is not None:
        joints = track.joints
        if track.mirrored:
            turned = joints * np.array([-1.0, 1.0, 1.0])
            joints = min((joints, turned), key=lambda choice: _apart(choice, points))
        if mano is not None and track.flat and _apart(joints, points) > _DISAGREE:
            notes.append(
                (
                    "tracks.parameters_differ",
                    "The file's joints are not those of its parameters on this MANO: the joints are used.",
                    "Its fingers may be of another convention or its hand of another model.",
                )
            )
            points = joints
        elif mano is None or not track.flat:
            points = joints
        track = replace(track, joints=joints)
    elif not track.flat:
        raise EngineError(
            "tracks.needs_mano",
            "The poses are relative to MANO's mean pose, and the file holds no 21 joints to use instead.",
            "Give MANO, as ,mano=MANO_RIGHT.pkl after the file or as --template mano:MANO_RIGHT.pkl.",
        )
    if track.other_transl is not None and track.centres is not None:
        choices = (track.transl, track.other_transl)
        track = replace(track, transl=min(choices, key=lambda choice: _off_centre(points, choice, track)))
    return track, points, notes


def _apart(one: Array, two: Array) -> float:
    """Median distance of the 16 joints, wrist on wrist."""
    left, right = one[:, :16] - one[:, :1], two[:, :16] - two[:, :1]
    return float(np.median(np.linalg.norm(left - right, axis=-1)))


def _off_centre(points: Array, transl: Array, track: HandTrack) -> float:
    pixels = project(points + transl[:, None], track.K)
    middle = (pixels.min(1) + pixels.max(1)) / 2
    return float(np.abs(middle - track.centres).sum(1).mean())


def _summary(
    track: HandTrack, exact: bool, carried: bool, placed: Array, pixels: Array, K: Array
) -> Sequence[Note]:
    """What the user should know about how far the file is followed."""
    notes: list[Note] = []
    if carried:
        notes.append(
            (
                "tracks.rotations_only",
                "Without MANO the file's shape means nothing: its rotations are put on the template, whose "
                "bones point a little elsewhere.",
                "Give MANO, as ,mano=MANO_RIGHT.pkl after the file, or save the 21 joints with the poses.",
            )
        )
    elif not exact:
        notes.append(
            (
                "tracks.joints_only",
                "The template is not the hand of the file's parameters: pose and shape are fitted to its "
                "joints.",
                "Use --template mano:MANO_RIGHT.pkl to keep the parameters themselves.",
            )
        )
    if track.distortion is not None:
        off = np.linalg.norm(project(placed, K) - pixels, axis=-1)
        notes.append(
            (
                "tracks.distortion",
                "The lens bends this video and the fit's camera has no lens: hands are placed where the "
                f"picture shows them, their joints are then {float(np.median(off)):.1f} pixels off (median).",
                "Better: undistort the video with the same intrinsics and give ,undistorted=yes.",
            )
        )
    return notes
