"""The pinhole camera: x right, y down, z forward, metres; pixel centres at +0.5."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """``K`` [3,3] in pixels and ``world_to_camera`` [4,4], both torch; ``width``, ``height`` in pixels."""

    K: Tensor
    world_to_camera: Tensor
    width: int
    height: int

    @staticmethod
    def from_fov(width: int, height: int, fov_degrees: float) -> Camera:
        """Identity pose; ``fov_degrees`` spans the longer image side; principal point in the centre."""
        focal = 0.5 * max(width, height) / math.tan(0.5 * math.radians(fov_degrees))
        K = torch.tensor([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
        return Camera(K, torch.eye(4), width, height)

    @property
    def fov_degrees(self) -> float:
        """Field of view along the longer image side (as far as it is centred)."""
        focal = float(self.K[0, 0] if self.width >= self.height else self.K[1, 1])
        return math.degrees(2 * math.atan(0.5 * max(self.width, self.height) / focal))

    def project(self, points: Tensor) -> Tensor:
        """World points [...,3] in metres to pixels [...,2]."""
        p = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        return p[..., :2] / p[..., 2:] @ self.K[:2, :2].T + self.K[:2, 2]

    def to(self, device: torch.device | str) -> Camera:
        """The same camera elsewhere."""
        return replace(self, K=self.K.to(device), world_to_camera=self.world_to_camera.to(device))

    def crop(self, x: int, y: int, width: int, height: int) -> Camera:
        """The camera of the image window whose top-left pixel is (x, y)."""
        K = self.K.clone()
        K[0, 2] -= x
        K[1, 2] -= y
        return replace(self, K=K, width=width, height=height)

    def resized(self, width: int, height: int) -> Camera:
        """The same view sampled by ``width`` x ``height`` pixels."""
        K = self.K.clone()
        K[0] *= width / self.width
        K[1] *= height / self.height
        return replace(self, K=K, width=width, height=height)
