"""``--template``: the hand a fit starts from. Built in, somebody's MANO file, or any rigged hand."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mass_engine.template_spec import TemplateSpec

if TYPE_CHECKING:
    from mass_engine.hand.mano import ManoFile
    from mass_engine.hand.model import HandModel
    from mass_engine.hand.pose import Side


@dataclass(frozen=True)
class Template:
    """``name`` tells templates apart (tracks remember it); ``hand`` is of the side the file is of.

    ``notes`` (code, message) say what was done to the file's hand. ``mano`` is the file behind a MANO hand,
    for its mean pose and principal components.
    """

    name: str
    hand: HandModel
    notes: tuple[tuple[str, str], ...] = ()
    mano: ManoFile | None = None

    def model(self, side: Side) -> HandModel:
        """The hand of ``side``: the file's own, or its mirror image."""
        return self.hand if self.hand.side == side else self.hand.mirrored()


def load_template(spec: TemplateSpec) -> Template:
    """Read what ``spec`` names. Raises EngineError with a code ``template.*``."""
    if spec.path is None:
        from mass_engine.hand.builtin import load_builtin

        return Template("builtin", load_builtin("right"))
    notes: list[tuple[str, str]]
    mano: ManoFile | None = None
    if spec.kind == "mano":
        from mass_engine.hand.mano import read_mano

        mano, notes = read_mano(spec.path), []
        hand = mano.model(spec.tips)
        if mano.sign_fault:
            notes.append(
                ("template.mano_left", "The left hand's shape basis has its known sign fault: put right.")
            )
    else:
        from mass_engine.hand.gltf import read_rigged_hand

        hand, notes = read_rigged_hand(spec.path, spec.joints, spec.side)
    digest = hashlib.sha256(hand.template.numpy().tobytes() + hand.joint_template.numpy().tobytes())
    return Template(f"{spec.kind}:{digest.hexdigest()[:12]}", hand, tuple(notes), mano)
