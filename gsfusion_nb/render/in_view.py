"""Which Gaussians a camera may see: a fast test that never misses one."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..constants import ALPHA_MIN, FRUSTUM_CLAMP, NEAR_PLANE_M, SCREEN_BLUR_PX2
from ..geometry import se3
from ..types import Camera, GaussianParams


@torch.no_grad()
def rows_in_view(params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Bool[Tensor, " N"]:
    """Rows that may reach a pixel of the picture; the others change nothing in it and get no gradient from it.

    It bounds the box that ``project_gaussians`` computes: with s the largest standard deviation and |tx| <= c,

        cov_uu = |first row of J W R S|^2 + 0.3 <= (fx s / z)^2 (1 + c^2) + 0.3,     c = 1.3 half fields of view

    Args:
        params, camera, T_WC: as given to ``render``.

    Returns:
        True for every row that is drawn, and for a few others. [N]
    """
    x, y, z = se3.apply(se3.inverse(T_WC.to(params.xyz_W)), params.xyz_W).unbind(-1)
    opacity = params.opacity_logit.sigmoid()
    reach = 2 * (opacity / ALPHA_MIN).clamp_min(1.0).log()
    spread = (params.log_scale.amax(dim=1).exp() / z).square()

    def meets(along: Tensor, focal: float, centre: float, size: int) -> Tensor:
        """Whether the box reaches into the image, 0 to ``size`` pixels along one axis."""
        c = FRUSTUM_CLAMP * size / (2 * focal)
        variance = focal**2 * (1 + c**2) * spread + SCREEN_BLUR_PX2
        extent = (reach * variance).sqrt() * (1 + 1e-4)  # a little more, for rounding
        return (focal * along / z + centre - size / 2).abs() <= size / 2 + extent

    in_picture = meets(x, camera.fx, camera.cx, camera.width) & meets(y, camera.fy, camera.cy, camera.height)
    return in_picture & (z > NEAR_PLANE_M) & (opacity >= ALPHA_MIN)
