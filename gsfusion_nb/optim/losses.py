"""Photometric losses, each with its explicit gradient beside it."""

import functools
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..backends import op

C1 = 0.01**2
C2 = 0.03**2
"""Stabilisers of SSIM for images in 0..1 (Wang et al. 2004)."""

WINDOW_PX = 11
WINDOW_SIGMA_PX = 1.5


def l1(rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Mean absolute difference over pixels and channels (GSFusion Eq. 12). Differentiable: ``l1_vjp``."""
    return (rgb - target).abs().mean()


def l1_vjp(rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], v_loss: float = 1.0) -> Float[Tensor, "H W 3"]:
    """dL/drgb = sign(rgb - target) / (number of values), zero where they are equal."""
    return torch.sign(rgb - target).mul_(v_loss / rgb.numel())


@dataclass(frozen=True, kw_only=True, eq=False)
class L1Loss:
    """``l1`` of one view, its gradient, and what its PSNR is made of. Tensors: an optimiser does not wait for them."""

    value: Float[Tensor, ""]
    """Mean absolute difference."""
    mse: Float[Tensor, ""]
    """Mean squared difference of the picture as it is shown, clamped to 0..1."""
    v_rgb: Float[Tensor, "H W 3"]


@op("l1_loss")
def l1_mse_vjp(rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> L1Loss:
    """What an optimisation step asks of a picture: ``l1``, ``l1_vjp`` and the error that its PSNR reports."""
    return L1Loss(
        value=l1(rgb, target), mse=(rgb.clamp(0, 1) - target).square().mean(), v_rgb=l1_vjp(rgb, target)
    )  # fmt: skip


def dssim(rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """1 - mean SSIM (Wang et al. 2004) with an 11 px Gaussian window of sigma 1.5, zero padding, channel by channel.

    Differentiable: ``dssim_vjp``.
    """
    S, _, _, _ = _ssim_terms(rgb, target)
    return 1.0 - S.mean()


@op("ssim")
def dssim_vjp(
    rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], v_loss: float = 1.0
) -> tuple[Float[Tensor, ""], Float[Tensor, "H W 3"]]:
    """Value and gradient of ``dssim`` in one pass, which share the window averages.

    With G the window average, mu = G x, q = G x^2, r = G xy:  v_x = G v_mu + 2 x G v_q + y G v_r.
    """
    S, v_mu, v_q, v_r = _ssim_terms(rgb, target)
    blurred = _window_mean(torch.cat([v_mu, v_q, v_r], dim=1)).mul_(-v_loss / rgb.numel())
    g_mu, g_q, g_r = (g[0].permute(1, 2, 0) for g in blurred.split(3, dim=1))
    return 1.0 - S.mean(), g_mu + 2 * rgb * g_q + target * g_r


def _ssim_terms(rgb: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """SSIM map and its derivatives by mu_x, G x^2 and G xy, each [1, 3, H, W]."""
    x, y = rgb.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None]
    mx, my, xx, yy, xy = _window_mean(torch.cat([x, y, x * x, y * y, x * y], dim=1)).split(3, dim=1)
    A1, A2 = 2 * mx * my + C1, 2 * (xy - mx * my) + C2
    B1, B2 = mx * mx + my * my + C1, (xx - mx * mx) + (yy - my * my) + C2
    S = A1 * A2 / (B1 * B2)
    v_mu = 2 * my * (A2 - A1) / (B1 * B2) + 2 * mx * S * (1 / B2 - 1 / B1)
    v_q = -S / B2
    v_r = 2 * A1 / (B1 * B2)
    return S, v_mu, v_q, v_r


def _window_mean(x: Float[Tensor, "1 C H W"]) -> Float[Tensor, "1 C H W"]:
    channels, half = x.shape[1], WINDOW_PX // 2
    window = _window(x.dtype, x.device)
    x = F.conv2d(x, window.reshape(1, 1, -1, 1).expand(channels, 1, -1, 1), padding=(half, 0), groups=channels)
    return F.conv2d(x, window.reshape(1, 1, 1, -1).expand(channels, 1, 1, -1), padding=(0, half), groups=channels)


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " K"]:
    offset = torch.arange(WINDOW_PX, dtype=torch.float64) - WINDOW_PX // 2
    weight = torch.exp(-0.5 * (offset / WINDOW_SIGMA_PX) ** 2)
    return (weight / weight.sum()).to(dtype).to(device)
