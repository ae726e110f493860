"""Rigid transforms as 4x4 matrices: inverse, application, exponential and logarithm."""

import torch
from jaxtyping import Float
from torch import Tensor

from . import quaternion


def inverse(T: Float[Tensor, "*B 4 4"]) -> Float[Tensor, "*B 4 4"]:
    """Inverse of a rigid transform: [R t]^-1 = [R^T  -R^T t]. Differentiable: yes."""
    R_inv = T[..., :3, :3].transpose(-1, -2)
    t_inv = -(R_inv @ T[..., :3, 3:])
    top = torch.cat([R_inv, t_inv], dim=-1)
    return torch.cat([top, T[..., 3:, :]], dim=-2)


def rigid(T: Float[Tensor, "*B 4 4"]) -> Float[Tensor, "*B 4 4"]:
    """The transform with the rotation nearest to that of ``T``, which products of rounded
    transforms have moved away from. Differentiable: no."""
    U, _, Vh = torch.linalg.svd(T[..., :3, :3])
    top = torch.cat([U @ Vh, T[..., :3, 3:]], dim=-1)
    return torch.cat([top, T[..., 3:, :]], dim=-2)


def apply(
    T: Float[Tensor, "4 4"],
    xyz: Float[Tensor, "*N 3"],
) -> Float[Tensor, "*N 3"]:
    """Points in the target frame of ``T``. Differentiable: yes."""
    return xyz @ T[:3, :3].T + T[:3, 3]


def rotate(
    T: Float[Tensor, "4 4"],
    direction: Float[Tensor, "*N 3"],
) -> Float[Tensor, "*N 3"]:
    """Directions in the target frame of ``T`` (rotation only). Differentiable: yes."""
    return direction @ T[:3, :3].T


def translate(
    T: Float[Tensor, "4 4"],
    by_m: Float[Tensor, " 3"],
) -> Float[Tensor, "4 4"]:
    """``T`` followed by a shift along the axes of its target frame: [R  t + by]. Differentiable:
    yes."""
    t = T[:3, 3:] + by_m[:, None]
    top = torch.cat([T[:3, :3], t], dim=1)
    return torch.cat([top, T[3:]])


def hat(omega: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Cross-product matrix: hat(a) b = a x b."""
    x, y, z = omega.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*omega.shape[:-1], 3, 3)


def adjoint(T: Float[Tensor, "*B 4 4"]) -> Float[Tensor, "*B 6 6"]:
    """Ad(T) = [[R, hat(t) R], [0, R]]: T exp(xi) = exp(Ad(T) xi) T, translation first.
    Differentiable: yes."""
    R = T[..., :3, :3]
    t = T[..., :3, 3]
    top = torch.cat([R, hat(t) @ R], dim=-1)
    bottom = torch.cat([torch.zeros_like(R), R], dim=-1)
    return torch.cat([top, bottom], dim=-2)


def small_adjoint(xi: Float[Tensor, "*B 6"]) -> Float[Tensor, "*B 6 6"]:
    """ad(xi) = [[hat(omega), hat(rho)], [0, hat(omega)]], with matrix exponential Ad(exp(xi)).
    Differentiable: yes."""
    rho = hat(xi[..., :3])
    omega = hat(xi[..., 3:])
    top = torch.cat([omega, rho], dim=-1)
    bottom = torch.cat([torch.zeros_like(rho), omega], dim=-1)
    return torch.cat([top, bottom], dim=-2)


def exp(xi: Float[Tensor, "*B 6"]) -> Float[Tensor, "*B 4 4"]:
    """Exponential map of a twist (translation part first, then rotation, radians). Differentiable:
    yes.

    Source: the closed form with A = sin t / t, B = (1 - cos t) / t^2, C = (t - sin t) / t^3 and
    their series near zero.
    """
    rho = xi[..., :3]
    omega = xi[..., 3:]
    t2 = (omega * omega).sum(-1)[..., None, None]
    small = t2 < 1e-4  # below it (t - sin t) loses too many digits, also in float32
    # two wheres: a single one still gives NaN gradients
    safe2 = torch.where(small, torch.ones_like(t2), t2)
    t = safe2.sqrt()
    A = torch.where(
        small,
        1 - t2 / 6 + t2 * t2 / 120,
        t.sin() / t,
    )
    B = torch.where(
        small,
        0.5 - t2 / 24 + t2 * t2 / 720,
        (1 - t.cos()) / safe2,
    )
    C = torch.where(
        small,
        1 / 6 - t2 / 120 + t2 * t2 / 5040,
        (t - t.sin()) / (safe2 * t),
    )
    W = hat(omega)
    W2 = W @ W
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device).expand_as(W)
    R = eye + A * W + B * W2
    V = eye + B * W + C * W2
    top = torch.cat([R, V @ rho[..., None]], dim=-1)
    bottom = xi.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*xi.shape[:-1], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def rotation_angle(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B"]:
    """Angle of a rotation matrix, radians, accurate at both ends (atan2 of its sine and cosine)."""
    difference = R - R.mT
    skew = torch.stack(
        [difference[..., 2, 1], difference[..., 0, 2], difference[..., 1, 0]],
        dim=-1,
    )
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(skew.norm(dim=-1), trace - 1)


def motion(
    T_a: Float[Tensor, "4 4"],
    T_b: Float[Tensor, "4 4"],
) -> tuple[float, float]:
    """How far apart two camera poses are: the angle in degrees, and the distance of their centres
    in metres."""
    T_a, T_b = (T.detach().cpu().double() for T in (T_a, T_b))
    angle_deg = rotation_angle(T_a[:3, :3].T @ T_b[:3, :3]).rad2deg()
    return float(angle_deg), float((T_a[:3, 3] - T_b[:3, 3]).norm())


def log(T: Float[Tensor, "*B 4 4"]) -> Float[Tensor, "*B 6"]:
    """Twist whose exponential is ``T``: translation part first, then rotation, radians, by an angle
    of at most pi.

    The rotation comes from its quaternion, 2 atan2(|v|, w) v / |v|, which loses no digits at either
    end; V^-1 is I - W/2 + D W^2 with D = (1 - (t/2) cot(t/2)) / t^2 and its series near zero.
    Differentiable: yes, below pi.
    """
    quat = quaternion.from_matrix(T[..., :3, :3])
    w = quat[..., :1]
    v = quat[..., 1:]
    v2 = (v * v).sum(-1, keepdim=True)
    small = v2 < 1e-8
    norm = torch.where(small, torch.ones_like(v2), v2).sqrt()  # two wheres, as in exp
    omega = v * torch.where(
        small,
        2 + v2 / 3,
        2 * torch.atan2(norm, w) / norm,
    )
    t2 = (omega * omega).sum(-1)[..., None, None]
    small2 = t2 < 1e-3  # the difference below loses t^-2 of its digits
    half = torch.where(small2, torch.ones_like(t2), t2).sqrt() / 2
    cot = half.cos() / half.sin()
    D = torch.where(
        small2,
        1 / 12 + t2 / 720 + t2 * t2 / 30240,
        (1 - half * cot) / (4 * half * half),
    )
    W = hat(omega)
    t = T[..., :3, 3:]
    rho = t - 0.5 * (W @ t) + D * (W @ (W @ t))
    return torch.cat([rho[..., 0], omega], dim=-1)
