"""Would shadows between fingers be worth a term of their own?

``python benchmarks/shadow_trial.py VIDEO``

Fits VIDEO with every 8th frame held out. Every surfel's occlusion by the other fingers' bones, taken as
capsules, is rendered as a picture o; the strength s that makes render * (1 - s o) most like the video is
found on the training frames by least squares. Prints s and what it gains on the held-out frames: more than
0.05 dB would earn the term its place.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mass_engine.avatar import Avatar, row_pose
from mass_engine.fitting.views import View
from mass_engine.options import FitOptions
from mass_engine.pipeline import fit
from mass_engine.surfel.shading import white_light

#: Bones by finger: joints in MANO's order (three each of index, middle, pinky, ring, thumb), then the tips.
FINGERS = ((1, 2, 3, 17), (4, 5, 6, 18), (7, 8, 9, 20), (10, 11, 12, 19), (13, 14, 15, 16))
RADIUS = 0.008  # metres


def occlusion(means: Tensor, normals: Tensor, bones: Tensor, joints: Tensor) -> Tensor:
    """Share [N] of the sky over each surfel that capsules of other fingers take, roughly (0 to 1)."""
    own = (bones - 1).div(3, rounding_mode="floor")  # -1: the palm
    total = torch.zeros(len(means))
    for finger, chain in enumerate(FINGERS):
        for start, end in itertools.pairwise(chain):
            axis = joints[end] - joints[start]
            along = ((means - joints[start]) @ axis / axis.square().sum()).clamp(0, 1)
            toward = joints[start] + along.unsqueeze(-1) * axis - means
            distance = toward.norm(dim=-1).clamp_min(1e-6)
            facing = ((toward / distance.unsqueeze(-1)) * normals).sum(-1).clamp_min(0)
            taken = facing * (RADIUS / distance).square().clamp_max(1)
            total += torch.where(own == finger, torch.zeros_like(taken), taken)
    return total.clamp_max(1)


def pictures(avatar: Avatar, view: View, row: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render, occlusion and video [h,w,3], and where to compare them [h,w,1]."""
    level = view.level(320)
    pose = row_pose(avatar.frames.pose, row)
    posed = avatar.posed(pose)
    shade = occlusion(posed.attached.means[0], posed.attached.normals[0], avatar.skin.bones, posed.joints[0])
    look = avatar.appearance
    painted = replace(look, albedo=shade.unsqueeze(-1).expand(-1, 3), sh=look.sh[:, :0], light=white_light())
    dark = replace(avatar, appearance=painted)
    out = avatar.render_pose(pose, level.camera)
    inner = (level.hand * level.colored * (out.alpha > 0.98)).unsqueeze(-1)
    return out.rgb, dark.render_pose(pose, level.camera).rgb, level.rgb, inner


def main() -> None:
    """Fit, solve, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("video", type=Path)
    parser.add_argument("--max-frames", type=int, default=FitOptions.max_frames)
    arguments = parser.parse_args()
    outcome = fit(arguments.video, FitOptions(holdout=8, max_frames=arguments.max_frames))
    measure(outcome.avatar, outcome.clip.views)


def measure(avatar: Avatar, views: list[View]) -> None:
    """Solve on the training frames, print the gain on the others."""
    top = bottom = 0.0
    for row, view in enumerate(views):
        if not view.heldout and row % 3 == 0:
            render, dark, video, inner = pictures(avatar, view, row)
            top += float((inner * dark * render * (render - video)).sum())
            bottom += float((inner * (dark * render).square()).sum())
    strength = top / max(bottom, 1e-9)
    before, after, seen = [], [], []
    for row, view in enumerate(views):
        if view.heldout:
            render, dark, video, inner = pictures(avatar, view, row)
            area = inner.sum().clamp_min(1) * 3
            before.append(float((inner * (render - video).square()).sum() / area))
            shaded = render * (1 - strength * dark)
            after.append(float((inner * (shaded - video).square()).sum() / area))
            seen.append(float((inner * dark).sum() / area))
    gain = 10 * torch.log10(torch.tensor(before) / torch.tensor(after))
    print(
        f"strength {strength:.3f}, mean occlusion {sum(seen) / len(seen):.3f}; held-out frames gain "
        f"{float(gain.mean()):+.3f} dB ({float(gain.min()):+.3f} to {float(gain.max()):+.3f})"
    )


if __name__ == "__main__":
    main()
