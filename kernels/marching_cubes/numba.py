"""Marching cubes in three passes over the blocks; 64 voxels at a time are one word while only signs matter.

First the signs and the observed voxels as bits, then which cubes and which of their edges make a surface, then the
vertices and triangles. Order and numbering are the reference's.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
import torch
from numba import int64, njit, prange, uint64

from gsfusion_nb.constants import BLOCK_VOXELS, VOXELS_PER_BLOCK
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
_STEP_X, _STEP_Y, _STEP_Z = BLOCK_VOXELS * BLOCK_VOXELS, BLOCK_VOXELS, 1
"""From a voxel to the next one along each axis, in the order in which a block is stored."""

_X, _Y, _Z = range(3)
"""Axes: rows of tables of neighbours, and of the words that say which edges along an axis have a vertex."""

_SIGN, _SIGN_Y, _SIGN_Z, _SIGN_YZ = range(3, 7)
"""The words behind those: the signs at a voxel, and one step ahead along y, along z, along both."""
_WORDS = 7


class Voxels(NamedTuple):
    """Values in the order of the pool."""

    D: np.ndarray
    W: np.ndarray
    rgb: np.ndarray


class Topology(NamedTuple):
    """What makes a surface, as words per slab."""

    words: np.ndarray
    """[_WORDS, B, 8]"""
    active: np.ndarray
    """[B, 8]: cubes with triangles."""
    first_vertex: np.ndarray
    """[8 B + 1]: of each slab."""
    first_triangle: np.ndarray
    """[B + 1]: of each block."""


class Tables(NamedTuple):
    """Edges of the triangles of every case, their number, and axis and lower corner of every edge."""

    triangles: np.ndarray
    count: np.ndarray
    edges: np.ndarray


class Grid(NamedTuple):
    """Where the blocks are, in blocks [B, 3], the edge of a voxel in metres, and the upper neighbours [3, B]."""

    coords: np.ndarray
    voxel_size_m: float
    upper: np.ndarray


class MeshArrays(NamedTuple):
    """The mesh to be written."""

    vertices: np.ndarray
    rgb: np.ndarray
    faces: np.ndarray


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
    voxels = Voxels(*(t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes)))
    triangles, count = (t.numpy() for t in triangle_table())
    tables = Tables(triangles=triangles, count=count, edges=_EDGES)
    with launching():
        negative, seen = np.empty((len(coords), 8), np.uint64), np.empty((len(coords), 8), np.uint64)
        _signs(voxels, f32(min_weight), negative, seen)
        topology = Topology(*_topology(negative, seen, upper, lower, count))
        n_vertices, n_triangles = int(topology.first_vertex[-1]), int(topology.first_triangle[-1])
        vertices, rgb = torch.empty(n_vertices, 3), torch.empty(n_vertices, 3)
        faces = torch.empty(n_triangles, 3, dtype=torch.int64)
        mesh = MeshArrays(vertices=vertices.numpy(), rgb=rgb.numpy(), faces=faces.numpy())
        grid = Grid(coords=coords.numpy(), voxel_size_m=float(volume.config.voxel_size_m), upper=upper)
        _emit(voxels, topology, tables, grid, mesh)
    return Mesh(vertices_W=vertices, faces=faces, rgb=rgb)


@njit(parallel=True, cache=True, error_model="numpy")
def _signs(voxels, min_weight, negative, seen):
    """One bit per voxel, a word per slab of a block [B, 8]: whether D is negative, whether it was observed enough."""
    D, W = voxels.D, voxels.W
    for task in prange(negative.shape[0]):
        b = int64(task)
        for x in range(8):
            minus, known = _NONE, _NONE
            for n in range(64):
                at = b * VOXELS_PER_BLOCK + x * _STEP_X + n
                minus |= uint64(D[at] < f32(0)) << uint64(n)
                known |= uint64((W[at] >= min_weight) & (W[at] > f32(0))) << uint64(n)
            negative[b, x], seen[b, x] = minus, known


@njit(cache=True, error_model="numpy")
def _next_y(words, b, x, upper):
    """The word of the voxels one step further along y."""
    row = upper[_Y, b]
    across = words[row, x] << uint64(56) if row >= 0 else _NONE
    return words[b, x] >> uint64(8) | across


@njit(cache=True, error_model="numpy")
def _next_z(words, b, x, upper):
    """The same along z; and so on for the other directions."""
    row = upper[_Z, b]
    across = (words[row, x] & _FIRST_Z) << uint64(7) if row >= 0 else _NONE
    return (words[b, x] & ~_FIRST_Z) >> uint64(1) | across


@njit(cache=True, error_model="numpy")
def _next_x(words, b, x, upper):
    if x < 7:
        return words[b, x + 1]
    row = upper[_X, b]
    return words[row, 0] if row >= 0 else _NONE


@njit(cache=True, error_model="numpy")
def _previous_y(words, b, x, lower):
    row = lower[_Y, b]
    across = words[row, x] >> uint64(56) if row >= 0 else _NONE
    return words[b, x] << uint64(8) | across


@njit(cache=True, error_model="numpy")
def _previous_z(words, b, x, lower):
    row = lower[_Z, b]
    across = (words[row, x] & _LAST_Z) >> uint64(7) if row >= 0 else _NONE
    return (words[b, x] & ~_LAST_Z) << uint64(1) | across


@njit(cache=True, error_model="numpy")
def _previous_x(words, b, x, lower):
    if x > 0:
        return words[b, x - 1]
    row = lower[_X, b]
    return words[row, 7] if row >= 0 else _NONE


@njit(cache=True, error_model="numpy")
def _topology(negative, seen, upper, lower, count):
    """The parts of a ``Topology``."""
    B = negative.shape[0]
    words = np.empty((_WORDS, B, 8), np.uint64)
    minus, minus_y, minus_z, minus_yz = negative, words[_SIGN_Y], words[_SIGN_Z], words[_SIGN_YZ]
    seen_z, seen_yz, whole = np.empty((B, 8), np.uint64), np.empty((B, 8), np.uint64), np.empty((B, 8), np.uint64)
    for b in range(B):
        for x in range(8):
            minus_y[b, x], minus_z[b, x] = _next_y(minus, b, x, upper), _next_z(minus, b, x, upper)
            words[_SIGN, b, x] = negative[b, x]
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
            words[_X, b, x] = (m ^ _next_x(minus, b, x, upper)) & (whole_z[b, x] | _previous_y(whole_z, b, x, lower))
            words[_Y, b, x] = (m ^ minus_y[b, x]) & (whole_z[b, x] | _previous_x(whole_z, b, x, lower))
            words[_Z, b, x] = (m ^ minus_z[b, x]) & (whole_y[b, x] | _previous_x(whole_y, b, x, lower))
            n = popcount(words[_X, b, x]) + popcount(words[_Y, b, x]) + popcount(words[_Z, b, x])
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
        words[_SIGN, b, x],
        _next_x(words[_SIGN], b, x, upper),
        words[_SIGN_Y, b, x],
        _next_x(words[_SIGN_Y], b, x, upper),
        words[_SIGN_Z, b, x],
        _next_x(words[_SIGN_Z], b, x, upper),
        words[_SIGN_YZ, b, x],
        _next_x(words[_SIGN_YZ], b, x, upper),
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
def _emit(voxels, topology, tables, grid, mesh):
    """Write the vertices of every block, and its triangles."""
    D, C = voxels.D, voxels.rgb
    words, active, starts = topology.words, topology.active, topology.first_vertex
    first_triangle = topology.first_triangle
    table, count, edges = tables.triangles, tables.count, tables.edges
    coords, voxel_size, upper = grid.coords, grid.voxel_size_m, grid.upper
    vertices, rgb, faces = mesh.vertices, mesh.rgb, mesh.faces
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
                        row, ox = upper[_X, row], 0
                    if oy > 7:
                        row, oy = upper[_Y, row], 0
                    if oz > 7:
                        row, oz = upper[_Z, row], 0
                    number[e] = _vertex(words, starts, row, ox, uint64(8 * oy + oz), axis)
                for t in range(count[case]):
                    for k in range(3):
                        faces[out, k] = number[table[case, t, k]]
                    out += 1


@njit(cache=True, error_model="numpy")
def _vertices_of_slab(D, C, words, starts, upper, slab, corner, voxel_size, vertices, rgb):
    """Write the vertices on the edges that begin in a slab: at the zero of D along the edge, with the colour there."""
    b, x = slab
    out = starts[8 * b + x]
    voxels = words[_X, b, x] | words[_Y, b, x] | words[_Z, b, x]
    while voxels != _NONE:
        bit = lowest(voxels)
        voxels &= voxels - uint64(1)
        y, z = int64(bit >> uint64(3)), int64(bit & uint64(7))
        n = x * _STEP_X + y * _STEP_Y + z * _STEP_Z
        D0 = D[b * VOXELS_PER_BLOCK + n]
        for axis in range(3):
            if (words[axis, b, x] >> bit & uint64(1)) == _NONE:
                continue
            at = x if axis == _X else (y if axis == _Y else z)
            step = _STEP_X if axis == _X else (_STEP_Y if axis == _Y else _STEP_Z)
            row, m = (b, n + step) if at < 7 else (upper[axis, b], n - 7 * step)
            t = D0 / (D0 - D[row * VOXELS_PER_BLOCK + m])
            vertices[out, 0] = (corner[0] * 8 + x + 0.5 + (np.float64(t) if axis == _X else 0.0)) * voxel_size
            vertices[out, 1] = (corner[1] * 8 + y + 0.5 + (np.float64(t) if axis == _Y else 0.0)) * voxel_size
            vertices[out, 2] = (corner[2] * 8 + z + 0.5 + (np.float64(t) if axis == _Z else 0.0)) * voxel_size
            for c in range(3):
                first, second = C[(b * 3 + c) * VOXELS_PER_BLOCK + n], C[(row * 3 + c) * VOXELS_PER_BLOCK + m]
                towards = second - first
                rgb[out, c] = first + t * towards if t < _HALF else second - towards * (_ONE - t)
            out += 1
