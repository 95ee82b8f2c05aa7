"""How the skin changes when a joint bends: computed from the soft tissue, stored as two shapes a joint.

Plain skinning averages positions: across a bent joint the skin comes nearer to it (the candy wrapper), and on
the inside it sinks into itself. Here the tissue is cut at the joint into two solids with round ends, one of
them is turned, and the skinned vertices are moved onto the union of the two as far out as they lay at rest
(the idea of Vaillant et al. 2013, "Implicit skinning: real-time skin deformation with contact modeling"): the
back stays round, the inside folds and keeps its flesh. At run time it is linear in sin(a) and 1 - cos(a).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mass_engine.hand.anatomy import DIGITS, FIRST_JOINT, Tissue, Vector, digit_line
from mass_engine.hand.field import distance_field, smooth_union, tissue_distance
from mass_engine.hand.skinning import Faces, back_of, neighbour_mean
from mass_engine.surfel.subdivision import loop_subdivision

#: Bends (degrees) the two shapes are fitted to, and how much each counts.
_BENDS, _COUNTS = (30.0, 60.0, 90.0, 110.0), (1.0, 1.0, 2.0, 1.0)
#: Length of the round ends at a cut, per height of the back.
_CAP = 1.1
#: How widely (metres) the two solids blend: at a knuckle, at a joint between segments.
_CREASES = (0.006, 0.0025)
#: Up to where (metres from the joint) the skin changes, and over what width it fades.
_REACH, _FADE = 0.027, 0.010
_STEPS, _SMOOTHING = 12, 1
_Field = Callable[[Vector], Vector]


def bend_shapes(
    vertices: Vector, cage: Vector, faces: Faces, points: Vector, weights: Vector, tissues: Sequence[Tissue]
) -> Vector:
    """Change of the rest vertices [V,3,15,2] per unit of sin(a) and of 1 - cos(a) of each joint's flexion.

    ``vertices`` [V,3] lie on the skin, ``cage`` [V,3] is what subdivides to it and is changed. The root of
    the thumb moves so much of the palm so little that plain skinning serves it.
    """
    average = neighbour_mean(faces, len(vertices))
    twice = loop_subdivision(torch.from_numpy(faces), len(vertices), 2)
    shapes = np.zeros((len(vertices), 3, 15, 2))
    angles = np.radians(_BENDS)
    wanted = np.sqrt(_COUNTS)[:, None] * np.stack([np.sin(angles), 1 - np.cos(angles)], 1)
    # A little ridge keeps the two from growing against each other.
    of_changes = np.linalg.solve(wanted.T @ wanted + 0.01 * np.eye(2), wanted.T * np.sqrt(_COUNTS))
    for digit in DIGITS:
        line, first = digit_line(points, digit), FIRST_JOINT[digit]
        back = back_of(digit, line)
        for k in range(1 if digit == "thumb" else 0, 3):
            along = (line[k + 1] - line[k]) / np.linalg.norm(line[k + 1] - line[k])
            axis = np.cross(back, along)
            axis /= np.linalg.norm(axis)
            moved = weights[:, first + k : first + 3].sum(1)
            before = weights[:, first + k - 1] if k else weights[:, 0]
            fades = np.clip((_REACH - np.linalg.norm(vertices - line[k], axis=1)) / _FADE, 0.0, 1.0)
            # Skin that other fingers move as well is left to them by that much.
            share = ((moved + before) * fades * fades * (3 - 2 * fades))[:, None]
            chosen = np.flatnonzero(share > 0)
            solids = _solids(tissues, digit, line[k], k)
            changes = []
            for angle in angles:
                turn = Rotation.from_rotvec(axis * angle).as_matrix()
                blend = (1 - moved)[:, None, None] * np.eye(3) + moved[:, None, None] * turn
                skin, start = (
                    line[k] + np.einsum("pij,pj->pi", blend, rest - line[k]) for rest in (vertices, cage)
                )
                change = np.zeros_like(vertices)
                change[chosen] = _onto_turned(
                    vertices[chosen], skin[chosen], line[k], turn, solids, _CREASES[min(k, 1)]
                )
                change *= share
                for _ in range(_SMOOTHING):
                    change = 0.5 * change + 0.5 * (average @ change)
                # The subdivided cage, not the cage, shall lie there.
                bent = start + change
                for _ in range(4):
                    smooth = twice.apply(torch.from_numpy(bent).float()).double().numpy()[: len(bent)]
                    bent = bent + 0.7 * share * (skin + change - smooth)
                changes.append(np.linalg.solve(blend, (bent - start)[..., None])[..., 0])
            shapes[:, :, first + k - 1] = np.einsum("sa,avx->vxs", of_changes, np.stack(changes))
    return shapes


def _solids(tissues: Sequence[Tissue], digit: str, joint: Vector, k: int) -> tuple[_Field, _Field]:
    """Fields of what lies before the digit's ``k``-th joint and of what lies beyond it."""
    whole = next(part for part in tissues if part.group == digit)
    if k == 0:
        palm = [part for part in tissues if part.group not in DIGITS]
        return lambda p: distance_field(p, palm), lambda p: tissue_distance(p, whole)
    cut = int(np.linalg.norm(whole.line - joint, axis=1).argmin())
    cap = _CAP * float(whole.sections[cut, 1])
    before = replace(
        whole, line=whole.line[: cut + 1], sections=whole.sections[: cut + 1], tip=cap, nail=None
    )
    before = replace(before, root=whole.tip)
    beyond = replace(whole, line=whole.line[cut:], sections=whole.sections[cut:], root=cap)
    return lambda p: tissue_distance(p, before), lambda p: tissue_distance(p, beyond)


def _onto_turned(
    rest: Vector, skin: Vector, joint: Vector, turn: Vector, solids: tuple[_Field, _Field], width: float
) -> Vector:
    """What moves points ``skin`` [P,3] as far out of the turned tissue as they lay at ``rest`` [P,3]."""
    near, far = solids

    def bent(p: Vector) -> Vector:
        return smooth_union(near(p), far((p - joint) @ turn + joint), width)

    height = smooth_union(near(rest), far(rest), width)
    here, step = skin, 2e-5
    for _ in range(_STEPS):
        value = bent(here)
        slope = np.stack([bent(here + shift) - value for shift in step * np.eye(3)], 1) / step
        square = np.maximum((slope * slope).sum(1), 0.25)
        miss = np.clip(0.7 * (value - height) / square, -0.0015, 0.0015)
        here = here - slope * miss[:, None]
    return here - skin
