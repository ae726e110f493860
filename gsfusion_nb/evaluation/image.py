"""Difference between a rendered and a recorded image: PSNR and SSIM.

Images are RGB in 0..1, not cropped and not masked; an average over views is the mean of the
per-image numbers.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_shape
from ..errors import ArgumentError
from ..geometry import sum_rows

WINDOW_PX = 11

SIGMA_PX = 1.5
"""SSIM's Gaussian window and its standard deviation, pixels."""

C1 = 0.01**2

C2 = 0.03**2
"""SSIM's constants for images in 0..1."""

BORDER_PX = 5
"""Half of SSIM's window of 11 pixels, rounded down: nearer to the border the window is cut."""


def to_8bit_grid(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Clamp to 0..1 and round to the 256 levels of an 8-bit image, halves up. Differentiable:
    no."""
    return (rgb.clamp(0, 1) * 255 + 0.5).floor() / 255


def both_on_8bit_grid(rgb: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    """Both rounded to 8 bits, as when a render is stored and read back before it is scored."""
    check_shape("rgb", rgb, tuple(reference.shape))
    return to_8bit_grid(rgb), to_8bit_grid(reference)


def exact_mean(values: Tensor) -> float:
    """The mean in double precision, the same with any number of threads."""
    return float(sum_rows(values.double().flatten()) / values.numel())


def psnr(rgb: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]) -> float:
    """Peak signal-to-noise ratio, dB:  -10 log10 mean((a - b)^2), data range 1.

    Args:
        rgb: Image, 0..1 (clamped, and rounded to 8 bits, as all metrics do). [H, W, 3]
        reference: The image to compare with. [H, W, 3]

    Returns:
        Decibels; infinite for equal images.

    Differentiable: no. Source: the protocol of GSFusion's evaluation (torchmetrics, data range 1,
    8-bit images).
    """
    return psnr_of_levels(*both_on_8bit_grid(rgb, reference))


def psnr_of_levels(a: Tensor, b: Tensor) -> float:
    """PSNR of prepared images."""
    mse = exact_mean((a.double() - b.double()).square())
    return math.inf if mse == 0 else -10.0 * math.log10(mse)


def ssim(rgb: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]) -> float:
    """Structural similarity: mean over pixels and channels of the map with an 11x11 Gaussian
    window, sigma 1.5.

    C1 = 0.01^2, C2 = 0.03^2, reflected borders, population variances; the whole map is averaged, as
    torchmetrics does from 1.5.2 on.

    Args:
        rgb: Image, 0..1 (clamped); at least 6 pixels on each side. [H, W, 3]
        reference: The image to compare with. [H, W, 3]

    Returns:
        Between -1 and 1; 1 for equal images.

    Differentiable: no. Source: Wang et al. 2004.
    """
    return exact_mean(ssim_map(*both_on_8bit_grid(rgb, reference)))


def ssim_as_released(rgb: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]) -> float:
    """SSIM as in GSFusion's published tables: ``ssim`` without a border of 5 pixels, where the
    window is cut.

    torchmetrics up to 1.4 and scikit-image leave this border out, and the evaluation released with
    GSFusion uses torchmetrics of that time (its requirements name no version). It differs from
    ``ssim`` in the third digit. Use it only beside published numbers. Arguments and result are
    those of ``ssim``; the images have at least 11 pixels on each side.

    Differentiable: no. Source: GSFusion's released evaluation.
    """
    return exact_mean(without_border(ssim_map(*both_on_8bit_grid(rgb, reference), BORDER_PX + 6)))


def ssim_map(
    a: Tensor,
    b: Tensor,
    smallest: int = 6,
) -> Float[Tensor, "H W 3"]:
    """SSIM at each pixel of prepared images. On a processor OpenCV filters, in a fifth of the time
    of a convolution."""
    if min(a.shape[:2]) < smallest:
        raise ArgumentError(
            f"rgb must be at least {smallest} pixels high and wide for an 11x11 window, got "
            f"{[*a.shape]}"
        )
    filtered = _filtered_by_opencv if a.device.type == "cpu" else _filtered_by_torch
    mean_a, mean_b, mean_aa, mean_bb, mean_ab = (
        filtered(image) for image in (a, b, a * a, b * b, a * b)
    )
    aa = mean_a * mean_a
    bb = mean_b * mean_b
    ab = mean_a * mean_b
    variances = (mean_aa - aa) + (mean_bb - bb)
    return (2 * ab + C1) * (2 * (mean_ab - ab) + C2) / ((aa + bb + C1) * (variances + C2))


def _filtered_by_opencv(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Mean of the window of each pixel; the borders are reflected."""
    import cv2

    x = torch.arange(WINDOW_PX, dtype=image.dtype) - WINDOW_PX // 2
    weights = (-x.square() / (2 * SIGMA_PX**2)).exp()
    window = (weights / weights.sum()).numpy()
    pixels = image.detach().contiguous().numpy()
    return torch.from_numpy(
        cv2.sepFilter2D(pixels, -1, window, window, borderType=cv2.BORDER_REFLECT_101)
    )


def _filtered_by_torch(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    from kornia.filters import gaussian_blur2d

    planes = image.permute(2, 0, 1)[None]
    return gaussian_blur2d(planes, (WINDOW_PX, WINDOW_PX), (SIGMA_PX, SIGMA_PX))[0].permute(1, 2, 0)


def without_border(image: Tensor) -> Tensor:
    """The image without the pixels whose window reaches over its edge, ``BORDER_PX`` on each side.
    [H, W, ...]"""
    return image[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
