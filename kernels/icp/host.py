"""What the host does before and after the kernels, whatever the backend."""

import torch
from torch import Tensor

from gsfusion_nb.tracking.icp_system import IcpSystem
from gsfusion_nb.tracking.surface import DepthLevel, Surface

H_ROWS = H_0, H_1, H_2, H_3, H_4, H_5 = 0, 6, 11, 15, 18, 20
"""Where among the sums of a kernel each row of H begins: with its entry on the diagonal, for H is
symmetric."""

B = 21
SQUARES = 27
WEIGHTS = 28
INLIERS = 29
OVERLAP = 30
"""Places of the six entries of b, the two sums and the two counts, behind those of H."""

N_SUMS = 31

_ENTRIES = torch.tensor([[H_ROWS[min(i, j)] + abs(i - j) for j in range(6)] for i in range(6)])
"""Where among the sums each entry of H is."""


def images_of(level: DepthLevel, surface: Surface) -> dict[str, Tensor]:
    """The four images that the kernels read."""
    return {
        "depth_m": level.depth_m,
        "normal_C": level.normal_C,
        "surface depth_m": surface.depth_m,
        "surface normal_W": surface.normal_W,
    }


def to_system(sums: Tensor) -> IcpSystem:
    """The normal equations from the kernels' sums over all pixels, float64 [31] on the CPU; H and b
    stay there."""
    return IcpSystem(
        H=sums[_ENTRIES],
        b=sums[B:SQUARES],
        sum_squares_m2=float(sums[SQUARES]),
        sum_weights=float(sums[WEIGHTS]),
        n_inliers=int(sums[INLIERS]),
        n_overlap=int(sums[OVERLAP]),
    )
