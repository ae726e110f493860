"""Marching cubes in three passes over the blocks; 64 voxels at a time are one word while only signs matter.

First the signs and the observed voxels as bits, then which cubes and which of their edges make a surface, then the
vertices and triangles. Order and numbering are the reference's.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import int64, njit, prange, uint64

from gsfusion_nb.tsdf.marching_cubes import extract_mesh as reference
from gsfusion_nb.tsdf.triangle_table import EDGES, triangle_table
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Mesh

from ..runtime.numba.bits import lowest, popcount
from ..runtime.numba.launch import launching

f32 = np.float32
_ONE, _HALF = f32(1.0), f32(0.5)
_LAST_Z, _FIRST_Z = np.uint64(0x8080808080808080), np.uint64(0x0101010101010101)
_NONE = np.uint64(0)
_EDGES = np.array(EDGES, np.int64)


def extract_mesh(volume: TsdfVolume, *, min_weight: float = 1.0) -> Mesh:
    """See ``gsfusion_nb.tsdf.extract_mesh``."""
    if volume.D.dtype != torch.float32 or volume.device.type != "cpu" or not volume.n_blocks:
        return reference.reference(volume, min_weight=min_weight)
    coords = volume.block_coords
    upper, lower = np.empty((3, len(coords)), np.int64), np.full((3, len(coords)), -1, np.int64)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.int32)
        step[axis] = 1
        upper[axis] = volume.index.find(coords + step).numpy()
        known = np.flatnonzero(upper[axis] >= 0)
        lower[axis, upper[axis, known]] = known
    D, W, C = (t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes))
    table, count = (t.numpy() for t in triangle_table())
    with launching():
        negative, seen = np.empty((len(coords), 8), np.uint64), np.empty((len(coords), 8), np.uint64)
        _signs(D, W, f32(min_weight), negative, seen)
        words, active, starts, first_triangle = _topology(negative, seen, upper, lower, count)
        n_vertices, n_triangles = int(starts[-1]), int(first_triangle[-1])
        vertices, rgb = torch.empty(n_vertices, 3), torch.empty(n_vertices, 3)
        faces = torch.empty(n_triangles, 3, dtype=torch.int64)
        out = vertices.numpy(), rgb.numpy(), faces.numpy()
        grid = coords.numpy(), float(volume.config.voxel_size_m)
        _emit(D, C, words, active, starts, first_triangle, upper, (table, count, _EDGES), grid, *out)
    return Mesh(vertices_W=vertices, faces=faces, rgb=rgb)


@njit(parallel=True, cache=True, error_model="numpy")
def _signs(D, W, min_weight, negative, seen):
    """One bit per voxel, a word per slab of a block [B, 8]: whether D is negative, whether it was observed enough."""
    for task in prange(negative.shape[0]):
        b = int64(task)
        for x in range(8):
            minus, known = _NONE, _NONE
            for n in range(64):
                at = b * 512 + x * 64 + n
                minus |= uint64(D[at] < f32(0)) << uint64(n)
                known |= uint64((W[at] >= min_weight) & (W[at] > f32(0))) << uint64(n)
            negative[b, x], seen[b, x] = minus, known


@njit(cache=True, error_model="numpy")
def _next_y(words, b, x, upper):
    """The word of the voxels one step further along y."""
    row = upper[1, b]
    across = words[row, x] << uint64(56) if row >= 0 else _NONE
    return words[b, x] >> uint64(8) | across


@njit(cache=True, error_model="numpy")
def _next_z(words, b, x, upper):
    row = upper[2, b]
    across = (words[row, x] & _FIRST_Z) << uint64(7) if row >= 0 else _NONE
    return (words[b, x] & ~_FIRST_Z) >> uint64(1) | across


@njit(cache=True, error_model="numpy")
def _next_x(words, b, x, upper):
    if x < 7:
        return words[b, x + 1]
    row = upper[0, b]
    return words[row, 0] if row >= 0 else _NONE


@njit(cache=True, error_model="numpy")
def _previous_y(words, b, x, lower):
    row = lower[1, b]
    across = words[row, x] >> uint64(56) if row >= 0 else _NONE
    return words[b, x] << uint64(8) | across


@njit(cache=True, error_model="numpy")
def _previous_z(words, b, x, lower):
    row = lower[2, b]
    across = (words[row, x] & _LAST_Z) >> uint64(7) if row >= 0 else _NONE
    return (words[b, x] & ~_LAST_Z) << uint64(1) | across


@njit(cache=True, error_model="numpy")
def _previous_x(words, b, x, lower):
    if x > 0:
        return words[b, x - 1]
    row = lower[0, b]
    return words[row, 7] if row >= 0 else _NONE


@njit(cache=True, error_model="numpy")
def _topology(negative, seen, upper, lower, count):
    """What makes a surface, as words per slab.

    Returns:
        words [7, B, 8]: edges along x, y, z with a vertex; then the signs at (0, 0), (y), (z), (y and z) steps ahead.
        active [B, 8]: cubes with triangles. starts [8 B + 1]: first vertex of each slab. first_triangle [B + 1].
    """
    B = negative.shape[0]
    words = np.empty((7, B, 8), np.uint64)
    minus, minus_y, minus_z, minus_yz = negative, words[4], words[5], words[6]
    seen_z, seen_yz, whole = np.empty((B, 8), np.uint64), np.empty((B, 8), np.uint64), np.empty((B, 8), np.uint64)
    for b in range(B):
        for x in range(8):
            minus_y[b, x], minus_z[b, x] = _next_y(minus, b, x, upper), _next_z(minus, b, x, upper)
            words[3, b, x] = negative[b, x]
            seen_z[b, x] = seen[b, x] & _next_z(seen, b, x, upper)
    for b in range(B):
        for x in range(8):
            minus_yz[b, x] = _next_y(minus_z, b, x, upper)
            seen_yz[b, x] = seen_z[b, x] & _next_y(seen_z, b, x, upper)
    for b in range(B):
        for x in range(8):
            whole[b, x] = seen_yz[b, x] & _next_x(seen_yz, b, x, upper)
    # An edge has a vertex if its ends differ in sign and one of the four cubes around it is whole.
    whole_y, whole_z = seen_yz, seen_z
    for b in range(B):
        for x in range(8):
            whole_y[b, x] = whole[b, x] | _previous_y(whole, b, x, lower)
            whole_z[b, x] = whole[b, x] | _previous_z(whole, b, x, lower)
    active = np.empty((B, 8), np.uint64)
    starts, first_triangle = np.zeros(8 * B + 1, np.int64), np.zeros(B + 1, np.int64)
    for b in range(B):
        triangles = 0
        for x in range(8):
            m = minus[b, x]
            words[0, b, x] = (m ^ _next_x(minus, b, x, upper)) & (whole_z[b, x] | _previous_y(whole_z, b, x, lower))
            words[1, b, x] = (m ^ minus_y[b, x]) & (whole_z[b, x] | _previous_x(whole_z, b, x, lower))
            words[2, b, x] = (m ^ minus_z[b, x]) & (whole_y[b, x] | _previous_x(whole_y, b, x, lower))
            n = popcount(words[0, b, x]) + popcount(words[1, b, x]) + popcount(words[2, b, x])
            starts[8 * b + x + 1] = starts[8 * b + x] + n
            corners = _corners(words, b, x, upper)
            some = corners[0] | corners[1] | corners[2] | corners[3] | corners[4] | corners[5] | corners[6] | corners[7]
            every = (
                corners[0] & corners[1] & corners[2] & corners[3] & corners[4] & corners[5] & corners[6] & corners[7]
            )
            cubes = whole[b, x] & some & ~every
            active[b, x] = cubes
            while cubes != _NONE:
                triangles += count[_case(corners, lowest(cubes))]
                cubes &= cubes - uint64(1)
        first_triangle[b + 1] = first_triangle[b] + triangles
    return words, active, starts, first_triangle


@njit(cache=True, error_model="numpy")
def _corners(words, b, x, upper):
    """Sign words of the eight corners x + 2 y + 4 z of the cubes of a slab."""
    return (
        words[3, b, x],
        _next_x(words[3], b, x, upper),
        words[4, b, x],
        _next_x(words[4], b, x, upper),
        words[5, b, x],
        _next_x(words[5], b, x, upper),
        words[6, b, x],
        _next_x(words[6], b, x, upper),
    )


@njit(cache=True, error_model="numpy")
def _case(corners, bit):
    case = _NONE
    for c in range(8):
        case |= (corners[c] >> bit & uint64(1)) << uint64(c)
    return int64(case)


@njit(cache=True, error_model="numpy")
def _vertex(words, starts, b, x, bit, axis):
    """Number of the vertex on an edge: those of earlier slabs, earlier voxels of this slab, and earlier axes."""
    below = (uint64(1) << bit) - uint64(1)
    n = starts[8 * b + x]
    for a in range(3):
        w = words[a, b, x]
        n += popcount(w & below)
        if a < axis:
            n += int64(w >> bit & uint64(1))
    return n


@njit(parallel=True, cache=True, error_model="numpy")
def _emit(D, C, words, active, starts, first_triangle, upper, tables, grid, vertices, rgb, faces):
    """Write the vertices of every block, and its triangles."""
    table, count, edges = tables
    coords, voxel_size = grid
    B = active.shape[0]
    for task in prange(B):
        b = int64(task)
        number = np.empty(12, np.int64)
        out = first_triangle[b]
        for x in range(8):
            _vertices_of_slab(D, C, words, starts, upper, (b, x), coords[b], voxel_size, vertices, rgb)
            cubes = active[b, x]
            if cubes == _NONE:
                continue
            corners = _corners(words, b, x, upper)
            while cubes != _NONE:
                bit = lowest(cubes)
                cubes &= cubes - uint64(1)
                case = _case(corners, bit)
                y, z = int64(bit >> uint64(3)), int64(bit & uint64(7))
                for e in range(12):
                    axis, corner = edges[e]
                    if (case >> corner & 1) == (case >> (corner | 1 << axis) & 1):
                        continue
                    row, ox, oy, oz = b, x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2)
                    if ox > 7:
                        row, ox = upper[0, row], 0
                    if oy > 7:
                        row, oy = upper[1, row], 0
                    if oz > 7:
                        row, oz = upper[2, row], 0
                    number[e] = _vertex(words, starts, row, ox, uint64(8 * oy + oz), axis)
                for t in range(count[case]):
                    for k in range(3):
                        faces[out, k] = number[table[case, t, k]]
                    out += 1


@njit(cache=True, error_model="numpy")
def _vertices_of_slab(D, C, words, starts, upper, slab, corner, voxel_size, vertices, rgb):
    b, x = slab
    out = starts[8 * b + x]
    voxels = words[0, b, x] | words[1, b, x] | words[2, b, x]
    while voxels != _NONE:
        bit = lowest(voxels)
        voxels &= voxels - uint64(1)
        y, z = int64(bit >> uint64(3)), int64(bit & uint64(7))
        n = x * 64 + y * 8 + z
        D0 = D[b * 512 + n]
        for axis in range(3):
            if (words[axis, b, x] >> bit & uint64(1)) == _NONE:
                continue
            at = x if axis == 0 else (y if axis == 1 else z)
            step = 64 if axis == 0 else (8 if axis == 1 else 1)
            row, m = (b, n + step) if at < 7 else (upper[axis, b], n - 7 * step)
            t = D0 / (D0 - D[row * 512 + m])
            vertices[out, 0] = (corner[0] * 8 + x + 0.5 + (np.float64(t) if axis == 0 else 0.0)) * voxel_size
            vertices[out, 1] = (corner[1] * 8 + y + 0.5 + (np.float64(t) if axis == 1 else 0.0)) * voxel_size
            vertices[out, 2] = (corner[2] * 8 + z + 0.5 + (np.float64(t) if axis == 2 else 0.0)) * voxel_size
            for c in range(3):
                first, second = C[(b * 3 + c) * 512 + n], C[(row * 3 + c) * 512 + m]
                towards = second - first
                rgb[out, c] = first + t * towards if t < _HALF else second - towards * (_ONE - t)
            out += 1
