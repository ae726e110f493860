"""What the host does before and after the kernels, whatever the backend."""

import torch
from torch import Tensor

from gsfusion_nb.tracking.normal_equations import IcpSystem
from gsfusion_nb.tracking.pyramid import DepthLevel
from gsfusion_nb.tracking.surface import Surface
from gsfusion_nb.types import Camera

B, SQUARES, WEIGHTS, INLIERS, OVERLAP = 21, 27, 28, 29, 30
"""Places of b, the two sums and the two counts among the 31 sums of a kernel; the upper triangle of H is first."""

_TRIANGLE = torch.tensor([[0, 1, 2, 3, 4, 5], [1, 6, 7, 8, 9, 10], [2, 7, 11, 12, 13, 14], [3, 8, 12, 15, 16, 17],
                          [4, 9, 13, 16, 18, 19], [5, 10, 14, 17, 19, 20]])  # fmt: skip
"""Where among the sums each entry of H is."""


def images_of(level: DepthLevel, surface: Surface) -> dict[str, Tensor]:
    """The four images that the kernels read."""
    return {
        "depth_m": level.depth_m,
        "normal_C": level.normal_C,
        "surface depth_m": surface.depth_m,
        "surface normal_W": surface.normal_W,
    }


def lens_of(camera: Camera) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy."""
    return float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)


def to_system(sums: Tensor) -> IcpSystem:
    """The normal equations from the kernels' sums over all pixels, float64 [31] on the CPU; H and b stay there."""
    squares, weights, inliers, overlap = sums[SQUARES:].tolist()
    return IcpSystem(
        H=sums[_TRIANGLE],
        b=sums[B:SQUARES],
        sum_squares_m2=squares,
        sum_weights=weights,
        n_inliers=int(inliers),
        n_overlap=int(overlap),
    )
