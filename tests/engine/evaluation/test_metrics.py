"""Metrics against an independent implementation and against values known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import pytorch_msssim
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from mass_engine.evaluation import metrics


def pair(size: int = 64, noise: float = 0.1) -> tuple[torch.Tensor, torch.Tensor]:
    random = np.random.default_rng(0)
    smooth = np.cumsum(random.normal(0, 0.05, (size, size, 3)), axis=1) % 1.0
    other = np.clip(smooth + random.normal(0, noise, smooth.shape), 0, 1)
    return torch.from_numpy(smooth), torch.from_numpy(other)


def test_psnr_agrees_with_scikit_image_and_respects_the_mask() -> None:
    a, b = pair()
    expected = peak_signal_noise_ratio(a.numpy(), b.numpy(), data_range=1.0)
    assert abs(metrics.psnr(a, b) - expected) < 1e-6
    mask = torch.zeros(64, 64, dtype=torch.bool)
    mask[10:20, 10:20] = True
    b[~mask] = 0.0
    inside = peak_signal_noise_ratio(a[10:20, 10:20].numpy(), b[10:20, 10:20].numpy(), data_range=1.0)
    assert abs(metrics.psnr(a, b, mask) - inside) < 1e-6
    assert metrics.psnr(a, a) == math.inf


def test_valid_ssim_agrees_with_scikit_image() -> None:
    a, b = pair()
    _, full = structural_similarity(
        a.numpy(), b.numpy(), channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, truncate=3.4, full=True,
    )  # fmt: skip
    assert abs(metrics.ssim_valid(a, b) - float(full[5:-5, 5:-5].mean())) < 1e-6


def test_zero_padded_ssim_agrees_with_a_plain_sum_over_windows() -> None:
    a, b = pair(24)
    window = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window = np.outer(window, window) / window.sum() ** 2
    values = []
    for channel in range(3):
        x, y = (np.pad(picture[..., channel].numpy(), 5) for picture in (a, b))
        for row in range(24):
            for column in range(24):
                u, v = (part[row : row + 11, column : column + 11] for part in (x, y))
                mu, mv = (window * u).sum(), (window * v).sum()
                uu, vv = (window * u * u).sum() - mu * mu, (window * v * v).sum() - mv * mv
                uv = (window * u * v).sum() - mu * mv
                values.append(
                    (2 * mu * mv + 1e-4) * (2 * uv + 9e-4) / ((mu * mu + mv * mv + 1e-4) * (uu + vv + 9e-4))
                )
    assert abs(metrics.ssim_zero_padded(a, b) - float(np.mean(values))) < 1e-9


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.4])
def test_ms_ssim_agrees_with_pytorch_msssim(noise: float) -> None:
    a, b = pair(192, noise)
    planes = (picture.permute(2, 0, 1)[None] for picture in (a, b))
    expected = pytorch_msssim.ms_ssim(*planes, data_range=1.0)
    assert abs(metrics.ms_ssim(a, b) - float(expected)) < 1e-6


def test_ms_ssim_is_one_for_equal_pictures_falls_with_noise_and_needs_room() -> None:
    a, b = pair(192, 0.05)
    _, c = pair(192, 0.3)
    assert abs(metrics.ms_ssim(a, a) - 1) < 1e-9
    assert 1 > metrics.ms_ssim(a, b) > metrics.ms_ssim(a, c) > 0
    assert math.isnan(metrics.ms_ssim(*pair(64)))


def test_8_bit_rounding() -> None:
    rounded = metrics.to_8bit(torch.tensor([-1.0, 0.4, 2.0], dtype=torch.float64))
    assert rounded.tolist() == [0.0, 102 / 255, 1.0]
