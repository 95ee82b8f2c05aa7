"""The layers after the hash grid, in plain torch: the specification of the decoder.

The first layer is linear in the hash features and in the pose features, and neither knows of the other: the
one's share is a row per surfel, the other's a row per pose, and their sum is what the layer gives.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

#: offset 3, log-scale 2, rotation 3, mask logit 1
OUTPUTS = 9


class Layers(NamedTuple):
    """Second layer [H,H] and [H], head [H,O] and [O] (inputs along the rows)."""

    second: Tensor
    second_bias: Tensor
    head: Tensor
    head_bias: Tensor


def decode(surfel_share: Tensor, pose_share: Tensor, layers: Layers) -> Tensor:
    """``surfel_share`` [N,H] and ``pose_share`` [B,H] of the first layer -> outputs [B,N,O].

    head(relu(second(relu(surfel_share + pose_share)))).
    """
    hidden = torch.relu(surfel_share + pose_share.unsqueeze(-2))
    refined = torch.relu(hidden @ layers.second + layers.second_bias)
    return refined @ layers.head + layers.head_bias
