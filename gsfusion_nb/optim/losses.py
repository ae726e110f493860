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
