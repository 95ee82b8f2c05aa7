"""What the deformation costs: hash grid, decoder and residuals, compiled against plain torch.

    python benchmarks/deformation.py [--repeat 9] [--threads 2]

Milliseconds, median (least), of wall time and of this process's processor time over all its threads, which
other work on the machine changes less.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from mass_engine.deform import _kernels
from mass_engine.deform.decoder import Layers, Units, decode, decode_reference
from mass_engine.deform.network import Deformation, DeformationConfig, UnitCube
from mass_engine.deform.residuals import Residuals, deform, deform_reference
from mass_engine.hand.builtin import load_builtin
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding


def median(action: Callable[[], object], repeat: int, clock: Callable[[], float]) -> str:
    """Milliseconds of ``action`` after one warm-up."""
    action()
    spent = []
    for _ in range(repeat):
        start = clock()
        action()
        spent.append((clock() - start) * 1000)
    return f"{statistics.median(spent):.1f} ({min(spent):.1f})"


def decoder_inputs(count: int, batch: int, hidden: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = ((count, hidden), (batch, hidden), (hidden, hidden), (hidden,), (hidden, 9), (9,))
    return [torch.randn(shape, generator=generator).mul_(0.3).requires_grad_() for shape in shapes]


def numbers(residuals: Residuals) -> list[Tensor]:
    return [residuals.offset, residuals.log_scale, residuals.rotation, residuals.mask_logit]


def decoder_step(tensors: list[Tensor], how: Callable[..., Residuals], **options: object) -> None:
    """Forward and backward."""
    out = numbers(how(tensors[0], tensors[1], Layers(*tensors[2:]), Units(1e-3, 0.1), **options))
    torch.autograd.grad(out, tensors, [torch.ones_like(value) for value in out])


def decoder_forward(tensors: list[Tensor], how: Callable[..., Residuals], **options: object) -> None:
    with torch.no_grad():
        how(tensors[0], tensors[1], Layers(*tensors[2:]), Units(1e-3, 0.1), **options)


def residual_step(inputs: list[Tensor], how: Callable[..., AttachedSurfels], **options: object) -> None:
    """Forward and backward of applying residuals."""
    means, tangents, normals, offset, log_scale, rotation, mask_logit = inputs
    after = how(
        AttachedSurfels(means, tangents, normals),
        Residuals(offset, log_scale, rotation, mask_logit),
        **options,
    )
    out = [after.means, after.tangents, after.normals]
    torch.autograd.grad(out, inputs[:6], [torch.ones_like(value) for value in out])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    repeat: int = arguments.repeat
    threads: int = arguments.threads
    torch.set_num_threads(threads)
    model = load_builtin("right")
    binding = MeshBinding.build(model, 1, 1)
    rest = binding.surfels(model.template)
    count, batch = binding.count, 4
    module = Deformation(
        DeformationConfig(),
        rest.means,
        binding.surfel_faces,
        len(model.faces),
        UnitCube.around(model.template),
        torch.Generator().manual_seed(0),
    )
    surfels = [
        value.expand(batch, *value.shape).clone() for value in (rest.means, rest.tangents, rest.normals)
    ]
    generator = torch.Generator().manual_seed(1)
    changes = [torch.randn(batch, count, *end, generator=generator) * 0.1 for end in ((3,), (2,), (3,), ())]
    inputs = [value.requires_grad_() for value in (*surfels, *changes)]
    both = {"wall": time.perf_counter, "processor": time.process_time}
    print(
        f"{count} surfels, {batch} poses, forward and backward, {threads} threads; median of {repeat}, ms\n"
    )
    print("| part | " + " | ".join(both) + " |\n|---|---|---|")

    def line(name: str, action: Callable[[], object], times: int = repeat) -> None:
        print(f"| {name} | " + " | ".join(median(action, times, clock) for clock in both.values()) + " |")

    def grid() -> None:
        torch.autograd.grad(module.grid().sum(), list(module.grid.parameters()))

    line("hash grid, 8 levels", grid)
    for hidden in (32, 64):
        few, many = decoder_inputs(count, batch, hidden), decoder_inputs(196864, 1, hidden)
        for name in _kernels.instruction_sets() if hidden == 32 else ["auto"]:
            compiled = partial(decoder_step, few, decode, threads=threads, instruction_set=name)
            line(f"decoder, {hidden} units, {name}", compiled)
        line(f"decoder, {hidden} units, torch", partial(decoder_step, few, decode_reference), 3)
        forward = partial(decoder_forward, many, decode, threads=threads)
        line(f"decoder, {hidden} units, 196,864 surfels in one pose, forward only", forward)
        line("the same, torch", partial(decoder_forward, many, decode_reference), 3)
    line("applying residuals", lambda: residual_step(inputs, deform, threads=threads))
    line("the same, torch", lambda: residual_step(inputs, deform_reference), 3)


if __name__ == "__main__":
    main()
