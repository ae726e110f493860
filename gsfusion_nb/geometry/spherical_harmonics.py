"""View-dependent colour as real spherical harmonics (SH) up to degree 3: value and gradient.

Sign and order of the basis are those of Kerbl et al. 2023: public viewers use the coefficients
unchanged.

``turned_harmonics`` gives the coefficients of a colour that turns with its Gaussian.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import piece
from ..errors import ArgumentError

SH_C0 = 0.28209479177387814
"""Spherical-harmonic basis function of degree 0, 1 / (2 sqrt(pi))."""
C1 = 0.4886025119029199  # sqrt(3 / 4 pi)
C2 = (
    1.0925484305920792,
    0.31539156525252005,
    0.5462742152960396,
)  # sqrt(15 / 4 pi), sqrt(5 / 16 pi), sqrt(15 / 16 pi)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)
# sqrt(35 / 32 pi), sqrt(105 / 4 pi), sqrt(21 / 32 pi), sqrt(7 / 16 pi), sqrt(105 / 16 pi)


def sh_basis(dirs: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N K"]:
    """Basis functions Y_0 .. Y_{K-1} at unit directions, K = (degree + 1)^2.

    Args:
        dirs: Unit vectors. [N, 3]
        degree: 0 to 3.

    Raises:
        ValueError: for another degree.

    Differentiable: yes; ``sh_basis_gradient`` has its derivatives.
    """
    _check_degree(degree)
    x, y, z = dirs.unbind(-1)
    Y = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        Y += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx = x * x
        yy = y * y
        zz = z * z
        Y += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2 * zz - xx - yy),
            -C2[0] * x * z,
            C2[2] * (xx - yy),
        ]
    if degree >= 3:
        xx = x * x
        yy = y * y
        zz = z * z
        Y += [
            -C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -C3[2] * x * (4 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3 * yy),
        ]
    return torch.stack(Y, dim=-1)


def sh_basis_gradient(dirs: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N K 3"]:
    """The derivatives of ``sh_basis``: row k holds (dY_k/dx, dY_k/dy, dY_k/dz) of the polynomial
    Y_k."""
    _check_degree(degree)
    x, y, z = dirs.unbind(-1)
    o = torch.zeros_like(x)
    dY = [(o, o, o)]
    if degree >= 1:
        dY += [(o, o - C1, o), (o, o, o + C1), (o - C1, o, o)]
    if degree >= 2:
        dY += [
            (C2[0] * y, C2[0] * x, o),
            (o, -C2[0] * z, -C2[0] * y),
            (-2 * C2[1] * x, -2 * C2[1] * y, 4 * C2[1] * z),
            (-C2[0] * z, o, -C2[0] * x),
            (2 * C2[2] * x, -2 * C2[2] * y, o),
        ]
    if degree >= 3:
        xx = x * x
        yy = y * y
        zz = z * z
        dY += [
            (-6 * C3[0] * x * y, -3 * C3[0] * (xx - yy), o),
            (C3[1] * y * z, C3[1] * x * z, C3[1] * x * y),
            (2 * C3[2] * x * y, -C3[2] * (4 * zz - xx - 3 * yy), -8 * C3[2] * y * z),
            (-6 * C3[3] * x * z, -6 * C3[3] * y * z, 3 * C3[3] * (2 * zz - xx - yy)),
            (-C3[2] * (4 * zz - 3 * xx - yy), 2 * C3[2] * x * y, -8 * C3[2] * x * z),
            (2 * C3[4] * x * z, -2 * C3[4] * y * z, C3[4] * (xx - yy)),
            (-3 * C3[0] * (xx - yy), 6 * C3[0] * x * y, o),
        ]
    return torch.stack([torch.stack(row, dim=-1) for row in dY], dim=1)


@piece
def sh_to_rgb(
    sh: Float[Tensor, "N K 3"],
    xyz_W: Float[Tensor, "N 3"],
    camera_centre_W: Float[Tensor, " 3"],
) -> Float[Tensor, "N 3"]:
    """Colour of each Gaussian seen from the camera: c = max(0, 1/2 + sum_k Y_k(d) sh_k), d = (x -
    o) / |x - o|.

    Args:
        sh: Coefficients; K = 1, 4, 9 or 16. [N, K, 3]
        xyz_W: Centres, world frame, metres. [N, 3]
        camera_centre_W: Camera centre o, world frame, metres. [3]

    Returns:
        rgb, not clamped above. [N, 3]

    Differentiable: ``sh_to_rgb_vjp`` (zero where the colour is clamped). Source: Kerbl et al. 2023,
    section 5.
    """
    d, _ = _direction(xyz_W, camera_centre_W)
    Y = sh_basis(d, _degree(sh))
    return (0.5 + torch.einsum("nk,nkc->nc", Y, sh)).clamp(min=0.0)


def sh_to_rgb_vjp(
    sh: Float[Tensor, "N K 3"],
    xyz_W: Float[Tensor, "N 3"],
    camera_centre_W: Float[Tensor, " 3"],
    v_rgb: Float[Tensor, "N 3"],
) -> tuple[Float[Tensor, "N K 3"], Float[Tensor, "N 3"]]:
    """Gradient of ``sh_to_rgb``: ``(v_sh, v_xyz_W)``."""
    d, distance = _direction(xyz_W, camera_centre_W)
    degree = _degree(sh)
    Y = sh_basis(d, degree)
    dY = sh_basis_gradient(d, degree)
    colour = 0.5 + torch.einsum("nk,nkc->nc", Y, sh)
    v = torch.where(colour >= 0, v_rgb, 0.0)  # no gradient where clamped
    v_sh = Y[:, :, None] * v[:, None, :]  # dL/dsh_k = Y_k v
    v_d = torch.einsum("nkc,nc,nkx->nx", sh, v, dY)  # dL/dd = sum_k (sh_k . v) dY_k/dd
    # dd/dx = (I - d d^T) / |x - o|
    v_xyz_W = (v_d - d * (d * v_d).sum(-1, keepdim=True)) / distance
    return v_sh, v_xyz_W


def rgb_to_sh_dc(rgb: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """Coefficient of degree 0 that gives the colour ``rgb`` from all directions: (rgb - 1/2) / Y_0.
    Differentiable: yes."""
    return (rgb - 0.5) / SH_C0


def _direction(xyz_W: Tensor, camera_centre_W: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector from the camera to each Gaussian, and the distance [N, 1]."""
    offset = xyz_W - camera_centre_W
    # a Gaussian in the camera's centre is not drawn
    distance = offset.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return offset / distance, distance


def _degree(sh: Tensor) -> int:
    K = sh.shape[1]
    if K not in (1, 4, 9, 16):
        raise ArgumentError(
            f"sh must be [N, K, 3] with K = 1, 4, 9 or 16 (degree 0 to 3), got {list(sh.shape)}"
        )
    return round(K**0.5) - 1


def _check_degree(degree: int) -> None:
    if degree not in (0, 1, 2, 3):
        raise ArgumentError(f"degree of the spherical harmonics must be 0, 1, 2 or 3, got {degree}")


def turned_harmonics(
    sh: Float[Tensor, "N K 3"],
    R: Float[Tensor, "3 3"],
) -> Float[Tensor, "N K 3"]:
    """Coefficients of the same colours after a rotation of the world: sum_k Y_k(R d) sh'_k = sum_k
    Y_k(d) sh_k.

    The functions of one degree stay among themselves under a rotation (Y(R d) = M Y(d), M
    orthogonal), so the two sides, written for more directions d than there are coefficients,
    determine each degree's matrix M. It is computed in float64.

    Args:
        sh: Coefficients; K = 1, 4, 9 or 16. [N, K, 3]
        R: Rotation matrix.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    d = torch.randn(
        64,
        3,
        dtype=torch.float64,
        generator=torch.Generator().manual_seed(0),
    )
    d = d / d.norm(dim=1, keepdim=True)
    R = R.detach().to("cpu", torch.float64)
    Y = sh_basis(d, degree)
    Y_turned = sh_basis(d @ R.T, degree)
    bands = [sh[:, :1]]
    for l in range(1, degree + 1):  # noqa: E741
        band = slice(l * l, (l + 1) * (l + 1))
        M = torch.linalg.lstsq(Y_turned[:, band], Y[:, band]).solution  # sh' = M sh
        # of a quarter turn they are 0, 1 and -1
        M = torch.where((M - M.round()).abs() < 1e-9, M.round(), M)
        bands.append(
            torch.einsum("jk,nkc->njc", M.to(sh.device), sh[:, band].double()).to(sh.dtype)
        )
    return torch.cat(bands, dim=1)
