"""How much model a clip needs: surfels a face, view-dependent harmonics, the deformation."""

from __future__ import annotations

import torch
from torch import Tensor

from mass_engine.fitting.evidence import Evidence, Scene, spread
from mass_engine.fitting.skin import Skin

#: Frames that the best view of a face is looked for in.
SAMPLED_FRAMES = 24
#: A face under this many pixels at its best view has no room for a second surfel.
LEAST_PIXELS = 2.5
#: Surfels of one face whose colours (0..1) differ by less are one surfel.
ALIKE = 0.012
#: Under this much blending weight in the whole clip a face was not seen.
UNSEEN = 0.5
#: Spread of the view direction in a bone's frame, degrees, from which harmonics of degree 1, and 2, are told.
TELLS_DEGREE = (10.0, 45.0)
#: What the deformation, and each finer hash grid, must gain on the validation frames, dB.
DEFORMATION_GAIN = 0.05


def best_pixels(scene: Scene, skin: Skin, side: int) -> Tensor:
    """Pixels [F'] of each refined face in the view that shows it largest (0: it never faced the camera)."""
    home, scene = scene.device, scene.at_work()
    skin = skin.to(scene.device)
    faces = skin.binding.subdivision.faces
    best: Tensor = torch.zeros(len(faces), device=scene.device)
    for row in spread(scene.trained, SAMPLED_FRAMES):
        with torch.no_grad():
            vertices = scene.surfels(skin, row).outline_vertices[0]
            camera = scene.level(row, side).camera
            a, b, c = camera.project(vertices)[faces].unbind(1)
            u, v = b - a, c - a
            # Pixel rows run down: what faces the camera goes round clockwise, its signed area is negative.
            area = -0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
            best = torch.maximum(best, torch.where(torch.isfinite(area), area, torch.zeros_like(area)))
    return best.to(home)


def thin(skin: Skin, evidence: Evidence, pixels: Tensor) -> tuple[Skin, Evidence, dict[str, int]]:
    """One widened surfel instead of several on faces unseen, too small for more, or of one colour.

    ``skin`` has all surfels of a widened binding, attached; ``pixels`` [F'] as :func:`best_pixels` gives
    them. The evidence of merged surfels is put together. Also returns how many faces were thinned for which
    reason.
    """
    per = skin.binding.per_face - 1
    hand, albedo = evidence.hand.unflatten(0, (-1, per)), evidence.albedo.unflatten(0, (-1, per))
    total = hand.sum(1)
    mean = (albedo * hand.unsqueeze(-1)).sum(1) / total.clamp_min(1e-9).unsqueeze(-1)
    apart = ((albedo - mean.unsqueeze(1)).abs().amax(-1) * (hand > 0.1 * UNSEEN)).amax(1)
    unseen = total < UNSEEN
    small = ~unseen & (pixels < LEAST_PIXELS)
    alike = ~unseen & ~small & (apart < ALIKE)
    merged = unseen | small | alike
    chosen = torch.cat([~merged.unsqueeze(1).expand(-1, per), merged.unsqueeze(1)], 1).flatten()

    def joined(values: Tensor, whole: Tensor) -> Tensor:
        rows = torch.cat([values.unflatten(0, (-1, per)), whole.unsqueeze(1)], 1)
        return rows.flatten(0, 1)[chosen]

    def summed(values: Tensor) -> Tensor:
        return joined(values, values.unflatten(0, (-1, per)).sum(1))

    thinned = Evidence(
        summed(evidence.hand),
        summed(evidence.ignored),
        summed(evidence.background),
        joined(evidence.albedo, mean),
    )
    sources = chosen.nonzero()[:, 0]
    counts = {"unseen": int(unseen.sum()), "small": int(small.sum()), "one_color": int(alike.sum())}
    return Skin(skin.binding, sources, len(sources)), thinned, counts


def view_spread(scene: Scene) -> float:
    """How far the camera wanders around the bones, degrees: mean over bones of the directions' deviation."""
    table, shape = scene.table, scene.shape
    index = torch.tensor(scene.trained)
    with torch.no_grad():
        pose = table.pose(shape.betas, {name: value[index] for name, value in table.values.items()})
        hand = shape.model.posed(pose, shape.displacement)
        camera = scene.views[scene.trained[0]].camera.world_to_camera
        center = -camera[:3, :3].T @ camera[:3, 3]
        away = torch.nn.functional.normalize(center - hand.joints[:, :16], dim=-1)
        turned = (away.unsqueeze(-2) @ hand.bone_transforms[..., :3, :3]).squeeze(-2)
        length = turned.mean(0).norm(dim=-1).clamp(0, 1)
    return float(torch.rad2deg(torch.acos(length)).mean())


def harmonics_for(degrees: float, most: int) -> int:
    """Coefficients a channel (0, 3 or 8, at most ``most``) that a spread of ``degrees`` can tell apart."""
    wanted = (0, 3, 8)[sum(degrees >= least for least in TELLS_DEGREE)]
    return min(wanted, most)
