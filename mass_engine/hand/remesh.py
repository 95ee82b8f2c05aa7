"""Isotropic remeshing to triangles of a wanted size: split, collapse, flip, relax (Botsch, Kobbelt 2004)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Faces = NDArray[np.int64]
Edge = tuple[int, int]


def remesh(
    vertices: Vector,
    faces: Faces,
    size: Callable[[Vector], Vector],
    project: Callable[[Vector], Vector],
    rounds: int = 10,
) -> tuple[Vector, Faces]:
    """Even out a closed mesh: edges near ``size`` of their midpoints, vertices put back by ``project``."""
    for _ in range(rounds):
        for _ in range(3):
            vertices, faces, changed = _split(vertices, faces, size)
            if not changed:
                break
        for _ in range(6):
            vertices, faces, changed = _collapse(vertices, faces, size)
            if not changed:
                break
        for _ in range(4):
            faces, changed = _flip(vertices, faces)
            if not changed:
                break
        for _ in range(3):
            vertices = project(_relaxed(vertices, faces))
    # What the last projection brought too near to each other.
    for _ in range(6):
        vertices, faces, changed = _collapse(vertices, faces, size, short=0.75, long=2.0)
        if not changed:
            break
    for _ in range(4):
        faces, changed = _flip(vertices, faces, by_angle=True)
        if not changed:
            break
    return vertices, faces


def edge_faces(faces: Faces) -> dict[Edge, list[int]]:
    """The faces on either side of each edge (its ends in increasing order)."""
    sides: dict[Edge, list[int]] = defaultdict(list)
    for number, (a, b, c) in enumerate(faces.tolist()):
        for u, v in ((a, b), (b, c), (c, a)):
            sides[(u, v) if u < v else (v, u)].append(number)
    return sides


def _by_length(vertices: Vector, edges: list[Edge], size: Callable[[Vector], Vector]) -> Vector:
    """Length of each edge relative to the wanted one."""
    ends = np.array(edges)
    a, b = vertices[ends[:, 0]], vertices[ends[:, 1]]
    return np.asarray(np.linalg.norm(a - b, axis=1) / size((a + b) / 2))


def _split(vertices: Vector, faces: Faces, size: Callable[[Vector], Vector]) -> tuple[Vector, Faces, bool]:
    sides = edge_faces(faces)
    edges = list(sides)
    ratio = _by_length(vertices, edges, size)
    touched: set[int] = set()
    rows = faces.tolist()
    added: list[Vector] = []
    for number in np.argsort(-ratio, kind="stable"):
        if ratio[number] <= 4 / 3:
            break
        a, b = edges[number]
        if touched & set(sides[a, b]):
            continue
        touched.update(sides[a, b])
        middle = len(vertices) + len(added)
        added.append((vertices[a] + vertices[b]) / 2)
        for face in sides[a, b]:
            row = rows[face]
            rows[face] = [middle if v == a else v for v in row]
            rows.append([middle if v == b else v for v in row])
    if not added:
        return vertices, faces, False
    return np.concatenate([vertices, np.array(added)]), np.array(rows, np.int64), True


def _collapse(
    vertices: Vector,
    faces: Faces,
    size: Callable[[Vector], Vector],
    short: float = 4 / 5,
    long: float = 4 / 3,
) -> tuple[Vector, Faces, bool]:
    sides = edge_faces(faces)
    edges = list(sides)
    ratio = _by_length(vertices, edges, size)
    ring: dict[int, set[int]] = defaultdict(set)
    around: dict[int, list[int]] = defaultdict(list)
    for a, b in edges:
        ring[a].add(b)
        ring[b].add(a)
    for number, row in enumerate(faces.tolist()):
        for v in row:
            around[v].append(number)
    wanted = size(vertices)
    touched: set[int] = set()
    merged = np.arange(len(vertices))
    vertices = vertices.copy()
    for number in np.argsort(ratio, kind="stable"):
        if ratio[number] >= short:
            break
        a, b = edges[number]
        near = ring[a] | ring[b]
        # Two common neighbours exactly, else the surface would pinch; nothing touched in this pass.
        if near & touched or len(ring[a] & ring[b]) != 2 or len(near) - 4 < 3:
            continue
        middle = (vertices[a] + vertices[b]) / 2
        others = list(near - {a, b})
        if (np.linalg.norm(vertices[others] - middle, axis=1) > long * wanted[others]).any():
            continue
        kept = [f for f in {*around[a], *around[b]} if f not in sides[a, b]]
        before = vertices[faces[kept]]
        after = np.where(np.isin(faces[kept], (a, b))[..., None], middle, before)
        if _turned(before, after):
            continue
        vertices[a] = middle
        merged[b] = a
        touched |= near
    rows = merged[faces]
    alive = (rows[:, 0] != rows[:, 1]) & (rows[:, 1] != rows[:, 2]) & (rows[:, 2] != rows[:, 0])
    if alive.all():
        return vertices, faces, False
    used, flat = np.unique(rows[alive], return_inverse=True)
    return vertices[used], flat.reshape(-1, 3).astype(np.int64), True


def _normals(corners: Vector) -> Vector:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30))


def _turned(before: Vector, after: Vector) -> bool:
    """Whether any triangle turns by more than about 60 degrees."""
    return bool(((_normals(before) * _normals(after)).sum(1) < 0.5).any())


def _flip(vertices: Vector, faces: Faces, by_angle: bool = False) -> tuple[Faces, bool]:
    """Turn edges so that more vertices have six neighbours, or so that the angles across become less wide."""
    sides = edge_faces(faces)
    degree = np.bincount(faces.ravel(), minlength=len(vertices))
    rows = faces.copy()
    touched: set[int] = set()
    made: set[Edge] = set()
    changed = False
    for (a, b), pair in sides.items():
        if len(pair) != 2 or touched & set(pair):
            continue
        one, two = (rows[f].tolist() for f in pair)
        c = next(v for v in one if v not in (a, b))
        d = next(v for v in two if v not in (a, b))
        across = (c, d) if c < d else (d, c)
        if across in sides or across in made:
            continue
        if by_angle and _angle(vertices, c, a, b) + _angle(vertices, d, a, b) < np.pi * 1.05:
            continue
        old = sum((degree[v] - 6) ** 2 for v in (a, b, c, d))
        new = sum((degree[v] - 7) ** 2 for v in (a, b)) + sum((degree[v] - 5) ** 2 for v in (c, d))
        if (new >= old and not by_angle) or degree[a] <= 4 or degree[b] <= 4:
            continue
        # Keep the winding: walk from a to b in the first face.
        if one[(one.index(a) + 1) % 3] != b:
            a, b = b, a
        fresh = np.array([[a, d, c], [d, b, c]])
        if _turned(vertices[[one, two]], vertices[fresh]):
            continue
        rows[pair[0]], rows[pair[1]] = fresh
        degree[[a, b]] -= 1
        degree[[c, d]] += 1
        # Edges of these faces now have other neighbours: leave them for the next pass.
        touched.update(pair)
        changed = True
        made.add(across)
    return rows, changed


def _angle(vertices: Vector, at: int, a: int, b: int) -> float:
    """The angle (radians) at one vertex between two others."""
    u, v = vertices[a] - vertices[at], vertices[b] - vertices[at]
    return float(np.arccos(np.clip(u @ v / np.sqrt((u @ u) * (v @ v)), -1.0, 1.0)))


def _relaxed(vertices: Vector, faces: Faces) -> Vector:
    """Each vertex moved in its tangent plane towards the mean of its faces' centres, by area."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) ** 0.5
    total, weight, normal = np.zeros_like(vertices), np.zeros(len(vertices)), np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(total, faces[:, corner], corners.mean(1) * area[:, None])
        np.add.at(weight, faces[:, corner], area)
        np.add.at(normal, faces[:, corner], cross)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    pull = total / weight[:, None] - vertices
    return np.asarray(vertices + 0.6 * (pull - normal * (pull * normal).sum(1, keepdims=True)))
