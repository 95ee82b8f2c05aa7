"""Bringing somebody's rigged hand into the engine's form: units, axes, a flat rest pose, a shape basis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mass_engine.errors import EngineError
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import JOINT_NAMES, JOINT_PARENTS, TIP_PARENTS, Side

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

#: Wrist to the tip of the middle finger in metres: hands from small children's to giants'.
HAND_LENGTHS = (0.08, 0.3)
#: Units a file may be in, by what one of them is in metres.
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
#: What is left of a forearm beyond the wrist joint, metres.
FOREARM = 0.07
#: Below this the sides cannot be told apart, in hand lengths.
_CLEAR = 0.02
_GUESS = np.radians(15)
_PALM = [0, 1, 4, 7, 10]
_FIRST = (1, 4, 7, 10, 13)
#: The five digits as rows of the 21 points, first joint to tip.
_CHAINS = tuple((first, first + 1, first + 2, 16 + TIP_PARENTS.index(first + 2)) for first in _FIRST)
#: Relative growth of the whole hand per unit of the first shape parameter, as the built-in hand's.
_SIZE_STEP = 0.06


@dataclass
class RiggedHand:
    """``vertices`` [V,3], ``faces`` [F,3], ``weights`` [V,16], ``points`` [21,3], all in the file's space.

    ``guessed``: rows of ``points`` that the rig does not have.
    """

    vertices: Array
    faces: Faces
    weights: Array
    points: Array
    guessed: tuple[int, ...] = ()


def estimate_tips(vertices: Array, joints: Array, weights: Array) -> tuple[Array, NDArray[np.int64]]:
    """Fingertips [5,3] (thumb first) from the skin of each last bone, and the vertex nearest to each [5].

    A tip is where the farthest tenth of that skin ends, in the direction of the bone before.

    Raises ValueError when a last joint moves no skin.
    """
    tips, nearest = [], []
    for parent in TIP_PARENTS:
        own = vertices[weights[:, parent] > 0.5]
        if len(own) == 0:
            raise ValueError(f"joint {parent} moves no skin")
        along = joints[parent] - joints[parent - 1]
        along = along / max(float(np.linalg.norm(along)), 1e-12)
        reach = (own - joints[parent]) @ along
        end = own[reach >= reach.max() - 0.1 * abs(reach.max())].mean(0)
        tip = end + along * (reach.max() - (end - joints[parent]) @ along)
        tips.append(tip)
        nearest.append(int(np.linalg.norm(vertices - tip, axis=1).argmin()))
    return np.array(tips), np.array(nearest)


def side_of(hand: RiggedHand) -> Side | None:
    """The side a hand's form tells, None when it is too flat to tell.

    Fingers bend and the thumb lies towards the palm, and under the bones there is more flesh than over them.
    """
    points = hand.points
    along, across = points[4] - points[0], points[1] - points[7]
    back = np.cross(along, across)  # of a right hand; the palm of a left one
    back = back / max(float(np.linalg.norm(back)), 1e-12)
    length = max(float(np.linalg.norm(points[18] - points[0])), 1e-12)
    height = (points - points[_PALM].mean(0)) @ back / length
    flesh = (hand.vertices - points[_PALM].mean(0)) @ back / length
    cue = float(height[[14, 15, 16]].mean() + height[[17, 18, 19, 20]].mean() + np.median(flesh))
    if abs(cue) < _CLEAR:
        return None
    return "right" if cue < 0 else "left"


def to_engine(hand: RiggedHand, side: Side) -> tuple[HandModel, list[tuple[str, str]]]:
    """The hand model of a rig, and notes (code, message) about what was done to it.

    The engine's frame: metres, wrist at the origin, fingers along -x (right) or +x (left), palm towards -y,
    thumb towards +z. The fingers are turned to lie as the built-in hand's, so that zero is the flat hand and
    a pose means the same on every template. Shape parameters: see :func:`_shape_basis`.

    Raises EngineError ``template.proportions`` when it has no size.
    """
    notes: list[tuple[str, str]] = []
    reference = load_builtin(side).joint_template.double().numpy()
    length = float(np.linalg.norm(hand.points[18] - hand.points[0]))
    scale, unit = _unit(length, float(np.linalg.norm(reference[18] - reference[0])))
    if unit != "metres":
        notes.append(
            (
                "template.units",
                f"The hand is {length:.4g} long in the file: taken for {unit}, scaled by {scale:.4g}.",
            )
        )
    points = (hand.points - hand.points[0]) * scale
    vertices = (hand.vertices - hand.points[0]) * scale
    turn, _ = Rotation.align_vectors(reference[_PALM], points[_PALM])
    points, vertices = turn.apply(points), turn.apply(vertices)

    outward = 1.0 if side == "right" else -1.0
    near = vertices[:, 0] * outward <= FOREARM
    hand = keep_vertices(replace(hand, vertices=vertices, points=points), near)
    vertices, points, angle = _straighten(hand, reference)
    if angle > 10:
        notes.append(
            (
                "template.rest_pose",
                f"Its fingers were turned by up to {angle:.0f} degrees to lie flat at rest.",
            )
        )
    shape, joint_shape = _shape_basis(vertices, hand.weights, points, side)
    values = {
        "template": vertices,
        "shape_basis": shape,
        "joint_template": points,
        "joint_shape_basis": joint_shape,
        "weights": hand.weights,
    }
    tensors = {name: torch.tensor(value, dtype=torch.float32) for name, value in values.items()}
    tensors["faces"] = torch.from_numpy(np.ascontiguousarray(hand.faces))
    return HandModel.from_tensors(side, tensors), notes


def keep_vertices(hand: RiggedHand, keep: NDArray[np.bool_]) -> RiggedHand:
    """The hand without the other vertices, their faces, and vertices that are then in no face."""
    faces = hand.faces[keep[hand.faces].all(1)]
    used = np.zeros(len(hand.vertices), bool)
    used[faces] = True
    number = np.cumsum(used) - 1
    return replace(
        hand,
        vertices=hand.vertices[used],
        faces=number[faces].astype(np.int64),
        weights=hand.weights[used],
    )


def _unit(length: float, usual: float) -> tuple[float, str]:
    for name, metres in _UNITS.items():
        if HAND_LENGTHS[0] <= length * metres <= HAND_LENGTHS[1]:
            return metres, name
    if not (np.isfinite(length) and length > 1e-9):
        raise EngineError("template.proportions", "The hand has no size.", "Check the joints' positions.")
    return usual / length, "an unknown unit"


def check_proportions(points: Array) -> None:
    """A knuckle that is really a metacarpal, or a mapping gone wrong, shows in the lengths of the bones.

    ``points`` [21,3] in any unit. Raises EngineError ``template.proportions``.
    """
    reference = load_builtin("right").joint_template.double().numpy()
    own, usual = (p / max(float(np.linalg.norm(p[18] - p[0])), 1e-12) for p in (points, reference))
    for child in range(1, 16):
        parent = JOINT_PARENTS[child]
        ratio = np.linalg.norm(own[child] - own[parent]) / np.linalg.norm(usual[child] - usual[parent])
        most = 2 if child in _PALM else 4
        if not 1 / most <= ratio <= most:
            raise EngineError(
                "template.proportions",
                f"The bone from {JOINT_NAMES[parent]} to {JOINT_NAMES[child]} has {ratio:.2f} times the "
                "length it has in a hand.",
                "Check which joint has which name, or give a mapping file: gltf:FILE,joints=MAP.json.",
            )


def _straighten(hand: RiggedHand, reference: Array) -> tuple[Array, Array, float]:
    """Vertices and points with every finger bone turned into the reference's direction; degrees at most."""
    turns = np.tile(np.eye(3), (16, 1, 1))
    points = hand.points.copy()
    most = 0.0
    for chain in _CHAINS:
        turn = Rotation.identity()
        for joint, end in pairwise(chain):
            now, wanted = turn.apply(hand.points[end] - hand.points[joint]), reference[end] - reference[joint]
            step = _between(now, wanted)
            # A guessed tip tells the bone's direction no better than this.
            if end not in hand.guessed or step.magnitude() > _GUESS:
                turn = step * turn
            most = max(most, float(np.degrees(turn.magnitude())))
            turns[joint] = turn.as_matrix()
            points[end] = points[joint] + turn.apply(hand.points[end] - hand.points[joint])
    moved = np.zeros_like(hand.vertices)
    for joint in range(16):
        posed = (hand.vertices - hand.points[joint]) @ turns[joint].T + points[joint]
        moved += hand.weights[:, [joint]] * posed
    return moved, points, most


def _between(a: Array, b: Array) -> Rotation:
    """The smallest rotation that turns direction ``a`` into ``b``."""
    a, b = (v / max(float(np.linalg.norm(v)), 1e-12) for v in (a, b))
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return Rotation.identity()
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, float(a @ b)))


def _shape_basis(vertices: Array, weights: Array, points: Array, side: Side) -> tuple[Array, Array]:
    """[V,3,10] and [21,3,10]: what the built-in hand's parameters do to bone lengths, carried over.

    A rig says nothing about other hands. The first parameter scales the hand; those that move joints (palm,
    finger and thumb lengths) move them as in the built-in hand, in proportion to this hand's size, and the
    skin along each bone in between. Those of thickness alone do nothing: the personal surface is left to it.
    """
    model = load_builtin(side)
    own, usual = (float(np.linalg.norm(p[4] - p[0])) for p in (points, model.joint_template.double().numpy()))
    joint_shape = model.joint_shape_basis.double().numpy() * (own / usual)
    joint_shape[..., 0] = _SIZE_STEP * (points - points[0])
    shape = np.zeros((len(vertices), 3, 10))
    for chain in _CHAINS:
        for joint, end in pairwise(chain):
            part = _along(vertices, points[joint], points[end])[0][:, None, None]
            shift = (1 - part) * joint_shape[joint] + part * joint_shape[end]
            shape += weights[:, [joint], None] * shift
    # The palm follows the bones of the palm nearest to it.
    palm = [_along(vertices, points[0], points[first]) for first in _FIRST]
    near = np.stack([np.exp(-0.5 * (apart / (0.1 * own)) ** 2) + 1e-12 for _, apart in palm])
    near /= near.sum(0)
    for share, (part, _), first in zip(near, palm, _FIRST, strict=True):
        shift = part[:, None, None] * joint_shape[first] + (1 - part)[:, None, None] * joint_shape[0]
        shape += (weights[:, 0] * share)[:, None, None] * shift
    shape[..., 0] = _SIZE_STEP * (vertices - points[0])
    return shape, joint_shape


def _along(vertices: Array, start: Array, end: Array) -> tuple[Array, Array]:
    """Place along the segment (0 to 1) and distance from it, of each vertex."""
    step = end - start
    part = np.clip((vertices - start) @ step / max(float(step @ step), 1e-12), 0.0, 1.0)
    return part, np.linalg.norm(vertices - start - part[:, None] * step, axis=1)
