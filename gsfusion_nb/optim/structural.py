"""D-SSIM, the structural loss of a picture, and its gradient."""

from jaxtyping import Float
from torch import Tensor

from ..backends import op
from .losses import check_pictures

C1 = 0.01**2

C2 = 0.03**2
"""Stabilisers of SSIM for images in 0..1 (Wang et al. 2004, section III-B)."""

WINDOW_PX = 11

WINDOW_SIGMA_PX = 1.5


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
