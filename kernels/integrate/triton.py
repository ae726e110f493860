"""Fold a frame into the volume: one program a block, which first asks whether the view can observe any of its voxels.

As in the reference, a block's homogeneous pixel coordinates are one corner, in float64, plus 512 offsets. Hidden blocks
are not told apart beforehand: their voxels read the depth image, which stays in the cache, and nothing else.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportGeneralTypeIssues=false

import functools

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.constants import VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Camera, Frame

from ..runtime.lens import lens_of
from ..runtime.triton.launch import device_of, launch
from ..runtime.triton.vectors import load_position

_FX, _FY, _CX, _CY, _VOXEL_SIZE = (tl.constexpr(place) for place in range(5))
"""What of the camera and the map goes to the kernel in float64."""
_EPS = tl.constexpr(1e-4)
_MISSING = tl.constexpr(-1e9)


def fuse_frame_(volume: TsdfVolume, frame: Frame) -> int:
    """See ``gsfusion_nb.tsdf.integrate.fuse_frame_``; the published averages are left to the reference."""
    if volume.config.average != "mean" or any(t.dtype != torch.float32 for t in (frame.depth_m, frame.rgb, volume.D)):
        return reference.reference(volume, frame)
    device = device_of("fuse_frame_", volume=volume.D, depth_m=frame.depth_m, rgb=frame.rgb)
    if not volume.n_blocks:
        return 0
    camera, config = frame.camera, volume.config
    counts = torch.empty(volume.n_blocks, dtype=torch.int32, device=device)
    pose = frame.T_WC.detach().to(device).contiguous()
    launch(
        _fuse,
        volume.n_blocks,
        device,
        coords=volume.block_coords,
        D=volume.D,
        W=volume.W,
        colours=volume.rgb_planes,
        depth=frame.depth_m.detach().contiguous(),
        rgb=frame.rgb.detach().contiguous(),
        T=pose,
        lens=_lens(camera, config.voxel_size_m, device),
        counts=counts,
        width=camera.width,
        height=camera.height,
        near=float(config.near_m),
        far=float(config.far_m),
        truncation=float(config.truncation_m),
        max_weight=float(config.max_weight),
        RAY=config.sdf == "ray",
        VOXELS=VOXELS_PER_BLOCK,
        num_warps=4,
    )
    return int(counts.sum())


@functools.lru_cache(maxsize=16)
def _lens(camera: Camera, voxel_size_m: float, device: torch.device) -> Tensor:
    """fx, fy, cx, cy and the voxel's edge, float64: a number passed to a kernel is float32."""
    return torch.tensor([*lens_of(camera), voxel_size_m], dtype=torch.float64, device=device)


@triton.jit
def _turn(T, row, x, y, z):
    """Coordinate ``row`` of R_CW (x, y, z), float64: a column of R_WC times the vector."""
    a, b, c = tl.load(T + row).to(tl.float64), tl.load(T + 4 + row).to(tl.float64), tl.load(T + 8 + row).to(tl.float64)
    return a * x + b * y + c * z


@triton.jit
def _in_view(x, z, f, c, size, radius):
    """Whether a sphere reaches between the two side planes of the view, f x = low z and f x = high z."""
    low, high = -c, size - c
    return (f * x - low * z > -radius * tl.sqrt(f * f + low * low)) & (
        high * z - f * x > -radius * tl.sqrt(f * f + high * high)
    )


@triton.jit(do_not_specialize=["width", "height", "near", "far", "truncation", "max_weight"])
def _fuse(
    coords, D, W, colours, depth, rgb, T, lens, counts, width, height, near, far, truncation, max_weight,
    RAY: tl.constexpr, VOXELS: tl.constexpr,
):  # fmt: skip
    """counts [blocks]: how many voxels of each block were observed."""
    b = tl.program_id(0)
    fx, fy, cx, cy = tl.load(lens + _FX), tl.load(lens + _FY), tl.load(lens + _CX), tl.load(lens + _CY)
    voxel = tl.load(lens + _VOXEL_SIZE)
    side = 8 * voxel
    C_x, C_y, C_z = load_position(T)
    x = tl.load(coords + 3 * b).to(tl.float64) * side - C_x.to(tl.float64)
    y = tl.load(coords + 3 * b + 1).to(tl.float64) * side - C_y.to(tl.float64)
    z = tl.load(coords + 3 * b + 2).to(tl.float64) * side - C_z.to(tl.float64)
    x_C, y_C, z_C = _turn(T, 0, x, y, z), _turn(T, 1, x, y, z), _turn(T, 2, x, y, z)
    h = 0.5 * side
    mx, my = (x_C + _turn(T, 0, h, h, h)).to(tl.float32), (y_C + _turn(T, 1, h, h, h)).to(tl.float32)
    mz = (z_C + _turn(T, 2, h, h, h)).to(tl.float32)
    half = h.to(tl.float32)
    radius = 1.7320509 * half
    half_z = half * (tl.abs(tl.load(T + 2)) + tl.abs(tl.load(T + 6)) + tl.abs(tl.load(T + 10))).to(tl.float32)
    seen = (mz > -half_z) & (mz < far + truncation + half_z)
    seen = seen & _in_view(mx, mz, fx.to(tl.float32), cx.to(tl.float32), width + 0.0, radius)
    seen = seen & _in_view(my, mz, fy.to(tl.float32), cy.to(tl.float32), height + 0.0, radius)
    updated = 0
    if seen:
        # (U, V, Z) of the corner, and what a voxel's step along each axis adds; one is added to the pixel so that a
        # conversion to int, which rounds towards zero, finds it
        n = tl.arange(0, VOXELS)
        i, j, k = (n >> 6) + 0.5, ((n >> 3) & 7) + 0.5, (n & 7) + 0.5
        sx0, sx1, sx2 = _turn(T, 0, voxel, 0.0, 0.0), _turn(T, 0, 0.0, voxel, 0.0), _turn(T, 0, 0.0, 0.0, voxel)
        sy0, sy1, sy2 = _turn(T, 1, voxel, 0.0, 0.0), _turn(T, 1, 0.0, voxel, 0.0), _turn(T, 1, 0.0, 0.0, voxel)
        sz0, sz1, sz2 = _turn(T, 2, voxel, 0.0, 0.0), _turn(T, 2, 0.0, voxel, 0.0), _turn(T, 2, 0.0, 0.0, voxel)
        cx1, cy1 = cx + 1.0, cy + 1.0
        U = (fx * x_C + cx1 * z_C).to(tl.float32) + (
            (fx * sx0 + cx1 * sz0).to(tl.float32) * i
            + (fx * sx1 + cx1 * sz1).to(tl.float32) * j
            + (fx * sx2 + cx1 * sz2).to(tl.float32) * k
        )
        V = (fy * y_C + cy1 * z_C).to(tl.float32) + (
            (fy * sy0 + cy1 * sz0).to(tl.float32) * i
            + (fy * sy1 + cy1 * sz1).to(tl.float32) * j
            + (fy * sy2 + cy1 * sz2).to(tl.float32) * k
        )
        away = z_C.to(tl.float32) + (sz0.to(tl.float32) * i + sz1.to(tl.float32) * j + sz2.to(tl.float32) * k)
        in_front = away >= _EPS
        inv_z = 1.0 / tl.where(in_front, away, 1.0)
        u, v = U * inv_z, V * inv_z
        inside = in_front & (u >= 1.0) & (u < width + 1.0) & (v >= 1.0) & (v < height + 1.0)
        pixel = tl.where(inside, v, 1.0).to(tl.int32) * width + tl.where(inside, u, 1.0).to(tl.int32) - (width + 1)
        d = tl.load(depth + pixel, mask=inside, other=0.0)
        known = inside & (d > 0) & (d >= near) & (d < float("inf"))
        sdf = tl.where(known, d, _MISSING) - away
        if RAY:
            slope_u, slope_v = (
                (u - cx1.to(tl.float32)) / fx.to(tl.float32),
                (v - cy1.to(tl.float32)) / fy.to(tl.float32),
            )
            sdf = sdf * tl.sqrt(1.0 + slope_u * slope_u + slope_v * slope_v)
        observed = known & (sdf > -truncation)
        updated = tl.sum(observed.to(tl.int32), axis=0)
        at = b.to(tl.int64) * VOXELS + n
        old_D, old_W = tl.load(D + at, mask=observed, other=0.0), tl.load(W + at, mask=observed, other=0.0)
        new_W = tl.minimum(old_W + 1.0, max_weight)
        step = 1.0 / new_W
        value = tl.minimum(tl.maximum(sdf / truncation, -1.0), 1.0)
        tl.store(W + at, new_W, mask=observed)
        tl.store(D + at, old_D + step * (value - old_D), mask=observed)
        plane = colours + b.to(tl.int64) * (3 * VOXELS) + n
        for channel in tl.static_range(3):
            old = tl.load(plane + channel * VOXELS, mask=observed, other=0.0)
            new = tl.load(rgb + 3 * pixel + channel, mask=observed, other=0.0)
            tl.store(plane + channel * VOXELS, old + step * (new - old), mask=observed)
    tl.store(counts + b, updated)
