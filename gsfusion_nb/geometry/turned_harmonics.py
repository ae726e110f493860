"""Spherical harmonics after a rotation: the coefficients of a colour that turns with its Gaussian."""

import torch
from jaxtyping import Float
from torch import Tensor

from .spherical_harmonics import sh_basis


def turned_harmonics(sh: Float[Tensor, "N K 3"], R: Float[Tensor, "3 3"]) -> Float[Tensor, "N K 3"]:
    """Coefficients of the same colours after a rotation of the world: sum_k Y_k(R d) sh'_k = sum_k Y_k(d) sh_k.

    The functions of one degree stay among themselves under a rotation (Y(R d) = M Y(d), M orthogonal), so the two
    sides, written for more directions d than there are coefficients, determine each degree's matrix M. It is computed
    in float64.

    Args:
        sh: Coefficients; K = 1, 4, 9 or 16. [N, K, 3]
        R: Rotation matrix.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    d = torch.randn(64, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    d = d / d.norm(dim=1, keepdim=True)
    R = R.detach().to("cpu", torch.float64)
    before, after = sh_basis(d, degree), sh_basis(d @ R.T, degree)
    out = [sh[:, :1]]
    for l in range(1, degree + 1):  # noqa: E741
        band = slice(l * l, (l + 1) * (l + 1))
        M = torch.linalg.lstsq(after[:, band], before[:, band]).solution  # sh' = M sh
        M = torch.where((M - M.round()).abs() < 1e-9, M.round(), M)  # of a quarter turn they are 0, 1 and -1
        out.append(torch.einsum("jk,nkc->njc", M.to(sh.device), sh[:, band].double()).to(sh.dtype))
    return torch.cat(out, dim=1)
