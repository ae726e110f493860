"""Losses of a picture and of its depth, each with its gradient beside it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import op, piece
from ..checks import check_number
from ..geometry.operands import check_images


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
    v_alpha: Float[Tensor, "H W"] | None = None
    """dL/d of the rendered alpha; None is zero."""
    v_params: Mapping[str, Tensor] | None = None
    """dL/d of parameters of the Gaussians themselves, by the name of the column, for the rows of
    ``TrainingView.params``: "log_scale" [R, 3]. Those of the picture are not in it. None is
    zero."""

    def detached(self, like: Tensor) -> "ViewLoss":
        """Without an autograd graph, in the type and on the device of ``like``."""

        def plain(value: Tensor | None) -> Tensor | None:
            return None if value is None else value.detach().to(like)

        params = self.v_params and {name: v.detach().to(like) for name, v in self.v_params.items()}
        return ViewLoss(
            value=self.value.detach().to(like),
            v_rgb=self.v_rgb.detach().to(like),
            v_depth_m=plain(self.v_depth_m),
            v_alpha=plain(self.v_alpha),
            v_params=params,
        )


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


LEAST_ALPHA = 0.5
"""Below this alpha a pixel counts as not covered by the map, as in the score of the depth
(``evaluation.expected_depth_m``)."""


def expected_depth_l1(
    depth_m: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    target_m: Float[Tensor, "H W"],
    coverage: float = 0.0,
) -> Float[Tensor, ""]:
    """Mean |D^ / max(A, 1/2) - D| + k D (1 - A) over the pixels with measured depth (target above
    0), metres; 0 without any.

    D^ = sum_k w_k z_k is the blended depth and A = sum_k w_k alpha, so D^ / A is the mean depth of
    what a pixel shows. ``depth_l1`` does not divide: it is least where D^ = D, and there the mean
    depth is D / A, behind the surface by (1 - A) / A of its distance. What it does besides is to
    close holes: where z = D its error is D (1 - A). The second term does that, with the weight k.
    Differentiable: ``expected_depth_l1_vjp``.

    Args:
        depth_m: Blended depth, metres. [H, W]
        alpha: Alpha of the picture, 0 to 1. [H, W]
        target_m: Measured depth, metres; 0: missing. [H, W]
        coverage: k, at least 0.

    Source: ours; docs/gsfusion.md has what it changes.
    """
    error_m = _expected_depth_error(depth_m, alpha, target_m).abs()
    hole_m = target_m * (1 - alpha)
    return (error_m + coverage * hole_m).sum() / (target_m > 0).sum().clamp_min(1)


def expected_depth_l1_vjp(
    depth_m: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    target_m: Float[Tensor, "H W"],
    coverage: float = 0.0,
    v_loss: float = 1.0,
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """dL/dD^ = s / (n a) and dL/dA = -s D^ / (n a^2) - k D / n, with s the sign of the error, n the
    number of pixels with measured depth and a = max(A, 1/2); the first part of dL/dA is zero where
    A is below 1/2."""
    n = (target_m > 0).sum().clamp_min(1)
    sign = torch.sign(_expected_depth_error(depth_m, alpha, target_m))
    divisor = alpha.clamp_min(LEAST_ALPHA)
    v_depth_m = v_loss * sign / (n * divisor)
    v_alpha = torch.where(alpha < LEAST_ALPHA, 0.0, -v_depth_m * depth_m / divisor)
    return v_depth_m, v_alpha - v_loss * coverage * target_m / n


def _expected_depth_error(
    depth_m: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"], target_m: Float[Tensor, "H W"]
) -> Float[Tensor, "H W"]:
    """D^ / max(A, 1/2) - D, metres; 0 where nothing was measured."""
    return torch.where(target_m > 0, depth_m / alpha.clamp_min(LEAST_ALPHA) - target_m, 0.0)
