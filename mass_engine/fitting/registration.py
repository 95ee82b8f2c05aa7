"""Registration: poses, shape and personal surface by Gauss-Newton on outline and texture.

Every frame is compared with a render of the present hand. Along the rim the outlines' signed distances
differ by what the surface has to move; inside, the texture's offset is a Lucas-Kanade step (Lucas and Kanade
1981; symmetric in both pictures). Both are quadratic in the motion of the vertices in the picture, so one
render gives a whole linear system for the pose, where gradient descent needs hundreds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.fitting.kinematics import POSE_SIZE, PoseJacobian
from mass_engine.fitting.views import Level
from mass_engine.raster import RenderOutput

#: Most points of an uncovered outline that are looked at.
_UNCOVERED = 128

Image = NDArray[np.float32]


@dataclass(frozen=True)
class RegistrationWeights:
    """What an observation is worth. Pixels are those of the level the frame is compared at."""

    rim: float = 1.0  # standard deviation of an outline, pixels
    rim_bias: float = 0.0  # how far the surface is to stand over the outline, pixels
    rim_reach: float = 12.0  # an outline farther off than this is another finger's
    huber: float = 3.0  # from here on an outline's error counts linearly, pixels
    texture: float = 0.03  # standard deviation of a high-passed grey value
    robust: float = 0.06  # a grey value off by this has half its weight
    high_pass: float = 9.0  # standard deviation of the blur that is taken off, pixels


@dataclass(frozen=True)
class Evidence2D:
    """How each vertex wants to move in the picture: the quadratic form d^T H d - 2 g^T d per vertex.

    ``hessian`` [V,3] (xx, xy, yy) and ``gradient`` [V,2], in pixels of the level. ``pixels`` [V,2] is where
    the vertices are, ``seen`` [V] which of them face the camera with nothing before them.
    """

    hessian: Tensor
    gradient: Tensor
    pixels: Tensor
    seen: Tensor


def observe(
    level: Level, out: RenderOutput, vertices: Tensor, normals: Tensor, weights: RegistrationWeights, texture: bool
) -> Evidence2D:
    """What one frame says of the ``vertices`` [V,3] (world, with outward ``normals``) drawn as ``out``."""
    camera = level.camera
    rotation = camera.world_to_camera[:3, :3]
    at = vertices @ rotation.T + camera.world_to_camera[:3, 3]
    pixels = (at[:, :2] / at[:, 2:].clamp_min(1e-3)) @ camera.K[:2, :2].T + camera.K[:2, 2]
    facing = -(normals @ rotation.T * torch.nn.functional.normalize(at, dim=-1)).sum(-1)
    xy = (pixels - 0.5).numpy().astype(np.float32)
    alpha = out.alpha.numpy()
    depth = _sample(out.depth.numpy(), xy, cv2.INTER_NEAREST)
    size = float(vertices.amax(0).sub(vertices.amin(0)).norm())
    seen = at[:, 2].numpy() < depth + 0.03 * size
    hessian = np.zeros((len(vertices), 3), np.float32)
    gradient = np.zeros((len(vertices), 2), np.float32)
    _rim(level, alpha, xy, seen, facing.numpy(), weights, hessian, gradient)
    if texture:
        _texture(level, out, xy, seen & (facing.numpy() > 0.15), weights, hessian, gradient)
    clear = torch.from_numpy(seen) & (facing > 0.3)
    return Evidence2D(torch.from_numpy(hessian), torch.from_numpy(gradient), pixels, clear)


def _rim(
    level: Level,
    alpha: Image,
    xy: Image,
    seen: NDArray[np.bool_],
    facing: Image,
    weights: RegistrationWeights,
    hessian: Image,
    gradient: Image,
) -> None:
    """Vertices at the render's outline go to the mask's."""
    free = _free(level)
    here, there = signed_distance(alpha), signed_distance(level.hand.numpy())
    inner = _sample(here, xy)
    picked = np.nonzero((np.abs(inner) < 2.5) & (np.abs(facing) < 0.45) & seen & (_sample(free, xy) > 0.9))[0]
    if len(picked) == 0:
        return
    at = xy[picked]
    smooth_here, smooth_there = (cv2.GaussianBlur(d, (0, 0), 1.5) for d in (here, there))
    n, m = _direction(smooth_there, at), _direction(smooth_here, at)
    apart = inner[picked] - _sample(there, at) - weights.rim_bias
    agree = (n * m).sum(-1)
    good = (agree > 0.5) & (np.abs(apart) < weights.rim_reach)
    weight = agree * np.where(np.abs(apart) < weights.huber, 1.0, weights.huber / np.maximum(np.abs(apart), 1e-3))
    weight *= good / weights.rim**2
    # Each pixel of the outline counts once, however many vertices are near it.
    length = float(((alpha > 0.5) & (np.abs(here) < 1.0) & (free > 0.5)).sum())
    weight *= length / max(float(good.sum()), 1.0)
    hessian[picked] += weight[:, None] * np.stack([n[:, 0] ** 2, n[:, 0] * n[:, 1], n[:, 1] ** 2], -1)
    gradient[picked] += (weight * apart)[:, None] * n


def _texture(
    level: Level,
    out: RenderOutput,
    xy: Image,
    seen: NDArray[np.bool_],
    weights: RegistrationWeights,
    hessian: Image,
    gradient: Image,
) -> None:
    """The Lucas-Kanade step of every visible vertex's surroundings."""
    inside = ((out.alpha.numpy() > 0.95) & (level.hand.numpy() > 0.95) & (level.colored.numpy() > 0.95)).astype(np.float32)
    inside = cv2.erode(inside, np.ones((3, 3), np.uint8))
    if inside.sum() < 50:
        return
    real = _high_pass(level.rgb.mean(-1).numpy(), inside, weights.high_pass)
    drawn = _high_pass(out.rgb.mean(-1).numpy(), inside, weights.high_pass)
    core = cv2.erode(inside, np.ones((3, 3), np.uint8))
    both = 0.5 * (real + drawn)
    gx = cv2.Sobel(both, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gy = cv2.Sobel(both, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    apart = drawn - real
    weight = core / (1 + (apart / weights.robust) ** 2) / weights.texture**2
    planes = np.stack(
        [weight * gx * gx, weight * gx * gy, weight * gy * gy, weight * gx * apart, weight * gy * apart], -1
    )
    planes = cv2.boxFilter(np.ascontiguousarray(planes[..., :4]), -1, (9, 9)), cv2.boxFilter(planes[..., 4], -1, (9, 9))
    picked = np.nonzero(seen & (_sample(core, xy) > 0.5))[0]
    if len(picked) == 0:
        return
    share = float(core.sum()) / len(picked)
    first, last = _sample(planes[0], xy[picked]), _sample(planes[1], xy[picked])
    hessian[picked] += share * first[:, :3]
    gradient[picked] += share * np.stack([first[:, 3], last], -1)


def observe_far(level: Level, alpha: Tensor, pixels: Tensor, weights: RegistrationWeights) -> tuple[Tensor, Tensor]:
    """What lies far off, for a pose only: ``hessian`` [V,3] and ``gradient`` [V,2] as in Evidence2D.

    Outline of the mask that the render stays away from draws its nearest vertex, seen or not; vertices out
    in the background are drawn back to the mask. The surface is not to grow for a finger that is misplaced.
    """
    xy = (pixels - 0.5).numpy().astype(np.float32)
    free = _free(level)
    here, there = signed_distance(alpha.numpy()), signed_distance(level.hand.numpy())
    hessian, gradient = np.zeros((len(xy), 3), np.float32), np.zeros((len(xy), 2), np.float32)
    rows, columns = np.nonzero((np.abs(there) < 1.0) & (here < -weights.huber) & (free > 0.5))
    if len(rows) > 0:
        every = 1 + len(rows) // _UNCOVERED
        points = np.stack([columns, rows], -1)[::every].astype(np.float32)
        nearest = np.square(points[:, None] - xy[None]).sum(-1).argmin(1)
        apart = points - xy[nearest]
        weight = every * weights.huber / np.maximum(np.linalg.norm(apart, axis=-1), weights.huber) / weights.rim**2
        np.add.at(hessian, nearest, weight[:, None] * np.array([1.0, 0.0, 1.0], np.float32))
        np.add.at(gradient, nearest, weight[:, None] * apart)
    out = -_sample(there, xy)
    lost = np.nonzero((out > weights.huber) & (_sample(free, xy) > 0.9))[0]
    if len(lost) > 0:
        n = _direction(cv2.GaussianBlur(there, (0, 0), 1.5), xy[lost])
        size = float((level.hand > 0.5).sum()) / len(xy)  # pixels a vertex stands for
        weight = size * weights.huber / out[lost] / weights.rim**2
        hessian[lost] += weight[:, None] * np.stack([n[:, 0] ** 2, n[:, 0] * n[:, 1], n[:, 1] ** 2], -1)
        gradient[lost] += (weight * out[lost])[:, None] * n
    return torch.from_numpy(hessian), torch.from_numpy(gradient)


def overlap(level: Level, alpha: Tensor) -> float:
    """Intersection over union of the render's silhouette and the mask, ignored pixels left out."""
    drawn, hand = (alpha > 0.5) & (level.valid > 0.5), (level.hand > 0.5) & (level.valid > 0.5)
    return float((drawn & hand).sum()) / max(float((drawn | hand).sum()), 1.0)


def project_jacobian(level: Level, vertices: Tensor) -> Tensor:
    """d pixels / d world position [V,2,3] of a level's camera."""
    camera = level.camera
    rotation = camera.world_to_camera[:3, :3]
    at = vertices @ rotation.T + camera.world_to_camera[:3, 3]
    z = at[:, 2].clamp_min(1e-3)
    rows = torch.zeros(len(at), 2, 3)
    rows[:, 0, 0] = 1 / z
    rows[:, 1, 1] = 1 / z
    rows[:, :, 2] = -at[:, :2] / (z * z).unsqueeze(-1)
    return camera.K[:2, :2] @ rows @ rotation


def normal_equations(hessian: Tensor, gradient: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """``jacobian`` [V,2,P] of pixels -> the matrix [P,P] and the right side [P] of the Gauss-Newton step."""
    used = (hessian[:, 0] + hessian[:, 2]) > 0
    j = jacobian[used]
    weighted = matrices(hessian[used]) @ j
    flat = j.flatten(0, 1)
    return (flat.T @ weighted.flatten(0, 1)).double(), (flat.T @ gradient[used].flatten()).double()


def matrices(hessian: Tensor) -> Tensor:
    """[V,3] (xx, xy, yy) as [V,2,2]."""
    xx, xy, yy = hessian.unbind(-1)
    return torch.stack([xx, xy, xy, yy], -1).unflatten(-1, (2, 2))


def signed_distance(coverage: Image) -> Image:
    """Pixels to the half-covered outline, positive inside; sub-pixel next to the outline."""
    inside = (coverage > 0.5).astype(np.uint8)
    far = float(sum(coverage.shape))
    if inside.min() == inside.max():
        return np.full(coverage.shape, far if inside.max() else -far, np.float32)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    # A pixel next to the outline is half a pixel from it on average, not one.
    return np.asarray(distance - 0.5 * np.sign(distance), np.float32)


def _free(level: Level) -> Image:
    """One where an outline is the hand's own: away from ignored pixels and the picture's border."""
    free = np.asarray(cv2.erode(level.valid.numpy(), np.ones((7, 7), np.uint8)), np.float32)
    free[:2], free[-2:], free[:, :2], free[:, -2:] = 0, 0, 0, 0
    return free


def _high_pass(grey: Image, inside: Image, sigma: float) -> Image:
    """What stands out from the surroundings inside the hand."""
    blurred = cv2.GaussianBlur(grey * inside, (0, 0), sigma) / np.maximum(
        cv2.GaussianBlur(inside, (0, 0), sigma), 1e-3
    )
    return np.asarray(cv2.GaussianBlur((grey - blurred) * inside, (0, 0), 0.8), np.float32)


def _sample(image: Image, xy: Image, how: int = cv2.INTER_LINEAR) -> Image:
    """Values at points [P,2] (pixel centres at whole numbers); 0 outside."""
    columns = cv2.remap(image, xy[:, None, 0], xy[:, None, 1], how, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(columns[:, 0], np.float32)


def _direction(distance: Image, xy: Image) -> Image:
    """Unit gradient [P,2] of a distance map at points."""
    step = np.array([[1.0, 0.0], [0.0, 1.0]], np.float32)
    rows = [_sample(distance, xy + s) - _sample(distance, xy - s) for s in step]
    gradient = np.stack(rows, -1)
    return np.asarray(gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-6), np.float32)
