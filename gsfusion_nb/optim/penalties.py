"""Penalties on the Gaussians of a map, and their gradients."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..types import GaussianParams


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
