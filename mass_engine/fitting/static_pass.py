"""A surfel pass without a word between device and host: the step of ``surfel_fit`` with fixed shapes.

Every frame of a pass lies on the device, padded to one size, beside its posed mesh (geometry is frozen, so it
is posed once). A visit's plan (which frame, which background, which rate) is sent once; from then on a step
takes its turn from a counter on the device. Whether a step is taken is decided there, too, and read once a
visit. So one step can be captured as one CUDA graph (``graphs.Replayed``), and a visit is as many launches as
it has frames. On a CPU the same step runs as it is, which is how it is tested.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.evidence import Scene
from mass_engine.fitting.guard import IN_A_ROW, LEAP
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, PosedSurfels
from mass_engine.fitting.surfel_loss import Frame, SurfelWeights, shaped_options, surfel_loss
from mass_engine.fitting.surfel_steps import BETAS, EPSILON, SurfelPass, Visit, freeze_part
from mass_engine.fitting.views import Level
from mass_engine.graphs import Replayed
from mass_engine.raster import cuda
from mass_engine.raster.cuda import MOST_PAIRS, STATUS

#: Pictures are padded to whole tiles of the rasteriser.
_TILE = 16
#: Losses that the leap of the next is judged by, and how many there must be first (as ``Guard``).
_REMEMBERED, _FIRST = 41, 9


@dataclass(frozen=True)
class FrameStack:
    """Frames of one pass [F], padded to height H and width W.

    ``rgb`` [F,H,W,3] and ``hand`` [F,H,W] are bytes, ``valid`` and ``colored`` [F,H,W] bits, ``sizes`` [F,2]
    heights and widths without the padding; ``K``, ``K_inverse`` [F,3,3], ``world_to_camera`` [F,4,4],
    ``gains`` [F,3]; of the poses ``refined`` [F,V',3], ``bone_rotations`` [F,16,3,3], ``joints`` [F,21,3],
    ``hand_pose`` [F,45], ``betas`` [F,10] and ``depths`` [F].
    """

    rgb: Tensor
    hand: Tensor
    valid: Tensor
    colored: Tensor
    sizes: Tensor
    K: Tensor
    K_inverse: Tensor
    world_to_camera: Tensor
    gains: Tensor
    refined: Tensor
    bone_rotations: Tensor
    joints: Tensor
    hand_pose: Tensor
    betas: Tensor
    depths: Tensor

    @staticmethod
    def of(scene: Scene, skin: Skin, rows: Sequence[int], side: int) -> FrameStack:
        """The ``rows`` of ``scene``, where the scene is; ``skin`` says how the mesh is refined."""
        device = scene.device
        levels = [scene.views[row].level(side) for row in rows]
        height, width = (
            -(-max(level.hand.shape[axis] for level in levels) // _TILE) * _TILE for axis in (0, 1)
        )

        def stacked(values: list[Tensor], scale: float, dtype: torch.dtype) -> Tensor:
            out = torch.zeros(len(values), height, width, *values[0].shape[2:], dtype=dtype)
            for place, value in zip(out, values, strict=True):
                place[: value.shape[0], : value.shape[1]] = (value * scale).round().to(dtype)
            return out.to(device)

        index = torch.tensor(list(rows), device=device)
        values = {name: value[index] for name, value in scene.table.values.items()}
        pose = scene.table.pose(scene.shape.betas, values)
        with torch.no_grad():
            posed = scene.shape.model.posed(pose, scene.shape.displacement)
            refined = skin.binding.subdivision.apply(posed.vertices)
        K = torch.stack([level.camera.K for level in levels])
        return FrameStack(
            stacked([level.rgb for level in levels], 255, torch.uint8),
            stacked([level.hand for level in levels], 255, torch.uint8),
            stacked([level.valid for level in levels], 1, torch.bool),
            stacked([level.colored for level in levels], 1, torch.bool),
            torch.tensor([level.hand.shape for level in levels], device=device),
            K.to(device),
            torch.linalg.inv(K).to(device),
            torch.stack([level.camera.world_to_camera for level in levels]).to(device),
            scene.gains[index],
            refined,
            posed.bone_transforms[..., :3, :3].contiguous(),
            posed.joints,
            pose.hand_pose,
            pose.betas.contiguous(),
            values["transl"][:, 2].contiguous(),
        )

    @property
    def nbytes(self) -> int:
        """What the stack takes of the device's memory."""
        return sum(value.numel() * value.element_size() for value in vars(self).values())

    def frame(self, row: Tensor) -> Frame:
        """The frame at ``row`` (int64 [1], on the device), padded."""

        def at(values: Tensor) -> Tensor:
            return values.index_select(0, row)[0]

        hand = at(self.hand).float().div_(255)
        height, width = hand.shape
        y = torch.arange(height, device=hand.device).unsqueeze(1)
        x = torch.arange(width, device=hand.device)
        h, w = at(self.sizes).unbind()
        level = Level(
            at(self.rgb).float().div_(255),
            hand,
            at(self.valid).float(),
            at(self.colored).float(),
            Camera(at(self.K), at(self.world_to_camera), width, height),
        )
        return Frame(
            level,
            at(self.depths),
            at(self.gains),
            None,
            ((y < h) & (x < w)).float(),
            ((y > 0) & (y < h - 1) & (x > 0) & (x < w - 1)).float(),
            at(self.K_inverse),
        )

    def surfels(self, skin: Skin, row: Tensor) -> PosedSurfels:
        """The surfels of the frame at ``row`` (int64 [1]), a batch of one; as ``Scene.surfels``."""
        parts = (self.refined, self.bone_rotations, self.joints, self.hand_pose, self.betas)
        return skin.on_mesh(*(part.index_select(0, row) for part in parts))


class StepGuard:
    """``Guard`` on the device: says of every step whether to take it, remembers what the host must know.

    A step that is not finite, or whose loss leaps, is left out. After ``IN_A_ROW`` leaps, or one step that is
    not finite, the rest of the visit is left out as well (``diverged``); its caller then goes back to where
    the visit began.
    """

    def __init__(self, device: torch.device) -> None:
        self._losses = torch.full((_REMEMBERED,), torch.inf, device=device)
        self._places = torch.arange(_REMEMBERED, device=device)
        self._good = torch.zeros((), dtype=torch.long, device=device)
        self._leaps = torch.zeros((), dtype=torch.long, device=device)
        self.diverged = torch.zeros((), dtype=torch.bool, device=device)
        self.idle = torch.zeros((), dtype=torch.bool, device=device)

    def judge(self, loss: Tensor, broken: Tensor) -> Tensor:
        """Whether to take a step with this loss (scalars, bool); ``broken``: its gradients are not finite."""
        loss = loss.detach()
        finite = loss.isfinite() & ~broken
        known = self._good.clamp_max(_REMEMBERED)
        median = self._losses.sort().values.gather(0, (known // 2).clamp_max(_REMEMBERED - 1).unsqueeze(0))[0]
        fits = (self._good < _FIRST) | (loss <= LEAP * median)
        ok = finite & fits & ~self.diverged & ~self.idle
        here = (self._places == self._good % _REMEMBERED) & ok
        self._losses.copy_(torch.where(here, loss, self._losses))
        self._good.add_(ok)
        self._leaps.copy_(torch.where(ok, torch.zeros_like(self._leaps), self._leaps + 1))
        self.diverged.logical_or_((~finite | (self._leaps >= IN_A_ROW)) & ~self.idle)
        return ok

    def begin_visit(self) -> None:
        """Forget that the last one diverged."""
        self._leaps.zero_()
        self.diverged.zero_()


class StaticSteps:
    """As ``EagerSteps``, of ``stage`` over ``rows``; one graph on a GPU.

    The range of depths that scales the distortion is one for all frames: the loss divides it out.
    """

    def __init__(
        self,
        scene: Scene,
        skin: Skin,
        appearance: Appearance,
        stage: SurfelPass,
        weights: SurfelWeights,
        groups: Sequence[tuple[float, Tensor]],
        rows: Sequence[int],
    ) -> None:
        self._skin, self._appearance, self._stage, self._weights = skin, appearance, stage, weights
        self._frames = FrameStack.of(scene, skin, rows, stage.side)
        self._place = {row: place for place, row in enumerate(rows)}
        self._options = scene.raster
        if stage.shaped(weights):
            self._options = shaped_options(scene.raster, _middle(self._frames.depths))
        self._parameters = [value for _, value in groups]
        self._device = device = scene.device
        self._optimizer, self._rates = _adam(groups, device)
        self._guard, self._rate = StepGuard(device), 1.0
        self.undone = 0
        # A visit's plan, and whose turn it is.
        count = len(rows)
        self._rows = torch.zeros(count, dtype=torch.long, device=device)
        self._backgrounds = torch.zeros(count, 3, device=device)
        self._factors = torch.zeros(count, device=device)
        self._turn = torch.zeros(1, dtype=torch.long, device=device)
        #: Room for surfels that grow: so many times what they need at first.
        self._spare = 1.5
        self._cramped = torch.zeros((), dtype=torch.bool, device=device)
        self._capture()

    def visit(self, plan: Visit, progress: Callable[[int], None]) -> None:
        """Take the plan's steps; ``progress`` is told how many are under way.

        A visit that diverges is taken back, and the next goes at half the rate.
        """
        kept = [value.detach().clone() for value in self._parameters]
        self._rows.copy_(torch.tensor([self._place[row] for row in plan.rows]))
        self._backgrounds.copy_(torch.stack(list(plan.backgrounds)))
        self._factors.copy_(torch.tensor(plan.rates, dtype=torch.float64) * self._rate)
        while True:
            self._turn.zero_()
            self._guard.begin_visit()
            for step in range(len(plan.rows)):
                self._step()
                progress(step + 1)
            if not bool(self._cramped):
                break
            # Surfels have grown beyond the room they had: once more, with more of it.
            self._cramped.zero_()
            self._restore(kept)
            self._spare *= 2
            self._capture()
        if bool(self._guard.diverged):
            self._restore(kept)
            self._rate *= 0.5
            self.undone += 1

    def _restore(self, kept: Sequence[Tensor]) -> None:
        with torch.no_grad():
            for value, good in zip(self._parameters, kept, strict=True):
                value.copy_(good)

    def _capture(self) -> None:
        """Make the step anew, with room for the surfels as they are (a GPU's memory is given out before)."""
        if self._device.type == "cuda":
            self._options = replace(self._options, pair_capacity=None)
            with torch.no_grad():
                for place in range(len(self._place)):
                    self.loss(torch.tensor([place], device=self._device), self._backgrounds[0])
            room = cuda.shared_backend().room(self._skin.count) * self._spare
            self._options = replace(self._options, pair_capacity=min(int(room), MOST_PAIRS))
        self._step = Replayed(self._take, self._device, self._guard.idle.fill_)

    def loss(self, row: Tensor, background: Tensor) -> Tensor:
        """The loss of the frame at ``row`` (int64 [1]) of the stack before ``background`` [3]."""
        stage = self._stage
        loss, out = surfel_loss(
            self._appearance,
            self._skin,
            self._frames.frame(row),
            self._frames.surfels(self._skin, row),
            background,
            self._options,
            self._weights,
            stage.dssim,
            stage.geometry,
        )
        if out.counters is not None:
            self._cramped.logical_or_(out.counters[STATUS] != 0)
        return loss

    def _take(self) -> None:
        turn, guard = self._turn, self._guard
        for value in self._parameters:
            value.grad = None
        row = self._rows.index_select(0, turn)
        loss = self.loss(row, self._backgrounds.index_select(0, turn)[0])
        loss.backward()
        if self._skin.deformation is not None:
            freeze_part(self._skin.deformation, self._stage.geometry)
        grads = [value.grad for value in self._parameters if value.grad is not None]
        broken = torch.zeros((), device=self._device)
        torch._amp_foreach_non_finite_check_and_unscale_(grads, broken, torch.ones_like(broken))
        ok = guard.judge(loss, broken > 0)
        factor = self._factors.index_select(0, turn)[0]
        for group, rate in zip(self._optimizer.param_groups, self._rates, strict=True):
            group["lr"].copy_(rate * factor)
        # A fused Adam heeds it: no number of it changes where this is not zero.
        vars(self._optimizer)["found_inf"] = 1.0 - ok.float()
        self._optimizer.step()
        # During the runs before a capture nothing moves on.
        turn.add_(~guard.idle)
        turn.clamp_max_(len(self._rows) - 1)


def _middle(depths: Tensor) -> float:
    return float(depths.abs().clamp_min(0.05).median())


def _adam(
    groups: Sequence[tuple[float, Tensor]], device: torch.device
) -> tuple[torch.optim.Adam, list[float]]:
    """One Adam whose rates are tensors: a graph has its numbers from memory. Also the rates of its groups."""
    rates = sorted({rate for rate, _ in groups})
    optimizer = torch.optim.Adam(
        [
            {
                "params": [value for own, value in groups if own == rate],
                "lr": torch.tensor(rate, device=device),
            }
            for rate in rates
        ],
        betas=BETAS,
        eps=EPSILON,
        fused=True,
        capturable=device.type == "cuda",
    )
    return optimizer, rates
