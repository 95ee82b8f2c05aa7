"""Geometric losses of the fit: what keeps deformed surfels on the hand, in one layer and along the surface.

One function each. Distances are metres, images [h,w], masks in 0..1, ``area`` is the hand's pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mass_engine.raster import RasterOptions


def binding_paper(means: Tensor, normals: Tensor, triangles: Tensor, delta: float) -> Tensor:
    """sum_i max(d_i, delta) (1 - n_i . n_f): the paper's L_b as printed (scalar, metres).

    ``means`` and ``normals`` [...,3] of deformed surfels, ``triangles`` [...,3 corners,3] of the mesh faces
    they belong to; d_i is the distance from the surfel's centroid to its face, n_f the face's normal. A
    surfel whose normal is aligned pays nothing at any distance: ``binding_additive`` has no such gap.
    """
    distance = triangle_distance(means, triangles)
    return (distance.clamp_min(delta) * (1 - (normals * face_normals(triangles)).sum(-1))).sum()


def binding_additive(
    means: Tensor,
    normals: Tensor,
    triangles: Tensor,
    delta: float,
    distance_weight: float = 1.0,
    normal_weight: float = 1.0,
) -> Tensor:
    """mean_i [w_d max(d_i - delta, 0) / delta + w_n (1 - n_i . n_f)] (scalar, no unit); as ``binding_paper``.

    Being far from the face costs something whatever the normal, and the normal whatever the distance.
    """
    beyond = (triangle_distance(means, triangles) / delta - 1).clamp_min(0)
    misaligned = 1 - (normals * face_normals(triangles)).sum(-1)
    return (distance_weight * beyond + normal_weight * misaligned).mean()


def face_normals(triangles: Tensor) -> Tensor:
    """Unit normals [...,3] of ``triangles`` [...,3 corners,3], counter-clockwise seen from outside."""
    a, b, c = triangles.unbind(-2)
    across = torch.linalg.cross(b - a, c - a)
    unit: Tensor = across / (across.square().sum(-1, keepdim=True) + 1e-30).sqrt()
    return unit


def triangle_distance(points: Tensor, triangles: Tensor) -> Tensor:
    """Distance [...] in metres from ``points`` [...,3] to ``triangles`` [...,3 corners,3], solid ones.

    At zero it has the gradient 0.
    """
    # The nearest point minimises the distance, so its place in the triangle needs no gradient of its own.
    with torch.no_grad():
        places = _nearest_places(points, triangles)
    away = points - (places.unsqueeze(-1) * triangles).sum(-2)
    squared = away.square().sum(-1)
    touching = squared <= 1e-20
    return torch.where(touching, torch.zeros_like(squared), torch.where(touching, 1.0, squared).sqrt())


def _nearest_places(points: Tensor, triangles: Tensor) -> Tensor:
    """Barycentric coordinates [...,3] of the point of each triangle that is nearest to ``points``."""
    p = points.movedim(-1, 0).contiguous()
    corners = triangles.movedim((-2, -1), (0, 1)).contiguous()

    def dot(u: Tensor, v: Tensor) -> Tensor:
        return (u * v).sum(0)

    ab, ac, ap = corners[1] - corners[0], corners[2] - corners[0], p - corners[0]
    bb, bc, cc, pb, pc = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ap, ab), dot(ap, ac)
    least = 1e-30
    scale = (bb * cc - bc * bc).clamp_min(least)
    u, v = (cc * pb - bc * pc) / scale, (bb * pc - bc * pb) / scale
    places = torch.stack([1 - u - v, u, v])
    best = torch.where((places >= 0).all(0), torch.zeros_like(u), torch.full_like(u, torch.inf))
    # Feet on the three lines through the corners, kept within the edges.
    for start in range(3):
        end = (start + 1) % 3
        edge, off = corners[end] - corners[start], p - corners[start]
        along = (dot(off, edge) / dot(edge, edge).clamp_min(least)).clamp(0, 1)
        distance = (off - along * edge).square().sum(0)
        place = torch.zeros_like(places)
        place[start], place[end] = 1 - along, along
        nearer = distance < best
        best = torch.where(nearer, distance, best)
        places = torch.where(nearer, place, places)
    return places.movedim(0, -1)


def depth_distortion(
    distortion: Tensor, valid: Tensor, area: Tensor, options: RasterOptions, depth: Tensor, size: float
) -> Tensor:
    """Mean over the hand of sum_ij w_i w_j ((z_i - z_j) / size)^2 (scalar): 2DGS's L_d without its scale.

    ``distortion`` [h,w] is the rasteriser's, made with ``options``, of the depths m = a - b / z. Around the
    hand's ``depth`` Z (scalar, metres; no gradient) m_i - m_j = b (z_i - z_j) / Z^2 to first order; here that
    slope is divided out and ``size`` (the hand's, metres) made the unit. The same hand costs the same
    before any camera, near or virtual, and with any ``distortion_range``.
    """
    unit = depth.detach().square() / (options.distortion_scale * size)
    return (distortion * valid).sum() * unit.square() / area


def depth_distortion_paper(distortion: Tensor, valid: Tensor) -> Tensor:
    """2DGS's L_d (eq. 13) as its code has it: the rasteriser's distortion [h,w], mean over the valid pixels.

    Its value lives on the scale of ``RasterOptions.distortion_range``: with a range of 0.2 to 100 and a hand
    far away it is numerically dead.
    """
    return (distortion * valid).sum() / valid.sum().clamp_min(1.0)


def normal_consistency(
    depth: Tensor,
    normal: Tensor,
    alpha: Tensor,
    K: Tensor,
    valid: Tensor,
    area: Tensor,
    K_inverse: Tensor | None = None,
) -> Tensor:
    """sum_p (1 - N_p . n_p) / area (scalar): 2DGS's L_n (eq. 14).

    N is the rendered ``normal`` [h,w,3] (camera coordinates, sum of w n), n the normal of the surface that
    ``depth`` [h,w] describes (central differences of its points, towards the camera), times ``alpha`` [h,w]
    without gradient. ``K`` [3,3]. Only pixels count whose four neighbours show the surface too: across an
    outline, or the picture's border, differences mean nothing. ``K_inverse``: that of ``K``, if it is known.
    """
    surface = depth_normals(depth, K, K_inverse)
    shown = (alpha.detach() > 0.5) & (depth.detach() > 0)
    whole = torch.zeros_like(shown)
    whole[1:-1, 1:-1] = (
        shown[1:-1, 1:-1] & shown[:-2, 1:-1] & shown[2:, 1:-1] & shown[1:-1, :-2] & shown[1:-1, 2:]
    )
    agreement = (normal * surface * alpha.detach().unsqueeze(-1)).sum(-1)
    return (torch.where(whole, 1 - agreement, torch.zeros_like(agreement)) * valid).sum() / area


def depth_normals(depth: Tensor, K: Tensor, K_inverse: Tensor | None = None) -> Tensor:
    """Unit normals [h,w,3] towards the camera of the surface of ``depth`` [h,w], zero on the border."""
    height, width = depth.shape
    x = torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5
    y = torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5
    pixels = torch.stack(
        [x.expand(height, width), y[:, None].expand(height, width), torch.ones_like(depth)], -1
    )
    inverse = torch.linalg.inv(K) if K_inverse is None else K_inverse
    points = (pixels @ inverse.T.to(depth)) * depth.unsqueeze(-1)
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    across = torch.linalg.cross(down, right)
    inner = across / (across.square().sum(-1, keepdim=True) + 1e-30).sqrt()
    return torch.nn.functional.pad(inner, (0, 0, 1, 1, 1, 1))
