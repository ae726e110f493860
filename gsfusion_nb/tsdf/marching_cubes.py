"""The surface of the volume as a triangle mesh: marching cubes (Lorensen & Cline 1987) from the
sparse blocks.

A cube has a voxel centre at each of its corners: corner c is at (c & 1, c >> 1 & 1, c >> 2 & 1). A
corner is inside the surface where D < 0, and an edge between an inside and an outside corner is
cut: there, at the zero of D, is a vertex. The case of a cube is the set of its inside corners,

    case = sum over c of 2^c [D_c < 0]                                                     (1)

and a table holds the triangles of each of the 256 cases. It is derived here instead of typed in:

1. On each face, walk around the four corners counter-clockwise, seen from outside the cube. A
   segment joins each side where the walk goes inside to the next side where it comes out again.
2. The segments of the six faces join into closed loops of cut edges.
3. Each loop is cut into triangles.

Step 1 looks at the face alone, so the two cubes that share a face have the same segments there,
also where inside and outside corners alternate, and the surface has no cracks.
"""

import functools
import itertools
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op, piece
from ..checks import check_number
from ..resources import MAP_MEMORY, return_free_memory
from ..types import Mesh
from .block_pool import BLOCK_VOXELS, VOXELS_PER_BLOCK
from .volume import TsdfVolume, check_volume, rgb_at
from .voxels import CORNERS, VOXELS, voxel_at

EDGES = tuple((axis, corner) for axis in range(3) for corner in range(8) if not corner >> axis & 1)
"""(axis, lower corner) of the twelve edges; the edge joins the lower corner with lower corner +
2^axis."""

Loop = tuple[int, ...]
"""Numbers of edges, in order around a polygon."""
Triangle = tuple[int, int, int]
"""Numbers of the edges that its corners lie on."""


def _faces() -> list[list[int]]:
    """Corners of the six faces, counter-clockwise seen from outside the cube."""
    faces = []
    for axis in range(3):
        b = 1 << (axis + 1) % 3
        c = 1 << (axis + 2) % 3
        square = [0, b, b | c, c]
        faces += [square[::-1], [corner | 1 << axis for corner in square]]
    return faces


def _sides(face: list[int]) -> list[int]:
    """Edges of a face: side i joins its corners i and i + 1."""
    sides = []
    for a, b in zip(
        face,
        face[1:] + face[:1],
        strict=True,
    ):
        axis = (a ^ b).bit_length() - 1
        sides.append(EDGES.index((axis, min(a, b))))
    return sides


_FACES = [(face, _sides(face)) for face in _faces()]


def loops(case: int) -> list[Loop]:
    """Closed polygons of cut edges that separate inside from outside, counter-clockwise seen from
    outside.

    Steps 1 and 2 of the derivation above.
    """
    follows = {}
    for face, sides in _FACES:
        is_inside = [case >> corner & 1 for corner in face]
        # of side i: 1 goes inside, -1 comes out
        turn = [is_inside[(i + 1) % 4] - is_inside[i] for i in range(4)]
        for i in range(4):
            if turn[i] == 1:
                onwards = [(i + k) % 4 for k in (1, 2, 3)]
                next_edge = next(k for k in onwards if turn[k] == -1)
                follows[sides[i]] = sides[next_edge]
    polygons = []
    while follows:
        loop = [min(follows)]
        while (edge := follows.pop(loop[-1])) != loop[0]:
            loop.append(edge)
        polygons.append(tuple(loop))
    return polygons


def triangulate(loop: Loop) -> list[Triangle]:
    """Triangles over a loop, without diagonals that lie in a face of the cube where that is
    possible (step 3).

    Such a diagonal could coincide with one of the neighbouring cube, and four triangles would then
    share it.
    """
    return min(
        _triangulations(loop), key=lambda triangles: sum(map(_diagonals_in_faces, triangles))
    )


def _triangulations(polygon: Loop) -> list[list[Triangle]]:
    """All ways to cut a polygon into triangles: choose the apex over its last side, then cut the
    two other parts."""
    if len(polygon) < 3:
        return [[]]
    triangulations = []
    for k in range(1, len(polygon) - 1):
        middle = (polygon[0], polygon[k], polygon[-1])
        for first_part in _triangulations(polygon[: k + 1]):
            for right in _triangulations(polygon[k:]):
                triangulations.append([*first_part, middle, *right])
    return triangulations


@functools.cache
def _diagonals_in_faces(triangle: Triangle) -> int:
    """Sides of a triangle that lie in a face. The loop's own sides all do, so only the diagonals
    make a difference."""
    sides = itertools.combinations(triangle, 2)
    faces = [set(edges) for _, edges in _FACES]
    return sum(any(face.issuperset(side) for face in faces) for side in sides)


@functools.cache
def triangle_table() -> tuple[Tensor, Tensor]:
    """Edge numbers of the triangles of every case, padded with 0 [256, T, 3], and the number of
    triangles [256]."""
    cases = []
    for case in range(256):
        triangulations = [triangulate(loop) for loop in loops(case)]
        cases.append(list(itertools.chain.from_iterable(triangulations)))
    count = torch.tensor([len(triangles) for triangles in cases])
    table = torch.zeros(
        256,
        int(count.max()),
        3,
        dtype=torch.int64,
    )
    for case, triangles in enumerate(cases):
        if triangles:
            table[case, : len(triangles)] = torch.tensor(triangles)
    return table, count


BLOCKS_AT_A_TIME = 256
EDGES_AT_A_TIME = 1 << 18
"""Limit the memory for intermediate results, independent of the size of the map."""


def check_mesh(volume: Any, *, min_weight: float = 1.0) -> None:
    """Raise ``ValueError`` for arguments that ``extract_mesh`` refuses."""
    check_volume(volume)
    check_number("min_weight", min_weight)


@op("marching_cubes", check_mesh)
def extract_mesh(volume: TsdfVolume, *, min_weight: float = 1.0) -> Mesh:
    """Marching cubes over the blocks (Lorensen & Cline 1987), with vertices on the zero crossing of
    D.

    A cube spans eight voxel centres and is meshed only when all eight were observed at least
    ``min_weight`` times, so the end of the truncation band creates no false surface. Every cut edge
    has one vertex, shared by all its triangles.

    Args:
        volume: The map.
        min_weight: Smallest observation count of a usable voxel.

    Returns:
        Vertices in the world frame (metres), their colours interpolated between the two voxels, and
        faces, counter-clockwise seen from the free side.

    Differentiable: no.
    """
    parts = []
    keep = MAP_MEMORY.in_file if MAP_MEMORY.is_in_files(volume.device) else Tensor.detach
    for n, part in enumerate(
        torch.arange(volume.n_blocks, device=volume.device).split(BLOCKS_AT_A_TIME), start=1
    ):
        parts.append(tuple(map(keep, _numbered(_triangles(volume, part, min_weight)))))
        MAP_MEMORY.give_back()
        if n % 64 == 0:
            return_free_memory()  # the small results lie between large intermediate ones
    edges = torch.cat([cut for cut, _ in parts]).unique()
    sizes = [len(triangles) for _, triangles in parts]
    faces = MAP_MEMORY.rows(
        sum(sizes),
        3,
        dtype=torch.int64,
        device=volume.device,
    )
    for place, (cut, triangles) in zip(faces.split(sizes), parts, strict=True):
        place.copy_(torch.searchsorted(edges, cut)[triangles])
        MAP_MEMORY.give_back()
    vertices_W, rgb = (MAP_MEMORY.rows(len(edges), 3, device=volume.device) for _ in range(2))
    for places, part in zip(
        torch.arange(len(edges)).split(EDGES_AT_A_TIME),
        edges.split(EDGES_AT_A_TIME),
        strict=True,
    ):
        vertices_W[places], rgb[places] = _vertices(volume, part)
        MAP_MEMORY.give_back()
    return Mesh(vertices_W=vertices_W, faces=faces, rgb=rgb)


def _numbered(triangles: Int[Tensor, "F 3"]) -> tuple[Int[Tensor, " E"], Int[Tensor, "F 3"]]:
    """The edges of some triangles, rising, and the triangles as numbers among them, int32."""
    edges, numbers = triangles.unique(return_inverse=True)
    return edges, numbers.int()


def _triangles(
    volume: TsdfVolume, rows: Int[Tensor, " B"], min_weight: float
) -> Int[Tensor, "F 3"]:
    """The three cut edges of every triangle of the cubes whose lowest corners are the voxels of
    some blocks.

    The number of an edge is 3 x (position of its lower voxel in the flattened pool) + axis.
    """
    corner = _cube_corners(volume, rows)
    D = volume.D.view(-1)[corner]
    weight = volume.W.view(-1)[corner]
    usable = ((corner >= 0) & (weight > 0) & (weight >= min_weight)).all(1)
    bit = 2 ** torch.arange(8, device=volume.device)
    case = ((D < 0) * bit).sum(1) * usable  # (1); a cube of case 0 has no triangles

    table, count = (t.to(volume.device) for t in triangle_table())
    number = torch.arange(table.shape[1], device=volume.device)
    # of every triangle of every cube
    cube, nth = (number < count[case][:, None]).nonzero().unbind(1)
    edge = table[case[cube], nth]
    axis, lower = torch.tensor(EDGES, device=volume.device)[edge].unbind(-1)
    return 3 * corner[cube[:, None], lower] + axis


def _cube_corners(volume: TsdfVolume, rows: Int[Tensor, " B"]) -> Int[Tensor, "C 8"]:
    """Position in the flattened pool of the eight corners of each cube that may be cut, -1 where
    not allocated.

    They lie in the block of the lowest corner or in one of its seven upper neighbours.
    """
    device = volume.device
    coords = volume.block_coords[rows, None] + CORNERS.to(device)
    neighbour = volume.index.find(coords.view(-1, 3)).view(-1, 8)
    block, cube = _mixed(volume.D, neighbour).nonzero().unbind(1)
    # 0..8, in voxels from the corner of the block  [512, 8, 3]
    xyz = (VOXELS[:, None] + CORNERS).to(device)
    which = (xyz >> 3) @ xyz.new_tensor([1, 2, 4])
    number = (xyz & 7) @ xyz.new_tensor([64, 8, 1])
    row = neighbour[block[:, None], which[cube]]
    return torch.where(row < 0, -1, row * VOXELS_PER_BLOCK + number[cube])


def _mixed(
    D: Float[Tensor, "N 512"],
    neighbour: Int[Tensor, "B 8"],
) -> Bool[Tensor, "B 512"]:
    """Cubes with corners inside and outside; what is not allocated counts as outside."""
    n = len(neighbour)
    side = BLOCK_VOXELS
    is_inside = torch.zeros(
        n,
        side + 1,
        side + 1,
        side + 1,
        dtype=torch.uint8,
        device=D.device,
    )
    grid = D.view(len(D), side, side, side)
    for row, corner in zip(
        neighbour.unbind(1),
        CORNERS.tolist(),
        strict=True,
    ):
        first = tuple(slice(0, 1) if upper else slice(None) for upper in corner)
        place = tuple(slice(side, None) if upper else slice(0, side) for upper in corner)
        present = (row >= 0).nonzero()[:, 0]
        is_inside[(present, *place)] = (grid[(slice(None), *first)][row[present]] < 0).byte()
    corners = [
        is_inside[(slice(None), *(slice(k, k + side) for k in corner))]
        for corner in CORNERS.tolist()
    ]
    count = torch.stack(corners).sum(0, dtype=torch.uint8).view(n, VOXELS_PER_BLOCK)
    return (count > 0) & (count < len(corners))


def _vertices(
    volume: TsdfVolume, edges: Int[Tensor, " V"]
) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 3"]]:
    """Positions and colours of the points on edges where D, linear between the two voxel centres,
    is zero."""
    first = edges // 3
    axis = edges % 3
    step = torch.eye(3, dtype=torch.int64, device=edges.device)[axis]
    ijk = voxel_at(volume.block_coords, first)
    second = volume.find_voxels(ijk + step)
    D0 = volume.D.view(-1)[first]
    D1 = volume.D.view(-1)[second]
    t = (D0 / (D0 - D1))[:, None]
    centre = ijk.double() + 0.5
    xyz_W = zero_crossing(centre, centre + step, D0, D1) * volume.config.voxel_size_m
    rgb = torch.lerp(rgb_at(volume, first), rgb_at(volume, second), t)
    return xyz_W.to(D0.dtype), rgb


@piece
def zero_crossing(
    p0: Float[Tensor, "V 3"],
    p1: Float[Tensor, "V 3"],
    D0: Float[Tensor, " V"],
    D1: Float[Tensor, " V"],
) -> Float[Tensor, "V 3"]:
    """The point of each edge where D, linear between its ends p0 and p1 of different sign, is zero.

    Source: Lorensen & Cline 1987, section 4.
    """
    t = (D0 / (D0 - D1))[:, None].to(p0)
    return p0 + t * (p1 - p0)
