"""What the numba kernels of marching cubes work on: voxels, words of bits, tables and the mesh."""

from typing import NamedTuple

import numpy as np

X, Y, Z = range(3)
"""Axes: rows of tables of neighbours, and of the words that say which edges along an axis have a vertex."""

SIGN, SIGN_Y, SIGN_Z, SIGN_YZ = range(3, 7)
"""The words behind those: the signs at a voxel, and one step ahead along y, along z, along both."""
WORDS = 7


class Voxels(NamedTuple):
    """Values in the order of the pool."""

    D: np.ndarray
    W: np.ndarray
    rgb: np.ndarray


class Topology(NamedTuple):
    """What makes a surface, as words per slab."""

    words: np.ndarray
    """[WORDS, B, 8]"""
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
