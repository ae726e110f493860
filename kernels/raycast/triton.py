"""March every ray to the surface: steps and tests are the reference's, ``tsdf.raycast``.

Rays of 8 x 4 pixels go together, a warp of them, until all have ended; where blocks can be at all is told per tile of
16 x 16 pixels by one pass over the blocks.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportGeneralTypeIssues=false

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.tsdf.raycast import CLOSE_VOXELS, REFINEMENTS, STEP, RaycastOutput
from gsfusion_nb.tsdf.raycast import raycast as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Camera

from ..runtime.lens import lens_of
from ..runtime.triton.launch import INTERPRETED, device_of, launch, parts
from ..runtime.triton.lookup import find_voxel, load_colour
from ..runtime.triton.vectors import load_position, load_rotation, store3

TILE_PX = 16
"""Edge of the picture tiles whose rays start together, pixels."""

RAYS_OF_A_WARP = (8, 4)
RAYS = (16, 16) if INTERPRETED else RAYS_OF_A_WARP
"""Pixels of a program, width and height. The interpreter takes as long for many as for few."""

_INFINITE_BITS = 0x7F800000
_STEP, _CLOSE, _REFINEMENTS = tl.constexpr(STEP), tl.constexpr(CLOSE_VOXELS), tl.constexpr(REFINEMENTS)
_NEAR = tl.constexpr(0.01)


def raycast(volume: TsdfVolume, camera: Camera, T_WC: Tensor) -> RaycastOutput:
    """See ``gsfusion_nb.tsdf.raycast``."""
    lookup = volume.index.table
    if volume.D.dtype != torch.float32 or (volume.n_blocks and lookup is None):
        return reference.reference(volume, camera, T_WC)
    device = device_of("raycast", volume=volume.D)
    pose = T_WC.detach().cpu()
    H, W = camera.height, camera.width
    depth, normal, rgb = (torch.zeros(H, W, *n, dtype=torch.float32, device=device) for n in ((), (3,), (3,)))
    if lookup is not None:
        table, low, (blocks_x, blocks_y, blocks_z) = lookup
        pose = pose.to(device).contiguous()
        tiles_x, tiles_y = parts(W, TILE_PX), parts(H, TILE_PX)
        # depths above zero sort as their bits do
        first = torch.full((tiles_x * tiles_y,), _INFINITE_BITS, dtype=torch.int32, device=device)
        last = torch.zeros(tiles_x * tiles_y, dtype=torch.int32, device=device)
        spans = {"first": first, "last": last, "tiles_x": tiles_x, "TILE": TILE_PX}
        lens, side = lens_of(camera)._asdict(), float(volume.block_size_m)
        launch(
            _splat_blocks,
            volume.n_blocks,
            device,
            coords=volume.block_coords,
            T=pose,
            **spans,
            tiles_y=tiles_y,
            **lens,
            side=side,
            CHUNK=32,
            num_warps=1,
        )
        launch(
            _march,
            parts(W, RAYS[0]) * parts(H, RAYS[1]),
            device,
            D=volume.D,
            W=volume.W,
            colours=volume.rgb_planes,
            table=table,
            low=low,
            nx=blocks_x,
            ny=blocks_y,
            nz=blocks_z,
            T=pose.float(),
            **spans,
            depth=depth,
            normal=normal,
            rgb=rgb,
            width=W,
            height=H,
            **lens,
            side=side,
            voxel=float(volume.config.voxel_size_m),
            truncation=float(volume.config.truncation_m),
            WIDE=RAYS[0],
            HIGH=RAYS[1],
            num_warps=1,
        )
    return RaycastOutput(depth_m=depth, normal_W=normal, rgb=rgb)


@triton.jit(do_not_specialize=["tiles_x", "tiles_y"])
def _splat_blocks(
    coords, T, first, last, tiles_x, tiles_y, fx, fy, cx, cy, side, TILE: tl.constexpr, CHUNK: tl.constexpr
):  # fmt: skip
    """Lower ``first`` and raise ``last`` of the tiles that a block's picture covers to its least and largest depth."""
    b = tl.program_id(0)
    c = tl.arange(0, 8)
    size = side + 0.0
    C_x, C_y, C_z = load_position(T)
    x = (tl.load(coords + 3 * b) + (c & 1)).to(tl.float64) * size - C_x.to(tl.float64)
    y = (tl.load(coords + 3 * b + 1) + ((c >> 1) & 1)).to(tl.float64) * size - C_y.to(tl.float64)
    z = (tl.load(coords + 3 * b + 2) + (c >> 2)).to(tl.float64) * size - C_z.to(tl.float64)
    x, y, z = x.to(tl.float32), y.to(tl.float32), z.to(tl.float32)
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = load_rotation(T)
    X = r0.to(tl.float32) * x + r3.to(tl.float32) * y + r6.to(tl.float32) * z
    Y = r1.to(tl.float32) * x + r4.to(tl.float32) * y + r7.to(tl.float32) * z
    Z = r2.to(tl.float32) * x + r5.to(tl.float32) * y + r8.to(tl.float32) * z
    z_low, z_high = tl.min(Z, axis=0), tl.max(Z, axis=0)
    safe = tl.maximum(Z, _NEAR)
    u, v = (fx * X / safe + cx) / TILE, (fy * Y / safe + cy) / TILE
    behind = z_low <= _NEAR  # it is taken to cover the whole picture
    top_u, top_v = tiles_x + 0.0, tiles_y + 0.0
    u0 = tl.where(behind, 0.0, tl.maximum(tl.min(u, axis=0), -1.0))
    v0 = tl.where(behind, 0.0, tl.maximum(tl.min(v, axis=0), -1.0))
    u1 = tl.where(behind, top_u, tl.minimum(tl.max(u, axis=0), top_u))
    v1 = tl.where(behind, top_v, tl.minimum(tl.max(v, axis=0), top_v))
    i0, j0 = tl.maximum(tl.floor(u0).to(tl.int32), 0), tl.maximum(tl.floor(v0).to(tl.int32), 0)
    i1, j1 = tl.minimum(tl.floor(u1).to(tl.int32), tiles_x - 1), tl.minimum(tl.floor(v1).to(tl.int32), tiles_y - 1)
    wide, high = tl.maximum(i1 - i0 + 1, 0), tl.maximum(j1 - j0 + 1, 0)
    total = tl.where(z_high > 0, wide * high, 0)
    wide = tl.maximum(wide, 1)
    n = tl.arange(0, CHUNK)
    low = tl.maximum(z_low, 0.0).to(tl.int32, bitcast=True)
    up = tl.maximum(z_high, 0.0).to(tl.int32, bitcast=True)
    k = 0
    while k < total:
        covered = k + n < total
        tile = (j0 + (k + n) // wide) * tiles_x + i0 + (k + n) % wide
        tl.atomic_min(first + tile, low + 0 * n, mask=covered, sem="relaxed")
        tl.atomic_max(last + tile, up + 0 * n, mask=covered, sem="relaxed")
        k += CHUNK


@triton.jit
def _corner(D, W, table, low, nx, ny, nz, x, y, z, mask):
    """Places of voxels, their D, and whether they have been observed."""
    at = find_voxel(table, low, nx, ny, nz, x, y, z, mask)
    observed = (at >= 0) & (tl.load(W + at, mask=at >= 0, other=0.0) > 0)
    return at, tl.load(D + at, mask=observed, other=1.0), observed


@triton.jit
def _cell(D, W, table, low, nx, ny, nz, px, py, pz, mask):
    """The eight voxels around points, which are given in voxels less a half: fractions, D, places; all observed?"""
    bx, by, bz = tl.floor(px), tl.floor(py), tl.floor(pz)
    x, y, z = bx.to(tl.int32), by.to(tl.int32), bz.to(tl.int32)
    a0, v0, whole = _corner(D, W, table, low, nx, ny, nz, x, y, z, mask)
    a1, v1, whole = _corner(D, W, table, low, nx, ny, nz, x + 1, y, z, whole)
    a2, v2, whole = _corner(D, W, table, low, nx, ny, nz, x, y + 1, z, whole)
    a3, v3, whole = _corner(D, W, table, low, nx, ny, nz, x + 1, y + 1, z, whole)
    a4, v4, whole = _corner(D, W, table, low, nx, ny, nz, x, y, z + 1, whole)
    a5, v5, whole = _corner(D, W, table, low, nx, ny, nz, x + 1, y, z + 1, whole)
    a6, v6, whole = _corner(D, W, table, low, nx, ny, nz, x, y + 1, z + 1, whole)
    a7, v7, whole = _corner(D, W, table, low, nx, ny, nz, x + 1, y + 1, z + 1, whole)
    return (
        px - bx, py - by, pz - bz, v0, v1, v2, v3, v4, v5, v6, v7,
        a0, a1, a2, a3, a4, a5, a6, a7, whole,
    )  # fmt: skip


@triton.jit
def _mix(a, b, c, d, s, t):
    low, high = a + (b - a) * s, c + (d - c) * s
    return low + (high - low) * t


@triton.jit
def _interpolate(D, W, table, low, nx, ny, nz, px, py, pz, voxel, mask):
    """Trilinear D at world points, and where all eight voxels around them have been observed."""
    f, g, h, v0, v1, v2, v3, v4, v5, v6, v7, _, _, _, _, _, _, _, _, whole = _cell(
        D, W, table, low, nx, ny, nz, px / voxel - 0.5, py / voxel - 0.5, pz / voxel - 0.5, mask
    )
    a, b = _mix(v0, v1, v2, v3, f, g), _mix(v4, v5, v6, v7, f, g)
    return a + (b - a) * h, whole


@triton.jit
def _to_exit(p, d, side):
    """Depth to add to leave, along one axis, the blocks that hold points."""
    q = p / side
    done = q - tl.floor(q)
    return tl.where(d > 0, 1.0 - done, done) * side / tl.maximum(tl.abs(d), 1e-9)


@triton.jit(do_not_specialize=["nx", "ny", "nz", "width", "height", "tiles_x"])
def _march(
    D, W, colours, table, low, nx, ny, nz, T, first, last, depth, normal, rgb, width, height, tiles_x, fx, fy, cx, cy,
    side, voxel, truncation, TILE: tl.constexpr, WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """Write depth, normal and colour of the pixels whose rays meet a surface.

    D, W, colours, table, low, nx, ny, nz: the map and where its blocks are (``find_row``). first, last: from
    ``_splat_blocks``. side, voxel, truncation: edges of a block and of a voxel, truncation distance, metres.
    """
    k = tl.arange(0, WIDE * HIGH)
    across = (width + WIDE - 1) // WIDE
    i, j = (tl.program_id(0) % across) * WIDE + k % WIDE, (tl.program_id(0) // across) * HIGH + k // WIDE
    here = (i < width) & (j < height)
    x, y = (i + (0.5 - cx)) / fx, (j + (0.5 - cy)) / fy
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = load_rotation(T)
    dx, dy, dz = r0 * x + r1 * y + r2, r3 * x + r4 * y + r5, r6 * x + r7 * y + r8
    ox, oy, oz = load_position(T)
    tile = (j // TILE) * tiles_x + i // TILE
    z = tl.load(first + tile, mask=here, other=0).to(tl.float32, bitcast=True)
    z_end = tl.load(last + tile, mask=here, other=0).to(tl.float32, bitcast=True)
    alive = here & (z < z_end)
    z = tl.where(alive, z, 0.0)
    per_m = 1.0 / tl.sqrt(dx * dx + dy * dy + dz * dz)
    z_before, D_before = z, 0.0 * z + 1.0
    z0, z1, D0, D1 = z, z, 0.0 * z + 1.0, 0.0 * z - 1.0
    was_free, was_inside, found = z < 0, z < 0, z < 0
    while tl.max(alive.to(tl.int32), axis=0) > 0:
        px, py, pz = ox + dx * z, oy + dy * z, oz + dz * z
        vx, vy, vz = (
            tl.floor(px / voxel).to(tl.int32),
            tl.floor(py / voxel).to(tl.int32),
            tl.floor(pz / voxel).to(tl.int32),
        )
        at, value, observed = _corner(D, W, table, low, nx, ny, nz, vx, vy, vz, alive)
        close = observed & (tl.abs(value) * truncation < _CLOSE * voxel)
        if tl.max(close.to(tl.int32), axis=0) > 0:
            smooth, whole = _interpolate(D, W, table, low, nx, ny, nz, px, py, pz, voxel, close)
            value = tl.where(whole, smooth, value)
        free, inside = observed & (value >= 0), observed & (value < 0)
        step = tl.where(observed, tl.maximum(_STEP * truncation * tl.abs(value), voxel), voxel) * per_m
        ahead = tl.minimum(tl.minimum(_to_exit(px, dx, side), _to_exit(py, dy, side)), _to_exit(pz, dz, side))
        step = tl.where(at < 0, ahead + 0.01 * voxel, step)
        crossing = inside & was_free
        found = found | crossing
        z0, z1 = tl.where(crossing, z_before, z0), tl.where(crossing, z, z1)
        D0, D1 = tl.where(crossing, D_before, D0), tl.where(crossing, value, D1)
        alive = alive & (crossing == 0) & ((free & was_inside) == 0) & (z + step < z_end)
        z_before, D_before = z, value
        was_free, was_inside = free & alive, inside & alive
        z = tl.where(alive, z + step, z)
    z = z0 + (z1 - z0) * (D0 / (D0 - D1))
    for _ in tl.static_range(_REFINEMENTS):
        value, whole = _interpolate(D, W, table, low, nx, ny, nz, ox + dx * z, oy + dy * z, oz + dz * z, voxel, found)
        before, behind = whole & (value >= 0), whole & (value < 0)
        z0, D0 = tl.where(before, z, z0), tl.where(before, value, D0)
        z1, D1 = tl.where(behind, z, z1), tl.where(behind, value, D1)
        z = z0 + (z1 - z0) * (D0 / (D0 - D1))
    px, py, pz = (ox + dx * z) / voxel - 0.5, (oy + dy * z) / voxel - 0.5, (oz + dz * z) / voxel - 0.5
    f, g, h, v0, v1, v2, v3, v4, v5, v6, v7, a0, a1, a2, a3, a4, a5, a6, a7, whole = _cell(
        D, W, table, low, nx, ny, nz, px, py, pz, found
    )
    n0 = _mix(v1 - v0, v3 - v2, v5 - v4, v7 - v6, g, h)
    n1 = _mix(v2 - v0, v3 - v1, v6 - v4, v7 - v5, f, h)
    n2 = _mix(v4 - v0, v5 - v1, v6 - v2, v7 - v3, f, g)
    length = tl.maximum(tl.sqrt(n0 * n0 + n1 * n1 + n2 * n2), 1e-12)
    pixel = j * width + i
    tl.store(depth + pixel, z, mask=whole)
    store3(normal, pixel, n0 / length, n1 / length, n2 / length, whole)
    for c in tl.static_range(3):
        a = _mix(
            load_colour(colours, a0, c, whole), load_colour(colours, a1, c, whole),
            load_colour(colours, a2, c, whole), load_colour(colours, a3, c, whole), f, g,
        )  # fmt: skip
        b = _mix(
            load_colour(colours, a4, c, whole), load_colour(colours, a5, c, whole),
            load_colour(colours, a6, c, whole), load_colour(colours, a7, c, whole), f, g,
        )  # fmt: skip
        tl.store(rgb + 3 * pixel + c, a + (b - a) * h, mask=whole)
