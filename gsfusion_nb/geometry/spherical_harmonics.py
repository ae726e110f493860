"""View-dependent colour as real spherical harmonics up to degree 3: value, and gradient written out.

Sign and order of the basis are those of Kerbl et al. 2023: public viewers read the coefficients as they are.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import op
from ..constants import SH_C0

C1 = 0.4886025119029199  # sqrt(3 / 4 pi)
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)  # sqrt(15 / 4 pi), sqrt(5 / 16 pi), sqrt(15 / 16 pi)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
# sqrt(35 / 32 pi), sqrt(105 / 4 pi), sqrt(21 / 32 pi), sqrt(7 / 16 pi), sqrt(105 / 16 pi)


def sh_basis(dirs: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N K"]:
    """Basis functions Y_0 .. Y_{K-1} at unit directions, K = (degree + 1)^2.

    Args:
        dirs: Unit vectors. [N, 3]
        degree: 0 to 3.

    Raises:
        ValueError: for another degree.

    Differentiable: yes; ``sh_basis_vjp`` is its gradient.
    """
    _check_degree(degree)
    x, y, z = dirs.unbind(-1)
    Y = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        Y += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        Y += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy), -C2[0] * x * z, C2[2] * (xx - yy)]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
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


def sh_basis_vjp(dirs: Float[Tensor, "N 3"], degree: int, v_basis: Float[Tensor, "N K"]) -> Float[Tensor, "N 3"]:
    """dL/d dirs from dL/dY: the sum over k of v_k times the gradient of the polynomial Y_k of ``sh_basis``."""
    _check_degree(degree)
    x, y, z = dirs.T.contiguous()
    v = v_basis.T.contiguous()
    vx, vy, vz = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x)
    if degree >= 1:
        vx, vy, vz = -C1 * v[3], -C1 * v[1], C1 * v[2]
    if degree >= 2:
        a, b, c, d, e = C2[0] * v[4], C2[0] * v[5], 2 * C2[1] * v[6], C2[0] * v[7], 2 * C2[2] * v[8]
        vx = vx + a * y - c * x - d * z + e * x
        vy = vy + a * x - b * z - c * y - e * y
        vz = vz - b * y + 2 * c * z - d * x
    if degree >= 3:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        a, b, c, d = C3[0] * v[9], C3[1] * v[10], C3[2] * v[11], 3 * C3[3] * v[12]
        e, f, g = C3[2] * v[13], C3[4] * v[14], C3[0] * v[15]
        vx = vx - 6 * a * xy + b * yz + 2 * c * xy - 2 * d * xz - e * (4 * zz - 3 * xx - yy) + 2 * f * xz
        vx = vx - 3 * g * (xx - yy)
        vy = vy - 3 * a * (xx - yy) + b * xz - c * (4 * zz - xx - 3 * yy) - 2 * d * yz + 2 * e * xy - 2 * f * yz
        vy = vy + 6 * g * xy
        vz = vz + b * xy - 8 * c * yz + d * (2 * zz - xx - yy) - 8 * e * xz + f * (xx - yy)
    return torch.stack([vx, vy, vz], dim=-1)


@op("harmonics")
def sh_to_rgb(
    sh: Float[Tensor, "N K 3"], xyz_W: Float[Tensor, "N 3"], camera_centre_W: Float[Tensor, " 3"]
) -> Float[Tensor, "N 3"]:
    """Colour of each Gaussian seen from the camera: c = max(0, 1/2 + sum_k Y_k(d) sh_k), d = (x - o) / |x - o|.

    Args:
        sh: Coefficients; K = 1, 4, 9 or 16. [N, K, 3]
        xyz_W: Centres, world frame, metres. [N, 3]
        camera_centre_W: Camera centre o, world frame, metres. [3]

    Returns:
        rgb, not clamped above. [N, 3]

    Differentiable: ``sh_to_rgb_vjp`` (zero where the colour is clamped). Source: Kerbl et al. 2023, section 5.
    """
    return _linear_colour(sh, xyz_W, camera_centre_W)[0].clamp_(min=0.0)


@op("harmonics")
def sh_to_rgb_vjp(
    sh: Float[Tensor, "N K 3"],
    xyz_W: Float[Tensor, "N 3"],
    camera_centre_W: Float[Tensor, " 3"],
    v_rgb: Float[Tensor, "N 3"],
) -> tuple[Float[Tensor, "N K 3"], Float[Tensor, "N 3"]]:
    """Gradient of ``sh_to_rgb``: ``(v_sh, v_xyz_W)``.

    dL/dsh_k = Y_k v;  dL/dd = sum_k (sh_k . v) grad Y_k;  dL/dx = (v_d - d (d . v_d)) / |x - o|.
    v is v_rgb, but zero where the colour was clamped.
    """
    colour, basis, dirs, distance = _linear_colour(sh, xyz_W, camera_centre_W)
    v = v_rgb * (colour >= 0)
    v_sh = basis[:, :, None] * v[:, None, :]
    degree = _degree(sh)
    if degree == 0:
        return v_sh, torch.zeros_like(xyz_W)
    v_dirs = sh_basis_vjp(dirs, degree, torch.bmm(sh, v[:, :, None]).squeeze(-1))
    along = (dirs * v_dirs).sum(-1, keepdim=True)
    return v_sh, (v_dirs - dirs * along) / distance


def rgb_to_sh_dc(rgb: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """Coefficient of degree 0 that gives the colour ``rgb`` from everywhere: (rgb - 1/2) / Y_0. Differentiable: yes."""
    return (rgb - 0.5) / SH_C0


def _linear_colour(sh: Tensor, xyz_W: Tensor, camera_centre_W: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour before the clamp, with the basis, the directions and the distances that made it."""
    offset = xyz_W - camera_centre_W
    distance = offset.norm(dim=-1, keepdim=True).clamp_min(1e-12)  # a Gaussian in the camera's centre is not drawn
    dirs = offset / distance
    basis = sh_basis(dirs, _degree(sh))
    colour = torch.bmm(basis[:, None, :], sh).squeeze(1) + 0.5
    return colour, basis, dirs, distance


def _degree(sh: Tensor) -> int:
    K = sh.shape[1]
    if K not in (1, 4, 9, 16):
        raise ValueError(f"sh must be [N, K, 3] with K = 1, 4, 9 or 16 (degree 0 to 3), got {list(sh.shape)}")
    return round(K**0.5) - 1


def _check_degree(degree: int) -> None:
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree of the spherical harmonics must be 0, 1, 2 or 3, got {degree}")
