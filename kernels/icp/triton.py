"""Normal equations of point-to-plane ICP in one pass over the pixels of a frame.

The formulas are those of ``gsfusion_nb.tracking.icp``. A program sums 256 pixels in float32; the
programs' sums are added in float64. They repeat bit for bit.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false,
# reportIndexIssue=false

import dataclasses

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.tracking.icp_system import IcpSystem
from gsfusion_nb.tracking.icp_system import icp_system as reference
from gsfusion_nb.tracking.surface import DepthLevel, Surface, about_the_surface

from ..runtime.arguments import lens_of
from ..runtime.triton.launch import device_of, launch, load3, load_position, parts
from . import host
from .host import images_of, to_system

_BLOCK = 256
_H_0, _H_1, _H_2, _H_3, _H_4, _H_5 = (tl.constexpr(place) for place in host.H_ROWS)
_B = tl.constexpr(host.B)
_SQUARES = tl.constexpr(host.SQUARES)
_WEIGHTS = tl.constexpr(host.WEIGHTS)
_INLIERS = tl.constexpr(host.INLIERS)
_OVERLAP = tl.constexpr(host.OVERLAP)
_N_SUMS = tl.constexpr(host.N_SUMS)


def icp_system(
    level: DepthLevel,
    T_WC: Tensor,
    surface: Surface,
    *,
    max_distance_m: float,
    min_cosine: float,
    even_to_m: float | None = None,
) -> IcpSystem:
    """See ``gsfusion_nb.tracking.icp_system``. Poses may be on any device; H and b are on the
    pose's."""
    images = images_of(level, surface)
    if any(t.dtype != torch.float32 for t in images.values()):
        options = {
            "max_distance_m": max_distance_m,
            "min_cosine": min_cosine,
            "even_to_m": even_to_m,
        }
        return reference.reference(level, T_WC, surface, **options)
    device = device_of("icp_system", level.depth_m)
    T, R_WS = (
        pose.to(device) for pose in about_the_surface(T_WC.detach(), surface.T_WC, torch.float32)
    )
    depth, normal, surface_depth, surface_normal = (
        t.detach().contiguous() for t in images.values()
    )
    total = level.depth_m.numel()
    sums = torch.empty(parts(total, _BLOCK), _N_SUMS.value, dtype=torch.float32, device=device)
    launch(
        _sum,
        len(sums),
        device,
        depth=depth,
        normal=normal,
        surface_depth=surface_depth,
        surface_normal=surface_normal,
        T=T,
        R_WS=R_WS,
        sums=sums,
        width=level.camera.width,
        total=total,
        surface_width=surface.camera.width,
        surface_height=surface.camera.height,
        **lens_of(level.camera)._asdict(),
        **{f"surface_{name}": value for name, value in lens_of(surface.camera)._asdict().items()},
        max_square=float(max_distance_m) ** 2,
        min_cosine=float(min_cosine),
        even_to=float("inf") if even_to_m is None else float(even_to_m),
        BLOCK=_BLOCK,
        num_warps=4,
    )
    system = to_system(sums.sum(0, dtype=torch.float64).cpu())
    return dataclasses.replace(system, H=system.H.to(T_WC.device), b=system.b.to(T_WC.device))


@triton.jit
def _add_row(
    out,
    at: tl.constexpr,
    a,
    b0,
    b1,
    b2,
    b3,
    b4,
    b5,
    first: tl.constexpr,
):
    """Store the sums of ``a`` times those of the six columns from number ``first`` on, at
    ``out + at`` and behind."""
    if first <= 0:
        tl.store(out + at, tl.sum(a * b0, axis=0))
    if first <= 1:
        tl.store(out + at + 1 - first, tl.sum(a * b1, axis=0))
    if first <= 2:
        tl.store(out + at + 2 - first, tl.sum(a * b2, axis=0))
    if first <= 3:
        tl.store(out + at + 3 - first, tl.sum(a * b3, axis=0))
    if first <= 4:
        tl.store(out + at + 4 - first, tl.sum(a * b4, axis=0))
    tl.store(out + at + 5 - first, tl.sum(a * b5, axis=0))


@triton.jit
def _turn(R, ROW: tl.constexpr, x, y, z):
    """The product of a matrix, whose rows are ``ROW`` numbers apart, and a vector."""
    a = tl.load(R) * x + tl.load(R + 1) * y + tl.load(R + 2) * z
    b = tl.load(R + ROW) * x + tl.load(R + ROW + 1) * y + tl.load(R + ROW + 2) * z
    c = tl.load(R + 2 * ROW) * x + tl.load(R + 2 * ROW + 1) * y + tl.load(R + 2 * ROW + 2) * z
    return a, b, c


@triton.jit
def _turn_back(R, x, y, z):
    """The product of the transpose of a matrix [3, 3] and a vector."""
    a = tl.load(R) * x + tl.load(R + 3) * y + tl.load(R + 6) * z
    b = tl.load(R + 1) * x + tl.load(R + 4) * y + tl.load(R + 7) * z
    c = tl.load(R + 2) * x + tl.load(R + 5) * y + tl.load(R + 8) * z
    return a, b, c


@triton.jit(
    do_not_specialize=[
        "width",
        "total",
        "surface_width",
        "surface_height",
        "max_square",
        "min_cosine",
        "even_to",
    ]
)
def _sum(
    depth,
    normal,
    surface_depth,
    surface_normal,
    T,
    R_WS,
    sums,
    width,
    total,
    surface_width,
    surface_height,
    fx,
    fy,
    cx,
    cy,
    surface_fx,
    surface_fy,
    surface_cx,
    surface_cy,
    max_square,
    min_cosine,
    even_to,
    BLOCK: tl.constexpr,
):
    """The sums of ``host.to_system`` of each program. ``T``: T_WC about the centre of the surface's
    camera [4, 4]."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    z = tl.load(depth + at, mask=at < total, other=0.0)
    overlap = z > 0
    p0, p1, p2 = _turn(
        T, 4, z * ((at % width + 0.5 - cx) / fx), z * ((at // width + 0.5 - cy) / fy), z
    )
    C_x, C_y, C_z = load_position(T)
    p0 = p0 + C_x
    p1 = p1 + C_y
    p2 = p2 + C_z
    s0, s1, s2 = _turn_back(R_WS, p0, p1, p2)
    overlap = overlap & (s2 > 0)
    s2 = tl.where(overlap, s2, 1.0)
    u = surface_fx * (s0 / s2) + surface_cx
    v = surface_fy * (s1 / s2) + surface_cy
    overlap = overlap & (u >= 0) & (u < surface_width) & (v >= 0) & (v < surface_height)
    column = tl.where(overlap, u, 0.0).to(tl.int32)
    row = tl.where(overlap, v, 0.0).to(tl.int32)
    d = tl.load(surface_depth + row * surface_width + column, mask=overlap, other=0.0)
    n0, n1, n2 = load3(surface_normal, row * surface_width + column, overlap)
    overlap = overlap & (d > 0) & ((n0 != 0) | (n1 != 0) | (n2 != 0))
    x = d * ((column + 0.5 - surface_cx) / surface_fx)
    y = d * ((row + 0.5 - surface_cy) / surface_fy)
    q0, q1, q2 = _turn(R_WS, 3, x, y, d)
    e0 = p0 - q0
    e1 = p1 - q1
    e2 = p2 - q2
    a, b, c = load3(normal, at, overlap)
    a, b, c = _turn(T, 4, a, b, c)
    inlier = (
        overlap
        & (e0 * e0 + e1 * e1 + e2 * e2 <= max_square)
        & (n0 * a + n1 * b + n2 * c >= min_cosine)
    )
    near = tl.minimum(even_to / tl.where(inlier, z, 1.0), 1.0)
    # the square root of the weight, on both factors of each product
    w = tl.where(inlier, near * near, 0.0)
    r = tl.where(inlier, w * (e0 * n0 + e1 * n1 + e2 * n2), 0.0)
    n0 = w * n0
    n1 = w * n1
    n2 = w * n2
    m0 = p1 * n2 - p2 * n1
    m1 = p2 * n0 - p0 * n2
    m2 = p0 * n1 - p1 * n0
    out = sums + _N_SUMS * tl.program_id(0)
    _add_row(out, _H_0, n0, n0, n1, n2, m0, m1, m2, 0)
    _add_row(out, _H_1, n1, n0, n1, n2, m0, m1, m2, 1)
    _add_row(out, _H_2, n2, n0, n1, n2, m0, m1, m2, 2)
    _add_row(out, _H_3, m0, n0, n1, n2, m0, m1, m2, 3)
    _add_row(out, _H_4, m1, n0, n1, n2, m0, m1, m2, 4)
    _add_row(out, _H_5, m2, n0, n1, n2, m0, m1, m2, 5)
    _add_row(out, _B, r, n0, n1, n2, m0, m1, m2, 0)
    tl.store(out + _SQUARES, tl.sum(r * r, axis=0))
    tl.store(out + _WEIGHTS, tl.sum(w * w, axis=0))
    tl.store(out + _INLIERS, tl.sum(inlier.to(tl.float32), axis=0))
    tl.store(out + _OVERLAP, tl.sum(overlap.to(tl.float32), axis=0))
