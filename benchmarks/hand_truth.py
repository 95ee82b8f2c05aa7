"""How well the built-in hand takes the shape of a hand it was not made from.

``python benchmarks/hand_truth.py CLIP_DIR... [--frames 96]`` fits one shape and a pose per frame to the
ground-truth surfaces in CLIP_DIR/truth.npz (vertices [T,V,3] world metres, faces, joints with names) and
prints the distance between the surfaces, both ways: true vertices to the fitted surface, and fitted vertices
to the true surface. Only the hand counts: what lies behind the wrist joint is left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from mass_engine.evaluation.surfaces import surface_distance
from mass_engine.fitting.subject import vertex_normals
from mass_engine.hand.builtin import joint_frames, joint_limits, load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.surfel.subdivision import Subdivision, loop_subdivision
from mass_engine.tracking.alignment import limit_excess

Array = NDArray[np.float64]

#: The truth's name of each of our 21 points, where it has one.
_POINTS = (
    "wrist",
    *(f"{finger}-{part}" for finger in ("index", "middle", "pinky", "ring") for part in
      ("proximal", "intermediate", "distal")),
    "thumb-metacarpal", "thumb-proximal", "thumb-distal",
    *(f"{finger}-tip" for finger in ("thumb", "index", "middle", "ring", "pinky")),
)  # fmt: skip
#: A normal that points the wrong way costs as much as this many metres.
_NORMAL_REACH = 0.01


@dataclass(frozen=True)
class Truth:
    """Surfaces of the chosen frames: vertices [T,V,3], faces [F,3], our 21 points [T,21,3]."""

    vertices: Tensor
    faces: Tensor
    points: Tensor


def load_truth(folder: Path, frames: int) -> Truth:
    """``frames`` evenly spread frames of a clip."""
    with np.load(folder / "truth.npz") as data:
        names = [str(name) for name in data["joint_names"]]
        chosen = np.linspace(0, len(data["vertices"]) - 1, frames).round().astype(int)
        points = data["joints"][chosen][:, [names.index(name) for name in _POINTS]]
        return Truth(
            torch.tensor(data["vertices"][chosen], dtype=torch.float32),
            torch.tensor(data["faces"].astype(np.int64)),
            torch.tensor(points, dtype=torch.float32),
        )


class Fit:
    """One shape and T poses, fitted by Adam: first to the joints, then to the surface."""

    def __init__(self, model: HandModel, truth: Truth) -> None:
        self.model, self.truth = model, truth
        self.fine: Subdivision = loop_subdivision(model.faces, len(model.template), 1)
        count = len(truth.points)
        self.betas = torch.zeros(10)
        self.orient, self.shift = _palm_alignment(model, truth.points)
        self.fingers = torch.zeros(count, 45)
        self.true_normals = torch.stack([vertex_normals(v, truth.faces) for v in truth.vertices])
        self.limits, self.frames = joint_limits(), joint_frames(model)

    def pose(self) -> HandPose:
        """The current poses [T]."""
        return HandPose(self.betas, self.orient, self.fingers, self.shift, self.model.side)

    def run(self, joint_steps: int, surface_steps: int) -> None:
        """Both phases."""
        self._optimise(joint_steps, self._joint_loss, 0.03)
        self._optimise(surface_steps, self._surface_loss, 0.02)

    def _optimise(self, steps: int, loss_of: Callable[[int], Tensor], rate: float) -> None:
        leaves = [self.betas, self.orient, self.fingers, self.shift]
        for leaf in leaves:
            leaf.requires_grad_(True)
        groups = [
            {"params": [self.betas], "lr": 2 * rate},
            {"params": [self.orient, self.fingers], "lr": rate},
            {"params": [self.shift], "lr": 0.1 * rate},
        ]
        optimizer = torch.optim.Adam(groups)
        first = [float(group["lr"]) for group in optimizer.param_groups]
        for step in range(steps):
            for group, start in zip(optimizer.param_groups, first, strict=True):
                group["lr"] = start * (1 - step / steps) ** 0.7
            optimizer.zero_grad()
            loss = loss_of(step)
            excess = limit_excess(self.fingers, self.limits, self.frames).square().sum((-1, -2)).mean()
            (loss + 2e-5 * excess + 2e-8 * self.betas.square().sum()).backward()
            optimizer.step()
        for leaf in leaves:
            leaf.requires_grad_(False)

    def _joint_loss(self, _step: int) -> Tensor:
        # Joint definitions differ (their wrist lies farther back), so the wrist hardly counts.
        weight = torch.ones(21)
        weight[0] = 0.05
        apart = (self.model.joints(self.pose()) - self.truth.points).square().sum(-1)
        return (apart * weight).mean()

    def _surface_loss(self, step: int) -> Tensor:
        refined = self.fine.apply(self.model(self.pose())[0])
        if step % 8 == 0:
            self._match(refined.detach())
        a = refined[self.frame_of, self.ours] - self.truth.vertices[self.frame_of, self.theirs]
        normal = self.true_normals[self.frame_of, self.theirs]
        plane = (a * normal).sum(-1).square()
        return (plane + 0.1 * a.square().sum(-1)).mean()

    def _match(self, refined: Tensor) -> None:
        """Closest points both ways, in space and direction, without what lies behind the wrist."""
        frames, ours, theirs = [], [], []
        kept = rest_kept(self.model, self.fine)
        place = wrist_place(self.model, self.pose(), self.truth.vertices)
        for t, points in enumerate(refined):
            normals = vertex_normals(points, self.fine.faces)
            mine = torch.cat([points, normals * _NORMAL_REACH], 1).numpy()
            true = torch.cat([self.truth.vertices[t], self.true_normals[t] * _NORMAL_REACH], 1).numpy()
            to_true = cKDTree(true).query(mine[kept])[1]
            front = np.flatnonzero((place[t] < 0).numpy())
            to_mine = cKDTree(mine).query(true[front])[1]
            ours.append(np.concatenate([kept, to_mine]))
            theirs.append(np.concatenate([to_true, front]))
            frames.append(np.full(len(ours[-1]), t))
        self.frame_of, self.ours, self.theirs = (
            torch.from_numpy(np.concatenate(part)) for part in (frames, ours, theirs)
        )

    def distances(self) -> tuple[Array, Array]:
        """Metres: true vertices [..] to the fitted surface, fitted vertices [..] to the true surface."""
        with torch.no_grad():
            pose = self.pose()
            refined = self.fine.apply(self.model(pose)[0]).double().numpy()
            place = wrist_place(self.model, pose, self.truth.vertices)
        kept, forth, back = rest_kept(self.model, self.fine), [], []
        true_faces, faces = self.truth.faces.numpy(), self.fine.faces.numpy()
        for t, points in enumerate(refined):
            true = self.truth.vertices[t].double().numpy()
            forth.append(surface_distance(true[(place[t] < 0).numpy()], points, faces))
            back.append(surface_distance(points[kept], true, true_faces))
        return np.concatenate(forth), np.concatenate(back)


def _palm_alignment(model: HandModel, points: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation vector and translation [T,3] that lay the rest palm on the true one (Kabsch)."""
    import cv2

    rest = model.joints(HandPose.rest(model.side))
    palm = [1, 4, 7, 10, 0, 13]
    orients, shifts = [], []
    for one in points:
        a, b = rest[palm] - rest[palm].mean(0), one[palm] - one[palm].mean(0)
        u, _, vt = torch.linalg.svd(a.T @ b)
        flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt).sign())]))
        rotation = (u @ flip @ vt).T
        orients.append(torch.tensor(cv2.Rodrigues(rotation.double().numpy())[0].ravel(), dtype=torch.float32))
        shifts.append(one[palm].mean(0) - rotation @ rest[palm].mean(0))
    return torch.stack(orients), torch.stack(shifts)


def rest_kept(model: HandModel, fine: Subdivision) -> NDArray[np.int64]:
    """Refined vertices that belong to the hand proper: in front of the wrist joint at rest."""
    rest = fine.apply(model.template)
    front = rest[:, 0] < 0 if model.side == "right" else rest[:, 0] > 0
    return np.flatnonzero(front.numpy()).astype(np.int64)


def wrist_place(model: HandModel, pose: HandPose, vertices: Tensor) -> Tensor:
    """How far behind the wrist joint [T,V] each true vertex lies (metres, negative: in front)."""
    with torch.no_grad():
        to_world = model.posed(pose).bone_transforms[:, 0]
    local = (vertices - to_world[:, None, :3, 3]) @ to_world[:, :3, :3]
    return local[..., 0] if model.side == "right" else -local[..., 0]


def main(argv: Sequence[str] | None = None) -> int:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=96)
    parser.add_argument("--steps", type=int, default=240)
    parser.add_argument("--save", type=Path, help="write the last fit here (.pt), for looking at")
    arguments = parser.parse_args(argv)
    for clip in arguments.clips:
        fit = Fit(load_builtin("right"), load_truth(clip, arguments.frames))
        fit.run(200, arguments.steps)
        forth, back = fit.distances()
        both = np.concatenate([forth, back]) * 1e3
        print(
            f"{clip.name}: {arguments.frames} frames, mean {both.mean():.2f} mm, 95th percentile "
            f"{np.percentile(both, 95):.2f} mm (true to fitted {forth.mean() * 1e3:.2f} / "
            f"{np.percentile(forth, 95) * 1e3:.2f}, fitted to true {back.mean() * 1e3:.2f} / "
            f"{np.percentile(back, 95) * 1e3:.2f})"
        )
        print("  betas", " ".join(f"{beta:+.2f}" for beta in fit.betas))
        if arguments.save:
            torch.save({"pose": vars(fit.pose()), "truth": vars(fit.truth)}, arguments.save)
    return 0


if __name__ == "__main__":
    sys.exit(main())
