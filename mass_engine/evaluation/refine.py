"""Test-time pose refinement: the pose under which a finished hand looks most like one held-out frame.

What is scored after it is a *second* figure, never the held-out one: the frame's own colours took part. It
tells errors of the pose from errors of the hand. Nothing but the pose of the frame is changed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import torch
from torch import Tensor

from mass_engine.evaluation.scores import Renderable
from mass_engine.fitting.kinematics import turned
from mass_engine.fitting.views import View
from mass_engine.hand.pose import HandPose
from mass_engine.threads import one_thread

#: Numbers of a step: 16 rotations and a shift.
_SIZE = 51


@dataclass(frozen=True)
class RefineOptions:
    """Levenberg-Marquardt with ``steps`` at each of the ``sides`` (longer side of the crop, pixels).

    ``prior``: standard deviations of the whole way from the given pose: wrist and fingers in radians, and
    the shift in metres. ``robust``: a colour off by this counts less. ``noise``: a colour's standard
    deviation times the root of how many neighbouring pixels err together.
    """

    sides: tuple[int, ...] = (128, 256)
    steps: int = 4
    prior: tuple[float, float, float] = (0.2, 0.3, 0.03)
    robust: float = 0.3
    noise: float = 0.3
    silhouette: float = 1.0


def refine_pose(
    subject: Renderable, view: View, pose: HandPose, options: RefineOptions | None = None
) -> HandPose:
    """``pose`` (a batch of one) moved so that its render over black matches the masked frame.

    The render's derivatives are finite differences, so anything that renders can be refined, and every kind
    of hand is refined alike. Where the squared error at full size does not fall, ``pose`` itself is returned.
    """
    o = options or RefineOptions()
    sigmas = torch.cat(
        [torch.full((3,), o.prior[0]), torch.full((45,), o.prior[1]), torch.full((3,), o.prior[2])]
    )
    total = torch.zeros(_SIZE)
    with torch.no_grad(), one_thread():
        for side in o.sides:
            problem = _Problem(subject, view, side, pose, sigmas, o)
            total = problem.solve(total)
        whole = _Problem(subject, view, 1 << 16, pose, sigmas, o)
        if whole.squares(total) >= whole.squares(torch.zeros(_SIZE)):
            return pose
    return turned(pose, total.unsqueeze(0))


class _Problem:
    """One frame at one resolution. Renders are reduced to it, not drawn at it: there a renderer's low-pass
    filter makes every hand fatter, and a pose that hides this is wrong at full size."""

    def __init__(
        self,
        subject: Renderable,
        view: View,
        side: int,
        pose: HandPose,
        sigmas: Tensor,
        options: RefineOptions,
    ) -> None:
        level, self._camera = view.level(side), view.level(1 << 16).camera
        self.subject, self.pose = subject, pose
        self.sigmas, self.options = sigmas, options
        self._size = level.hand.shape[1], level.hand.shape[0]
        cover = level.hand.unsqueeze(-1)
        self._target = torch.cat([level.rgb * cover, options.silhouette * cover], -1)
        self._counts = torch.cat([level.colored.unsqueeze(-1).expand(*level.hand.shape, 3),
                                  level.valid.unsqueeze(-1)], -1)  # fmt: skip
        # A pixel of a smaller picture stands for more.
        self._scale = 1 / options.noise

    def solve(self, start: Tensor) -> Tensor:
        step = start
        picture = self._render(step)
        cost = self._cost(picture, step)
        damping = 1e-2
        for _ in range(self.options.steps):
            matrix, side = self._normal_equations(picture, step)
            for _ in range(3):
                damped = matrix + damping * torch.diag(matrix.diagonal())
                trial = step + torch.linalg.solve(damped, side).float()
                drawn = self._render(trial)
                found = self._cost(drawn, trial)
                if found < cost:
                    step, picture, cost = trial, drawn, found
                    damping = max(damping / 5, 1e-4)
                    break
                damping *= 10
            else:
                break
        return step

    def squares(self, step: Tensor) -> float:
        """Squared error of the colours, which is what PSNR counts."""
        return float((self._counts * (self._render(step) - self._target).square())[..., :3].sum())

    def _render(self, step: Tensor) -> Tensor:
        """Colours and, as the fourth channel, the silhouette [h,w,4]."""
        out = self.subject.render_pose(turned(self.pose, step.unsqueeze(0)), self._camera)
        picture = torch.cat([out.rgb, self.options.silhouette * out.alpha.unsqueeze(-1)], -1)
        return torch.from_numpy(cv2.resize(picture.numpy(), self._size, interpolation=cv2.INTER_AREA))

    def _weights(self, residual: Tensor) -> Tensor:
        """Of a Geman-McClure-like loss; ignored pixels count nothing."""
        return self._counts / (1 + (residual / self.options.robust).square()) * self._scale**2

    def _cost(self, picture: Tensor, step: Tensor) -> float:
        squares = ((picture - self._target) / self.options.robust).square()
        loss = (self._counts * torch.log1p(squares)).sum() * (self.options.robust * self._scale) ** 2
        return float(loss + (step / self.sigmas).square().sum())

    def _normal_equations(self, picture: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        residual = self._target - picture
        weights = self._weights(residual)
        near = (picture[..., 3] > 0) | (self._target[..., 3] > 0)
        near = torch.nn.functional.max_pool2d(near.float()[None, None], 5, 1, 2)[0, 0] > 0
        columns = []
        for number in range(_SIZE):
            # About half a pixel at a hand's far end.
            width = 0.006 if number < 48 else 0.0006
            moved = step.clone()
            moved[number] += width
            columns.append((self._render(moved) - picture)[near].flatten() / width)
        jacobian = torch.stack(columns, -1)
        w = weights[near].flatten().unsqueeze(-1)
        prior = self.sigmas.double() ** -2
        matrix = (jacobian.T @ (w * jacobian)).double() + torch.diag(prior)
        side = (jacobian.T @ (w[:, 0] * residual[near].flatten())).double() - prior * step.double()
        return matrix, side
