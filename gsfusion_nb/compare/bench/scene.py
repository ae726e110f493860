"""A random scene of Gaussians, about as slow to render as a dense map: the same number of them on
every pixel."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import se3
from ...geometry.spherical_harmonics import rgb_to_sh_dc
from ...render.constants import ALPHA_MIN
from ...types import Camera, GaussianParams

BORDER = 0.05
"""Centres may be outside the image by this fraction of its size."""

SCALE_SPREAD = 0.45
"""Standard deviation of the logarithm of a scale."""

_CAMERA_TWIST = (0.12, -0.08, 0.15, 0.11, -0.14, 0.06)
"""Translation (metres) and rotation vector (radians) of the camera, so that no matrix is trivially
the identity."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RandomScene:
    """Input for timing a rasteriser."""

    params: GaussianParams
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    v_rgb: Float[Tensor, "H W 3"]
    """dL/d of the picture: fixed random numbers."""

    def to(self, device: str) -> "RandomScene":
        """The same scene with its tensors on ``device``."""
        columns = {name: value.to(device) for name, value in vars(self.params).items()}
        return RandomScene(
            params=GaussianParams(**columns),
            camera=self.camera,
            T_WC=self.T_WC.to(device),
            v_rgb=self.v_rgb.to(device),
        )


def random_scene(
    n: int,
    width: int,
    height: int,
    *,
    sh_degree: int = 0,
    per_pixel: float = 30.0,
    seed: int = 0,
) -> RandomScene:
    """``n`` Gaussians in the view frustum between 2 and 6 m, about ``per_pixel`` of them visible at
    each pixel.

    Pixels of the centres and depths are uniform, opacities uniform in 0.1..0.95, orientations
    uniform, scales log-normal. A Gaussian of screen size s is above alpha = 1/255 on 2 pi s^2
    ln(255 o) pixels; s follows from that.

    Args:
        n: Number of Gaussians.
        width: Image width, pixels.
        height: Image height, pixels.
        sh_degree: Degree of the colours.
        per_pixel: Gaussians with alpha >= 1/255 at a pixel, on average.
        seed: The same seed gives the same scene.
    """
    g = torch.Generator().manual_seed(seed)
    focal = 0.78 * width
    camera = Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
    )
    twist = torch.tensor(_CAMERA_TWIST, dtype=torch.float64)
    T_WC = se3.exp(twist).float()
    z = 2 + 4 * torch.rand(n, generator=g)
    stretch = 1 + 2 * BORDER
    uv = (stretch * torch.rand(n, 2, generator=g) - BORDER) * torch.tensor([width, height])
    xyz_C = torch.cat(
        [(uv - torch.tensor([width, height]) / 2) / focal * z[:, None], z[:, None]],
        dim=1,
    )
    opacity = 0.1 + 0.85 * torch.rand(n, generator=g)
    pixels_per_gaussian = per_pixel * width * height * stretch**2 / max(n, 1)
    size_px = math.sqrt(
        pixels_per_gaussian
        / (2 * math.pi * float((opacity / ALPHA_MIN).log().mean() if n else 1.0))
    )
    jitter = SCALE_SPREAD * torch.randn(n, 3, generator=g)
    # The area is a product of two scales, whose mean is exp(spread^2); dividing by it gives
    # per_pixel on average.
    log_scale = (size_px * z / focal).log()[:, None] + jitter - SCALE_SPREAD**2 / 2
    sh = 0.1 * torch.randn(n, (sh_degree + 1) ** 2, 3, generator=g)
    sh[:, 0] = rgb_to_sh_dc(torch.rand(n, 3, generator=g))
    params = GaussianParams(
        xyz_W=se3.apply(T_WC, xyz_C),
        log_scale=log_scale,
        quat=torch.randn(n, 4, generator=g),
        opacity_logit=opacity.logit(),
        sh=sh,
    )
    v_rgb = torch.randn(height, width, 3, generator=g) / (width * height)
    return RandomScene(params=params, camera=camera, T_WC=T_WC, v_rgb=v_rgb)
