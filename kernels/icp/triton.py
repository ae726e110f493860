"""Normal equations of point-to-plane ICP in one pass over the pixels of a frame.

The formulas are those of ``gsfusion_nb.tracking.normal_equations``. A program sums 256 pixels in float32; the programs'
sums are added in float64. They repeat bit for bit.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false

import functools

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.tracking.normal_equations import IcpSystem
from gsfusion_nb.tracking.normal_equations import icp_system as reference
from gsfusion_nb.tracking.pyramid import DepthLevel
from gsfusion_nb.tracking.surface import Surface
from gsfusion_nb.types import Camera

from ..project.triton import load3
from ..runtime.triton.launch import device_of, launch, parts

_BLOCK = 256
SUMS = 32
"""Of a program: upper triangle of H (21), b (6), sums of squares and weights, inliers, overlap, one to spare."""


def icp_system(
    level: DepthLevel,
    T_WC: Tensor,
    surface: Surface,
    *,
    max_distance_m: float,
    min_cosine: float,
    even_to_m: float | None = None,
) -> IcpSystem:
    """See ``gsfusion_nb.tracking.icp_system``. Poses may be on any device; H and b are on the pose's."""
    images = level.depth_m, level.normal_C, surface.depth_m, surface.normal_W
    if any(t.dtype != torch.float32 for t in images):
        options = {"max_distance_m": max_distance_m, "min_cosine": min_cosine, "even_to_m": even_to_m}
        return reference.reference(level, T_WC, surface, **options)
    names = ("depth_m", "normal_C", "surface depth_m", "surface normal_W")
    device = device_of("icp_system", **dict(zip(names, images, strict=True)))
    T_WS = surface.T_WC.detach().double().to(T_WC.device)
    T = T_WC.detach().double().clone()
    T[:3, 3] -= T_WS[:3, 3]
    pose = torch.cat([T[:3].flatten(), T_WS[:3, :3].flatten()]).float().to(device)
    total = level.depth_m.numel()
    sums = torch.empty(parts(total, _BLOCK), SUMS, dtype=torch.float32, device=device)
    launch(
        _sum, len(sums), device, *(t.detach().contiguous() for t in images), pose, sums,
        level.camera.width, total, surface.camera.width, surface.camera.height, *_lens(level.camera),
        *_lens(surface.camera), float(max_distance_m) ** 2, float(min_cosine),
        float("inf") if even_to_m is None else float(even_to_m), BLOCK=_BLOCK, num_warps=4,
    )  # fmt: skip
    summed = sums.sum(0, dtype=torch.float64).cpu()
    squares, weights, inliers, overlap = summed[27:31].tolist()
    return IcpSystem(
        H=summed[_TRIANGLE].view(6, 6).to(T_WC.device),
        b=summed[21:27].to(T_WC.device),
        sum_squares_m2=squares,
        sum_weights=weights,
        n_inliers=int(inliers),
        n_overlap=int(overlap),
    )


_TRIANGLE = torch.tensor([[0, 1, 2, 3, 4, 5], [1, 6, 7, 8, 9, 10], [2, 7, 11, 12, 13, 14], [3, 8, 12, 15, 16, 17],
                          [4, 9, 13, 16, 18, 19], [5, 10, 14, 17, 19, 20]]).flatten()  # fmt: skip
"""Where among the sums each entry of H stands."""


@functools.lru_cache(maxsize=16)
def _lens(camera: Camera) -> tuple[float, ...]:
    return tuple(float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))


@triton.jit
def _add_row(out, at: tl.constexpr, a, b0, b1, b2, b3, b4, b5, first: tl.constexpr):
    """Store the sums of ``a`` times those of the six columns from number ``first`` on."""
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


@triton.jit(do_not_specialize=["width", "total", "wide", "high", "max_square", "min_cosine", "even_to"])
def _sum(
    depth, normal, surface_depth, surface_normal, pose, sums, width, total, wide, high, fx, fy, cx, cy,
    gx, gy, hx, hy, max_square, min_cosine, even_to, BLOCK: tl.constexpr,
):  # fmt: skip
    """``pose``: T_WC by rows [3, 4], about the surface's camera centre, then R_WS [3, 3]."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    z = tl.load(depth + at, mask=at < total, other=0.0)
    overlap = z > 0
    x, y = z * ((at % width + 0.5 - cx) / fx), z * ((at // width + 0.5 - cy) / fy)
    p0 = tl.load(pose) * x + tl.load(pose + 1) * y + tl.load(pose + 2) * z + tl.load(pose + 3)
    p1 = tl.load(pose + 4) * x + tl.load(pose + 5) * y + tl.load(pose + 6) * z + tl.load(pose + 7)
    p2 = tl.load(pose + 8) * x + tl.load(pose + 9) * y + tl.load(pose + 10) * z + tl.load(pose + 11)
    r0, r1, r2 = tl.load(pose + 12), tl.load(pose + 13), tl.load(pose + 14)
    r3, r4, r5 = tl.load(pose + 15), tl.load(pose + 16), tl.load(pose + 17)
    r6, r7, r8 = tl.load(pose + 18), tl.load(pose + 19), tl.load(pose + 20)
    s2 = r2 * p0 + r5 * p1 + r8 * p2
    overlap = overlap & (s2 > 0)
    s2 = tl.where(overlap, s2, 1.0)
    u, v = gx * ((r0 * p0 + r3 * p1 + r6 * p2) / s2) + hx, gy * ((r1 * p0 + r4 * p1 + r7 * p2) / s2) + hy
    overlap = overlap & (u >= 0) & (u < wide) & (v >= 0) & (v < high)
    column, row = tl.where(overlap, u, 0.0).to(tl.int32), tl.where(overlap, v, 0.0).to(tl.int32)
    d = tl.load(surface_depth + row * wide + column, mask=overlap, other=0.0)
    n0, n1, n2 = load3(surface_normal, row * wide + column, overlap)
    overlap = overlap & (d > 0) & ((n0 != 0) | (n1 != 0) | (n2 != 0))
    x, y = d * ((column + 0.5 - hx) / gx), d * ((row + 0.5 - hy) / gy)
    e0, e1, e2 = p0 - (r0 * x + r1 * y + r2 * d), p1 - (r3 * x + r4 * y + r5 * d), p2 - (r6 * x + r7 * y + r8 * d)
    a, b, c = load3(normal, at, overlap)
    cosine = n0 * (tl.load(pose) * a + tl.load(pose + 1) * b + tl.load(pose + 2) * c)
    cosine += n1 * (tl.load(pose + 4) * a + tl.load(pose + 5) * b + tl.load(pose + 6) * c)
    cosine += n2 * (tl.load(pose + 8) * a + tl.load(pose + 9) * b + tl.load(pose + 10) * c)
    inlier = overlap & (e0 * e0 + e1 * e1 + e2 * e2 <= max_square) & (cosine >= min_cosine)
    near = tl.minimum(even_to / tl.where(inlier, z, 1.0), 1.0)
    w = tl.where(inlier, near * near, 0.0)  # the square root of the weight, on both factors of each product
    r = tl.where(inlier, w * (e0 * n0 + e1 * n1 + e2 * n2), 0.0)
    n0, n1, n2 = w * n0, w * n1, w * n2
    q0, q1, q2 = p1 * n2 - p2 * n1, p2 * n0 - p0 * n2, p0 * n1 - p1 * n0
    out = sums + 32 * tl.program_id(0)
    _add_row(out, 0, n0, n0, n1, n2, q0, q1, q2, 0)
    _add_row(out, 6, n1, n0, n1, n2, q0, q1, q2, 1)
    _add_row(out, 11, n2, n0, n1, n2, q0, q1, q2, 2)
    _add_row(out, 15, q0, n0, n1, n2, q0, q1, q2, 3)
    _add_row(out, 18, q1, n0, n1, n2, q0, q1, q2, 4)
    _add_row(out, 20, q2, n0, n1, n2, q0, q1, q2, 5)
    _add_row(out, 21, r, n0, n1, n2, q0, q1, q2, 0)
    tl.store(out + 27, tl.sum(r * r, axis=0))
    tl.store(out + 28, tl.sum(w * w, axis=0))
    tl.store(out + 29, tl.sum(inlier.to(tl.float32), axis=0))
    tl.store(out + 30, tl.sum(overlap.to(tl.float32), axis=0))
    tl.store(out + 31, 0.0)
