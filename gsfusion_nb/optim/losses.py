"""Losses of a picture and of its depth, and penalties on the Gaussians themselves, each with its
gradient beside it."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import op, piece
from ..checks import check_number
from ..geometry.operands import MASK, check_images, check_operand
from ..types import GaussianParams

C1 = 0.01**2
C2 = 0.03**2
"""Stabilisers of SSIM for images in 0..1 (Wang et al. 2004, section III-B)."""

WINDOW_PX = 11
WINDOW_SIGMA_PX = 1.5


def l1(
    rgb: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
) -> Float[Tensor, ""]:
    """Mean absolute difference over pixels and channels (GSFusion Eq. 12). Differentiable:
    ``l1_vjp``."""
    return (rgb - target).abs().mean()  # GSFusion Eq. 12


@piece
def l1_vjp(
    rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], v_loss: float = 1.0
) -> Float[Tensor, "H W 3"]:
    """dL/drgb = sign(rgb - target) / (number of values), zero where they are equal."""
    return v_loss * torch.sign(rgb - target) / rgb.numel()


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureLoss:
    """Loss of one view, its gradient, and the MSE of its PSNR. All are tensors, so the host does
    not wait."""

    value: Float[Tensor, ""]
    """Mean absolute or squared difference; the picture is not clamped."""
    mse: Float[Tensor, ""]
    """Mean squared difference of the picture clamped to 0..1, as it is shown."""
    v_rgb: Float[Tensor, "H W 3"]
    """Gradient of ``value``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewLoss:
    """What a loss that is given to a mapper returns for one view."""

    value: Float[Tensor, ""]
    v_rgb: Float[Tensor, "H W 3"]
    """dL/d of the rendered colours."""
    v_depth_m: Float[Tensor, "H W"] | None = None
    """dL/d of the rendered depth, 1/metres; None is zero."""

    def detached(self, like: Tensor) -> "ViewLoss":
        """Without an autograd graph, in the type and on the device of ``like``."""
        value = self.value.detach().to(like)
        v_rgb = self.v_rgb.detach().to(like)
        v_depth_m = None if self.v_depth_m is None else self.v_depth_m.detach().to(like)
        return ViewLoss(value=value, v_rgb=v_rgb, v_depth_m=v_depth_m)


def check_pictures(rgb: Any, target: Any, v_loss: float = 1.0) -> None:
    """Raise ``ValueError`` unless both images have the same size, type and device."""
    check_images(rgb=rgb, target=target)
    check_number("v_loss", v_loss)


@op("picture_loss", check_pictures)
def l1_mse_vjp(rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> PictureLoss:
    """What an optimisation step needs from a picture: ``l1``, ``l1_vjp`` and the MSE for its
    PSNR."""
    mse = (rgb.clamp(0, 1) - target).square().mean()
    return PictureLoss(
        value=l1(rgb, target),
        mse=mse,
        v_rgb=l1_vjp(rgb, target),
    )


@op("picture_loss", check_pictures)
def l2_mse_vjp(rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> PictureLoss:
    """As ``l1_mse_vjp``, of the mean squared difference.

    Its value is of the picture as it is, the MSE for the PSNR of the picture as shown: colours
    beyond 0..1 that the gradient pulls back count in the value only.
    """
    mse = (rgb.clamp(0, 1) - target).square().mean()
    return PictureLoss(
        value=(rgb - target).square().mean(),
        mse=mse,
        v_rgb=mse_vjp(rgb, target),
    )


def mse_vjp(
    rgb: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
) -> Float[Tensor, "H W 3"]:
    """Gradient of the mean squared difference over pixels and channels: 2 (rgb - target) / (number
    of values)."""
    return (rgb - target) * (2 / rgb.numel())


def depth_l1(
    depth_m: Float[Tensor, "H W"],
    target_m: Float[Tensor, "H W"],
) -> Float[Tensor, ""]:
    """Mean |D^ - D| over the pixels with measured depth (target above 0), metres; 0 without any.

    D^ is the blended depth sum_k w_k z_k as ``render`` gives it. It is not divided by alpha, so
    that a pixel that the map does not cover has a large error, which also pulls the opacity up.
    Differentiable: ``depth_l1_vjp``.

    Source: Keetha et al. 2024 (SplaTAM), the depth term of the mapping loss.
    """
    has_depth = target_m > 0
    n = has_depth.sum().clamp_min(1)
    return torch.where(has_depth, depth_m - target_m, 0.0).abs().sum() / n


def depth_l1_vjp(
    depth_m: Float[Tensor, "H W"], target_m: Float[Tensor, "H W"], v_loss: float = 1.0
) -> Float[Tensor, "H W"]:
    """dL/dD^ = sign(D^ - D) / (number of pixels with measured depth), zero elsewhere."""
    has_depth = target_m > 0
    n = has_depth.sum().clamp_min(1)
    return v_loss * torch.sign(torch.where(has_depth, depth_m - target_m, 0.0)) / n


def dssim(
    rgb: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
) -> Float[Tensor, ""]:
    """1 - mean SSIM with an 11 px Gaussian window of sigma 1.5, zero padding, channel by channel::

               (2 mu_x mu_y + C1)      (2 sigma_xy + C2)
        SSIM = ----------------------  ----------------------------
               (mu_x^2 + mu_y^2 + C1)  (sigma_x^2 + sigma_y^2 + C2)

    Differentiable: ``dssim_vjp``. Source: Wang et al. 2004, Eq. 13; its weight in GSFusion's global
    loss is 0.2.
    """
    A1, A2, B1, B2 = _ssim_factors(rgb, target)
    return 1.0 - (A1 * A2 / (B1 * B2)).mean()


@op("ssim", check_pictures)
def dssim_vjp(
    rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], v_loss: float = 1.0
) -> tuple[Float[Tensor, ""], Float[Tensor, "H W 3"]]:
    """Value and gradient of ``dssim``.

    SSIM depends on x = rgb through mu_x = G x, q = G x^2 and r = G (x y), where G is the window
    average. G is its own transpose, so  v_x = G v_mu + 2 x G v_q + y G v_r.
    """
    mu_x = window_mean(rgb)
    mu_y = window_mean(target)
    A1, A2, B1, B2 = _ssim_factors(rgb, target)
    S = A1 * A2 / (B1 * B2)
    v_S = -v_loss / rgb.numel()
    v_mu = v_S * (2 * mu_y * (A2 - A1) / (B1 * B2) + 2 * mu_x * S * (1 / B2 - 1 / B1))
    v_q = v_S * -S / B2
    v_r = v_S * 2 * A1 / (B1 * B2)
    v_rgb = window_mean(v_mu) + 2 * rgb * window_mean(v_q) + target * window_mean(v_r)
    return 1.0 - S.mean(), v_rgb


def _ssim_factors(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The two factors of SSIM's numerator and the two of its denominator, each [H, W, 3]."""
    mu_x = window_mean(x)
    mu_y = window_mean(y)
    variance_x = window_mean(x * x) - mu_x**2
    variance_y = window_mean(y * y) - mu_y**2
    covariance = window_mean(x * y) - mu_x * mu_y
    return (
        2 * mu_x * mu_y + C1,
        2 * covariance + C2,
        mu_x**2 + mu_y**2 + C1,
        variance_x + variance_y + C2,
    )


def window_mean(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Average around each pixel, weighted by the window; pixels outside the image count as zero."""
    from kornia.filters import gaussian_blur2d

    size = (WINDOW_PX, WINDOW_PX)
    sigma = (WINDOW_SIGMA_PX, WINDOW_SIGMA_PX)
    return gaussian_blur2d(
        image.permute(2, 0, 1)[None],
        size,
        sigma,
        border_type="constant",
    )[0].permute(1, 2, 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class RgbdLoss:
    """Value and gradient of the loss of one view. All are tensors, so the host need not wait for a
    GPU."""

    colour: Float[Tensor, ""]
    """Mean |C - C^| over the pixels and channels."""
    depth_m: Float[Tensor, ""]
    """Mean |D - D^| over the pixels that have both depths, metres."""
    total: Float[Tensor, ""]
    """w_c colour + w_d depth."""
    v_rgb: Float[Tensor, "H W 3"]
    v_depth_m: Float[Tensor, "H W"]


def check_rgbd(
    rgb: Any,
    depth_m: Any,
    target_rgb: Any,
    target_depth_m: Any,
    pixels: Any,
    **weights: float | None,
) -> None:
    """Raise ``ValueError`` for arguments that ``rgbd_l1_vjp`` refuses."""
    check_images(rgb=rgb, depth_m=depth_m, target_rgb=target_rgb, target_depth_m=target_depth_m)
    check_operand("pixels", pixels, tuple(depth_m.shape), dtypes=MASK, device=rgb.device)
    for name, value in weights.items():
        if value is not None:
            check_number(name, value)


@op("rgbd_loss", check_rgbd)
def rgbd_l1_vjp(
    rgb: Float[Tensor, "H W 3"],
    depth_m: Float[Tensor, "H W"],
    target_rgb: Float[Tensor, "H W 3"],
    target_depth_m: Float[Tensor, "H W"],
    pixels: Bool[Tensor, "H W"],
    *,
    weight_colour: float = 1.0,
    weight_depth: float = 1.0,
    behind_m: float | None = None,
) -> RgbdLoss:
    """L = w_c mean |C - C^| + w_d mean |D - D^| over ``pixels``, and dL/dC^, dL/dD^.

    Args:
        rgb, depth_m: Rendered, C^ and D^; depth 0 where no disc is hit, which has no depth loss.
        target_rgb, target_depth_m: Measured, C and D; depth 0 where missing.
        pixels: The pixels to compare. [H, W]
        weight_colour, weight_depth: w_c and w_d.
        behind_m: Depth rendered more than this behind the measurement has no loss, metres (released
            code).

    Differentiable: no; it returns the gradient, which is zero where both are equal.

    Source: Peng et al. 2024, Eq. 7-8. The third term of Eq. 8 is about Gaussians, not pixels:
    ``SurfelOptimiser``.
    """
    behind_m = math.inf if behind_m is None else behind_m
    has_depths = (
        pixels & (depth_m > 0) & (target_depth_m > 0) & (depth_m - target_depth_m < behind_m)
    )
    n = (3 * pixels.sum()).clamp_min(1)
    n_depths = has_depths.sum().clamp_min(1)
    colour_gap = torch.where(pixels[..., None], rgb - target_rgb, 0.0)
    depth_gap = torch.where(has_depths, depth_m - target_depth_m, 0.0)
    colour = colour_gap.abs().sum() / n  # RTG-SLAM Eq. 7
    depth = depth_gap.abs().sum() / n_depths
    return RgbdLoss(
        colour=colour,
        depth_m=depth,
        total=weight_colour * colour + weight_depth * depth,  # RTG-SLAM Eq. 8
        v_rgb=weight_colour * torch.sign(colour_gap) / n,
        v_depth_m=weight_depth * torch.sign(depth_gap) / n_depths,
    )


def anisotropy(log_scale: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    """Mean |s - s_mean| over Gaussians and axes, metres, with s_mean a Gaussian's mean standard
    deviation.

    Zero for round Gaussians, and for an empty map. Differentiable: ``anisotropy_vjp``.

    Source: Matsuki et al. 2024 (MonoGS), Eq. 10, as the mean that the released code takes.
    """
    s = log_scale.exp()
    return (s - s.mean(dim=1, keepdim=True)).abs().sum() / max(s.numel(), 1)


def anisotropy_vjp(
    log_scale: Float[Tensor, "N 3"],
    v_loss: float = 1.0,
) -> Float[Tensor, "N 3"]:
    """dL/dlog_scale = s (q - q_mean),  q = sign(s - s_mean) / (3 N)."""
    s = log_scale.exp()
    q = v_loss * torch.sign(s - s.mean(dim=1, keepdim=True)) / max(s.numel(), 1)
    return s * (q - q.mean(dim=1, keepdim=True))


def mean_scale(log_scale: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    """Mean standard deviation over Gaussians and axes, metres; 0 for an empty map. Differentiable:
    ``mean_scale_vjp``.

    Source: Kheradmand et al. 2024 (3DGS-MCMC), section 4: square roots of the covariance's
    eigenvalues.
    """
    return log_scale.exp().sum() / max(log_scale.numel(), 1)


def mean_scale_vjp(
    log_scale: Float[Tensor, "N 3"],
    v_loss: float = 1.0,
) -> Float[Tensor, "N 3"]:
    """dL/dlog_scale = s / (3 N)."""
    return v_loss * log_scale.exp() / max(log_scale.numel(), 1)


def mean_opacity(opacity_logit: Float[Tensor, " N"]) -> Float[Tensor, ""]:
    """Mean opacity over Gaussians; 0 for an empty map. Differentiable: ``mean_opacity_vjp``.

    Source: Kheradmand et al. 2024 (3DGS-MCMC), section 4.
    """
    return opacity_logit.sigmoid().sum() / max(opacity_logit.numel(), 1)


def mean_opacity_vjp(
    opacity_logit: Float[Tensor, " N"], v_loss: float = 1.0
) -> Float[Tensor, " N"]:
    """dL/dopacity_logit = o (1 - o) / N."""
    o = opacity_logit.sigmoid()
    return v_loss * o * (1 - o) / max(opacity_logit.numel(), 1)


def add_penalties_(
    gradients: GaussianParams,
    params: GaussianParams,
    *,
    isotropy: float,
    scale: float,
    opacity: float,
) -> Float[Tensor, ""]:
    """Add the gradients of the penalties to ``gradients``; a penalty of weight 0 is not computed.

    Args:
        gradients: dL/dparams so far, changed in place.
        params: The map.
        isotropy, scale, opacity: Weights of ``anisotropy``, ``mean_scale`` and ``mean_opacity``.

    Returns:
        The weighted sum of the penalties, on the device of the map.
    """
    loss = params.log_scale.new_zeros(())
    if isotropy > 0:
        loss = loss + isotropy * anisotropy(params.log_scale)
        gradients.log_scale.add_(anisotropy_vjp(params.log_scale, isotropy))
    if scale > 0:
        loss = loss + scale * mean_scale(params.log_scale)
        gradients.log_scale.add_(mean_scale_vjp(params.log_scale, scale))
    if opacity > 0:
        loss = loss + opacity * mean_opacity(params.opacity_logit)
        gradients.opacity_logit.add_(mean_opacity_vjp(params.opacity_logit, opacity))
    return loss
