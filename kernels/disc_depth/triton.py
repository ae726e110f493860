"""Disc depth of each pixel's hit and its gradient: one pass over the pixels, one over the
Gaussians.

The formulas are those of ``gsfusion_nb.render.disc``. A pixel makes its disc from the parameters:
cheaper than a table of discs. Pixels of one disc add their gradients by atomics, in an order that
changes from run to run.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false,
# reportIndexIssue=false

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.render import disc as reference
from gsfusion_nb.render.constants import DISC_MAX_OFFSET, DISC_MIN_COSINE
from gsfusion_nb.types import Camera, GaussianParams

from ..runtime.arguments import lens_of
from ..runtime.triton.launch import (
    device_of,
    launch,
    load3,
    load4,
    load_position,
    load_rotation,
    parts,
    rotation,
    store3,
    store4,
)

_BLOCK = 128

_V_P_X, _V_P_Y, _V_P_Z, _V_N_X, _V_N_Y, _V_N_Z = (tl.constexpr(column) for column in range(6))
_V_DISC = tl.constexpr(6)
"""dL/d of a disc's centre and normal, camera frame: a row of float32."""


def disc_depth(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    hit_index: Tensor,
    *,
    max_offset: float | None = DISC_MAX_OFFSET,
    min_cosine: float = DISC_MIN_COSINE,
) -> reference.DiscDepth:
    """See ``gsfusion_nb.render.disc_depth``. A row beyond the last is taken for no hit: the host
    would have to wait."""
    device = device_of("disc_depth", params.xyz_W)
    depth, normal = (
        torch.empty(*hit_index.shape, *n, dtype=torch.float32, device=device) for n in ((), (3,))
    )
    on_plane = torch.empty(hit_index.shape, dtype=torch.uint8, device=device)
    launch(
        _meet_all,
        parts(hit_index.numel(), _BLOCK),
        device,
        **_discs_of(params, T_WC, device),
        **_rays_of(camera, hit_index, max_offset, min_cosine),
        depth=depth,
        normal=normal,
        on_plane_image=on_plane,
        BLOCK=_BLOCK,
        num_warps=4,
    )
    return reference.DiscDepth(depth_m=depth, normal_W=normal, on_plane=on_plane.view(torch.bool))


def disc_depth_vjp(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    hit_index: Tensor,
    v_depth_m: Tensor,
    *,
    max_offset: float | None = DISC_MAX_OFFSET,
    min_cosine: float = DISC_MIN_COSINE,
    rows: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """See ``gsfusion_nb.render.disc_depth_vjp``."""
    device = device_of("disc_depth_vjp", params.xyz_W)
    discs = _discs_of(params, T_WC, device)
    N = len(params)
    v_disc = torch.zeros(N, _V_DISC.value, dtype=torch.float32, device=device)
    v_xyz, v_quat = (torch.empty(N, n, dtype=torch.float32, device=device) for n in (3, 4))
    launch(
        _meet_all_vjp,
        parts(hit_index.numel(), _BLOCK),
        device,
        **discs,
        **_rays_of(camera, hit_index, max_offset, min_cosine),
        trained=v_disc if rows is None else rows.contiguous().view(torch.uint8),
        v_depth=v_depth_m.detach().float().contiguous(),
        v_disc=v_disc,
        SOME=rows is not None,
        BLOCK=_BLOCK,
        num_warps=4,
    )
    axes = {name: discs[name] for name in ("log_scale", "quat", "T", "N")}
    launch(
        _axes_vjp,
        parts(N, _BLOCK),
        device,
        **axes,
        v_disc=v_disc,
        v_xyz=v_xyz,
        v_quat=v_quat,
        BLOCK=_BLOCK,
        num_warps=4,
    )
    return v_xyz, v_quat


def _discs_of(
    params: GaussianParams, T_WC: Tensor, device: torch.device
) -> dict[str, Tensor | int]:
    """The Gaussians and the pose."""
    arrays = {"xyz": params.xyz_W, "log_scale": params.log_scale, "quat": params.quat}
    arrays = {name: array.detach().contiguous() for name, array in arrays.items()}
    return {**arrays, "N": len(params), "T": T_WC.detach().to(device, torch.float32).contiguous()}


def _rays_of(
    camera: Camera, hit_index: Tensor, max_offset: float | None, min_cosine: float
) -> dict:
    """What each pixel hits, its ray, and where the ray may meet the disc."""
    return {
        "hit": hit_index.long().contiguous(),
        "width": camera.width,
        "total": camera.width * camera.height,
        **lens_of(camera)._asdict(),
        "max_offset": float("inf") if max_offset is None else float(max_offset),
        "min_cosine": float(min_cosine),
    }


@triton.jit
def _thin_axis(a, b, c):
    """Number of the smallest of three, the first of equals."""
    axis = tl.where(b < a, 1, 0)
    return tl.where(c < tl.minimum(a, b), 2, axis)


@triton.jit
def _pick(axis, a, b, c):
    return tl.where(axis == 0, a, tl.where(axis == 1, b, c))


@triton.jit
def _discs(xyz, log_scale, quat, T, g, mask):
    """Centres and normals in the camera frame, normals in the world frame, largest scales."""
    l0, l1, l2 = load3(log_scale, g, mask)
    axis = _thin_axis(l0, l1, l2)
    q0, q1, q2, q3 = load4(quat, g, mask)
    _, r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation(q0, q1, q2, q3)
    n0 = _pick(axis, r0, r1, r2)
    n1 = _pick(axis, r3, r4, r5)
    n2 = _pick(axis, r6, r7, r8)
    c0, c3, c6, c1, c4, c7, c2, c5, c8 = load_rotation(T)  # rows of R_CW
    X, Y, Z = load3(xyz, g, mask)
    C_x, C_y, C_z = load_position(T)
    X = X - C_x
    Y = Y - C_y
    Z = Z - C_z
    return (
        c0 * X + c1 * Y + c2 * Z,
        c3 * X + c4 * Y + c5 * Z,
        c6 * X + c7 * Y + c8 * Z,
        c0 * n0 + c1 * n1 + c2 * n2,
        c3 * n0 + c4 * n1 + c5 * n2,
        c6 * n0 + c7 * n1 + c8 * n2,
        n0,
        n1,
        n2,
        tl.exp(tl.maximum(l0, tl.maximum(l1, l2))),
    )


@triton.jit
def _meet(
    p0,
    p1,
    p2,
    m0,
    m1,
    m2,
    scale,
    x,
    y,
    max_offset,
    min_cosine,
):
    """z, r . n (1 off the plane), p . n and whether z is on the plane, for the rays (x, y, 1)."""
    rn = x * m0 + y * m1 + m2
    on_plane = tl.abs(rn) >= min_cosine * tl.sqrt(x * x + y * y + 1.0)
    rn = tl.where(on_plane, rn, 1.0)
    pn = p0 * m0 + p1 * m1 + p2 * m2
    z = pn / rn
    on_plane = on_plane & (z > 0) & (tl.abs(z - p2) <= max_offset * scale)
    return tl.where(on_plane, z, p2), rn, pn, on_plane


@triton.jit(do_not_specialize=["width", "total", "N"])
def _meet_all(
    xyz,
    log_scale,
    quat,
    T,
    hit,
    depth,
    normal,
    on_plane_image,
    width,
    total,
    N,
    fx,
    fy,
    cx,
    cy,
    max_offset,
    min_cosine,
    BLOCK: tl.constexpr,
):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < total
    g = tl.load(hit + at, mask=here, other=-1)
    met = (g >= 0) & (g < N)
    p0, p1, p2, m0, m1, m2, n0, n1, n2, scale = _discs(xyz, log_scale, quat, T, g, met)
    x = (at % width + 0.5 - cx) / fx
    y = (at // width + 0.5 - cy) / fy
    z, _, pn, on_plane = _meet(p0, p1, p2, m0, m1, m2, scale, x, y, max_offset, min_cosine)
    side = tl.where(met, tl.where(pn > 0, -1.0, 1.0), 0.0)
    tl.store(depth + at, tl.where(met, z, 0.0), mask=here)
    tl.store(on_plane_image + at, (met & on_plane).to(tl.uint8), mask=here)
    store3(normal, at, side * n0, side * n1, side * n2, here)


@triton.jit(do_not_specialize=["width", "total", "N"])
def _meet_all_vjp(
    xyz,
    log_scale,
    quat,
    T,
    hit,
    trained,
    v_depth,
    v_disc,
    width,
    total,
    N,
    fx,
    fy,
    cx,
    cy,
    max_offset,
    min_cosine,
    SOME: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add each pixel's gradients of centre and normal, camera frame, to ``v_disc`` [N, _V_DISC]."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < total
    g = tl.load(hit + at, mask=here, other=-1)
    met = (g >= 0) & (g < N)
    if SOME:
        met = met & (tl.load(trained + g, mask=met, other=0) != 0)
    p0, p1, p2, m0, m1, m2, _, _, _, scale = _discs(xyz, log_scale, quat, T, g, met)
    x = (at % width + 0.5 - cx) / fx
    y = (at // width + 0.5 - cy) / fy
    z, rn, _, on_plane = _meet(p0, p1, p2, m0, m1, m2, scale, x, y, max_offset, min_cosine)
    v = tl.load(v_depth + at, mask=met, other=0.0)
    v_plane = tl.where(on_plane, v / rn, 0.0)
    out = v_disc + _V_DISC * g
    tl.atomic_add(out + _V_P_X, v_plane * m0, mask=met & on_plane, sem="relaxed")
    tl.atomic_add(out + _V_P_Y, v_plane * m1, mask=met & on_plane, sem="relaxed")
    tl.atomic_add(out + _V_P_Z, v_plane * m2 + tl.where(on_plane, 0.0, v), mask=met, sem="relaxed")
    tl.atomic_add(out + _V_N_X, v_plane * (p0 - z * x), mask=met & on_plane, sem="relaxed")
    tl.atomic_add(out + _V_N_Y, v_plane * (p1 - z * y), mask=met & on_plane, sem="relaxed")
    tl.atomic_add(out + _V_N_Z, v_plane * (p2 - z), mask=met & on_plane, sem="relaxed")


@triton.jit(do_not_specialize=["N"])
def _axes_vjp(log_scale, quat, T, v_disc, v_xyz, v_quat, N, BLOCK: tl.constexpr):
    """To the world frame, and from the normal to the quaternion."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = i < N
    v = v_disc + _V_DISC * i
    a0, a1, a2 = load3(v + _V_P_X, 0, row)
    b0, b1, b2 = load3(v + _V_N_X, 0, row)
    k0, k1, k2, k3, k4, k5, k6, k7, k8 = load_rotation(T)
    store3(
        v_xyz,
        i,
        k0 * a0 + k1 * a1 + k2 * a2,
        k3 * a0 + k4 * a1 + k5 * a2,
        k6 * a0 + k7 * a1 + k8 * a2,
        row,
    )
    v0 = k0 * b0 + k1 * b1 + k2 * b2
    v1 = k3 * b0 + k4 * b1 + k5 * b2
    v2 = k6 * b0 + k7 * b1 + k8 * b2
    l0, l1, l2 = load3(log_scale, i, row)
    axis = _thin_axis(l0, l1, l2)
    e0 = _pick(axis, 1.0, 0.0, 0.0)
    e1 = _pick(axis, 0.0, 1.0, 0.0)
    e2 = _pick(axis, 0.0, 0.0, 1.0)
    w, x, y, z = load4(quat, i, row)
    norm = tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w = w / norm
    x = x / norm
    y = y / norm
    z = z / norm
    ue = x * e0 + y * e1 + z * e2
    uv = x * v0 + y * v1 + z * v2
    ev = e0 * v0 + e1 * v1 + e2 * v2
    c0 = y * e2 - z * e1
    c1 = z * e0 - x * e2
    c2 = x * e1 - y * e0
    v_w = 2.0 * (w * ev + v0 * c0 + v1 * c1 + v2 * c2)
    v_x = 2.0 * (ue * v0 + uv * e0 - ev * x + w * (e1 * v2 - e2 * v1))
    v_y = 2.0 * (ue * v1 + uv * e1 - ev * y + w * (e2 * v0 - e0 * v2))
    v_z = 2.0 * (ue * v2 + uv * e2 - ev * z + w * (e0 * v1 - e1 * v0))
    along = w * v_w + x * v_x + y * v_y + z * v_z
    v_w = v_w - w * along
    v_x = v_x - x * along
    v_y = v_y - y * along
    v_z = v_z - z * along
    store4(v_quat, i, v_w / norm, v_x / norm, v_y / norm, v_z / norm, row)
