"""Unit quaternions, wxyz: to and from rotation matrices, interpolation."""

import torch
from jaxtyping import Float
from torch import Tensor


def normalise(quat: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 4"]:
    """Unit quaternion of the same orientation. Differentiable: yes, away from zero."""
    return quat / quat.norm(dim=-1, keepdim=True).clamp_min(1e-12)


def to_matrix(quat: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3 3"]:
    """Rotation matrix of a quaternion, normalised first. Differentiable: yes."""
    w, x, y, z = normalise(quat).unbind(-1)
    return _matrix(
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


def to_matrix_vjp(
    quat: Float[Tensor, "*B 4"], v_R: Float[Tensor, "*B 3 3"]
) -> Float[Tensor, "*B 4"]:
    """Gradient of ``to_matrix``: dL/dq from dL/dR, with q the unit quaternion of ``quat``.

        v_k = sum_ij v_R[i, j] dR[i, j] / dq_k,     v_quat = (v - q (q . v)) / |quat|

    Source: Kerbl et al. 2023, appendix A (the derivatives of R); the second formula is that of the
    normalisation.
    """
    norm = quat.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    q = quat / norm
    w, x, y, z = q.unbind(-1)
    o = torch.zeros_like(w)
    dR_dw = 2 * _matrix(
        o,
        -z,
        y,
        z,
        o,
        -x,
        -y,
        x,
        o,
    )
    dR_dx = 2 * _matrix(
        o,
        y,
        z,
        y,
        -2 * x,
        -w,
        z,
        w,
        -2 * x,
    )
    dR_dy = 2 * _matrix(
        -2 * y,
        x,
        w,
        x,
        o,
        z,
        -w,
        z,
        -2 * y,
    )
    dR_dz = 2 * _matrix(
        -2 * z,
        -w,
        x,
        w,
        -2 * z,
        y,
        x,
        y,
        o,
    )
    derivatives = (dR_dw, dR_dx, dR_dy, dR_dz)
    v = torch.stack(
        [(v_R * dR).sum((-2, -1)) for dR in derivatives],
        dim=-1,
    )
    return (v - q * (q * v).sum(-1, keepdim=True)) / norm


def _matrix(*entries: Tensor) -> Tensor:
    """3x3 matrices from nine entries, row by row."""
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def from_matrix(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 4"]:
    """Unit quaternion with w >= 0 of a rotation matrix.

    Of the four classical formulas the one with the largest divisor is taken (Shepperd 1978), so it
    is stable near pi.
    """
    m = R.flatten(-2)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m.unbind(-1)
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1),
            torch.stack([m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20], -1),
            torch.stack([m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21], -1),
            torch.stack([m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22], -1),
        ],
        dim=-2,
    )
    best = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = best[..., None, None].expand(*best.shape, 1, 4)
    quat = candidates.gather(-2, row).squeeze(-2)
    quat = normalise(quat)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def slerp(
    a: Float[Tensor, "*B 4"],
    b: Float[Tensor, "*B 4"],
    t: Float[Tensor, "*B"],
) -> Float[Tensor, "*B 4"]:
    """Spherical interpolation along the shorter arc: ``a`` at t = 0, ``b`` at t = 1."""
    a = normalise(a)
    b = normalise(b)
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    angle = dot.abs().clamp(max=1.0).acos()
    t = t[..., None]
    is_small = angle < 1e-4
    sin = torch.where(is_small, torch.ones_like(angle), angle.sin())
    wa = torch.where(
        is_small,
        1 - t,
        ((1 - t) * angle).sin() / sin,
    )
    wb = torch.where(is_small, t, (t * angle).sin() / sin)
    return normalise(wa * a + wb * b)


def multiply(
    a: Float[Tensor, "*B 4"],
    b: Float[Tensor, "*B 4"],
) -> Float[Tensor, "*B 4"]:
    """Hamilton product: the rotation of ``b`` followed by that of ``a``. Differentiable: yes."""
    w = a[..., :1]
    u = a[..., 1:]
    x = b[..., :1]
    v = b[..., 1:]
    scalar = w * x - (u * v).sum(-1, keepdim=True)
    return torch.cat(
        [scalar, w * v + x * u + torch.linalg.cross(u, v)],
        dim=-1,
    )


def shortest_arc(
    a: Float[Tensor, "*B 3"],
    b: Float[Tensor, "*B 3"],
) -> Float[Tensor, "*B 4"]:
    """Unit quaternion that rotates unit vector ``a`` to unit vector ``b`` by the smaller angle.

    q = (1 + a.b, a x b) / |...|; opposite vectors are rotated about an axis perpendicular to ``a``.
    """
    scalar = 1 + (a * b).sum(-1, keepdim=True)
    least = torch.nn.functional.one_hot(a.abs().argmin(-1), 3).to(a)
    axis = torch.where(
        scalar > 1e-6,
        torch.linalg.cross(a, b),
        torch.linalg.cross(a, least),
    )
    return normalise(torch.cat([scalar.clamp_min(0.0) * (scalar > 1e-6), axis], dim=-1))
