"""The hand's soft tissue as one smooth distance field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mass_engine.hand.anatomy import STUMP, Nail, Tissue, Vector

#: How far the cut edge is rounded (metres).
_CUT = 0.012
#: Width (metres) of the step at a nail's rim.
_RIM = 0.0008


def smooth_union(a: Vector, b: Vector, width: float) -> Vector:
    """The polynomial smooth minimum of two distances."""
    mix = np.clip(0.5 + 0.5 * (b - a) / width, 0.0, 1.0)
    return np.asarray(b * (1 - mix) + a * mix - width * mix * (1 - mix))


def tissue_distance(points: Vector, tissue: Tissue) -> Vector:
    """Approximate distance [P] of ``points`` [P,3] to one tissue, negative inside.

    Each point meets the cross-section at its place on the line; an ellipse of different heights to either
    side, closed by half ellipsoids at the ends. First-order exact at the surface.
    """
    line, sections = tissue.line, tissue.sections
    best = np.full(len(points), np.inf)
    offset, section = np.zeros_like(points), np.zeros_like(points)
    for k in range(len(line) - 1):
        step = line[k + 1] - line[k]
        place = np.clip((points - line[k]) @ step / (step @ step), 0.0, 1.0)[:, None]
        from_line = points - line[k] - place * step
        apart = (from_line * from_line).sum(1)
        nearer = apart < best
        # Cubic easing keeps the profile smooth across the sections.
        eased = place * place * (3 - 2 * place) * 0.5 + place * 0.5
        offset = np.where(nearer[:, None], from_line, offset)
        section = np.where(nearer[:, None], sections[k] + eased * (sections[k + 1] - sections[k]), section)
        best = np.where(nearer, apart, best)
    along = line[-1] - line[0]
    along = along / np.linalg.norm(along)
    back = tissue.back - along * (tissue.back @ along)
    back /= np.linalg.norm(back)
    side = np.cross(along, back)
    x, y, z = offset @ along, offset @ side, offset @ back
    height = section[:, 2] + (section[:, 1] - section[:, 2]) / (1 + np.exp(-6 * z / section[:, 1]))
    ends = np.where(x < 0, tissue.tip if tissue.root is None else tissue.root, tissue.tip)
    sizes = np.stack([ends, section[:, 0], height], 1)
    scaled = np.stack([x, y, z], 1) / sizes
    length = np.linalg.norm(scaled, axis=1)
    slope = np.linalg.norm(scaled / sizes, axis=1)
    inner = -np.minimum(section[:, 0], height)
    apart = np.where(length > 1e-3, length * (length - 1) / np.maximum(slope, 1e-9), inner)
    return np.asarray(apart if tissue.nail is None else apart - nail_relief(points, tissue.nail))


def nail_distance(points: Vector, nail: Nail) -> Vector:
    """About how far [P] (metres) ``points`` [P,3] lie outside the nail's outline; the other side is far."""
    s, t, up = _on_nail(points, nail)
    rim = ((s**4 + t**4) ** 0.25 - 1) * nail.breadth
    return np.asarray(np.hypot(np.maximum(rim, 0.0), np.maximum(0.0, -up - 0.001) * 3))


def nail_relief(points: Vector, nail: Nail) -> Vector:
    """Height [P] (metres) of the plate over the skin at ``points`` [P,3], negative in the fold around it."""
    s, t, up = _on_nail(points, nail)
    # Distance to the outline, a rounded rectangle.
    rim = ((s**4 + t**4) ** 0.25 - 1) * nail.breadth
    plate = 1 / (1 + np.exp(np.clip((rim - _RIM) / (0.35 * _RIM), -40, 40)))
    # The fold runs round three sides; the end is free.
    fold = np.exp(-(((rim - 2.8 * _RIM) / (2.2 * _RIM)) ** 2)) / (1 + np.exp(np.clip(8 * (s - 0.5), -40, 40)))
    above = 1 / (1 + np.exp(np.clip(-up / 0.0006, -40, 40)))
    return np.asarray(nail.height * (plate - 0.3 * fold * (1 - plate)) * above)


def to_outline(points: Vector, nail: Nail) -> Vector:
    """``points`` [P,3] with those near the nail's outline moved onto it, so that edges run along it."""
    s, t, up = _on_nail(points, nail)
    out = np.maximum((s**4 + t**4) ** 0.25, 1e-6)
    near = (np.abs(out - 1) * nail.breadth < 1.3 * _RIM) & (up > 0)
    change = np.where(near, 1 / out - 1, 0.0)
    return np.asarray(
        points
        + np.outer(change * s, nail.along) * nail.length
        + np.outer(change * t, nail.across) * nail.breadth
    )


def _on_nail(points: Vector, nail: Nail) -> tuple[Vector, Vector, Vector]:
    """Place along and across the nail, its ends at -1 and 1, and height (metres) over the bone."""
    offset = points - nail.middle
    up = offset @ np.cross(nail.across, nail.along)
    return offset @ nail.along / nail.length, offset @ nail.across / nail.breadth, up


def distance_field(points: Vector, tissues: Sequence[Tissue]) -> Vector:
    """Distance [P] of ``points`` [P,3] to the hand, negative inside, in metres."""
    palm: Vector | None = None
    for part in tissues:
        if part.group == "palm":
            here = tissue_distance(points, part)
            palm = here if palm is None else smooth_union(palm, here, part.blend)
    assert palm is not None, "a hand has a palm"
    for part in tissues:
        if part.group in ("wrist", "web"):
            palm = smooth_union(palm, tissue_distance(points, part), part.blend)
    hand = palm
    for part in tissues:
        if part.group not in ("palm", "wrist", "web"):
            digit = smooth_union(palm, tissue_distance(points, part), part.blend)
            hand = np.minimum(hand, digit)
    # Cut the forearm off, with a rounded edge.
    return -smooth_union(-hand, STUMP - points[:, 0], _CUT)


def field_gradient(points: Vector, tissues: Sequence[Tissue], step: float = 2e-4) -> Vector:
    """Gradient [P,3] of the field by central differences."""
    columns = []
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        columns.append(distance_field(points + shift, tissues) - distance_field(points - shift, tissues))
    return np.stack(columns, -1) / (2 * step)


def project(
    points: Vector, tissues: Sequence[Tissue], target: Vector | float = 0.0, steps: int = 3
) -> Vector:
    """Move ``points`` along the gradient until the field there is ``target`` (Newton)."""
    for _ in range(steps):
        slope = field_gradient(points, tissues)
        square = np.maximum((slope * slope).sum(1), 0.25)
        miss = distance_field(points, tissues) - target
        move = slope * np.clip(miss / square, -0.004, 0.004)[:, None]
        points = points - move
    return points
