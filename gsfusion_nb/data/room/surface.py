"""The true surface of the room: distances to it, and its mesh in the colours of the atlas."""

import hashlib
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from ...checks import check_positive
from ...files import cache_folder
from ...types import Mesh
from .atlas import LEVELS, level_offsets, texels
from .distance import signed_distance
from .image_cache import cached
from .interior import SHELL_SOLIDS, furnishing
from .scene import Scene, load_scene, place_of, version
from .solids import Solid

_LIFT_M = 0.002

_CLEAR_M = 0.0012
"""A surface point counts as free if the point 2 mm above it is more than this far from every other
solid."""


def room_sdf(
    xyz_W: Float[Tensor, "*N 3"],
    *,
    seed: int = 0,
    moved: str = "none",
) -> Float[Tensor, "*N"]:
    """Signed distance to the room's surfaces, metres: positive in free space, negative inside
    solids and outside.

    Exact in free space, because it is the minimum of exact distances to convex solids and to the
    shell; inside solids its magnitude is a lower bound on the distance to the surface of their
    union.

    Args:
        xyz_W: World points, metres (z up, origin on the floor in the middle). [*N, 3]
        seed: The room's seed.
        moved: What stands elsewhere (``RoomSequence.moved``).

    Returns:
        Signed distance, metres, in the dtype and on the device of ``xyz_W``. [*N]

    Differentiable: no.
    """
    points = xyz_W.detach().cpu().double().reshape(-1, 3).numpy()
    distance = torch.from_numpy(signed_distance(furnishing(seed, moved), points))
    return distance.reshape(xyz_W.shape[:-1]).to(xyz_W.device, xyz_W.dtype)


def room_mesh(
    resolution_m: float = 0.02,
    *,
    seed: int = 0,
    moved: str = "none",
    cache: bool = True,
) -> Mesh:
    """The visible surface of the room, coloured, as ground truth for reconstructed meshes.

    Every painted face is triangulated in its own coordinates, with vertices exactly on the surface.
    Parts covered by other solids (the floor below a box) are cut away along the contact.

    Args:
        resolution_m: Largest edge along a face's axes, metres.
        seed: The room's seed.
        moved: What stands elsewhere (``RoomSequence.moved``).
        cache: Keep the mesh and the painted and lit textures on disk.

    Returns:
        The mesh; vertices are shared within a face.

    Raises:
        ValueError: ``resolution_m`` is not positive.
    """
    check_positive("resolution_m", resolution_m)
    text = f"mesh {version()} {seed} {float(resolution_m)!r}{place_of(moved)}"
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = cache_folder() / "room" / f"mesh-{key}.npz" if cache else None
    arrays = cached(path, lambda: _made(resolution_m, seed, cache, moved))
    return Mesh(
        vertices_W=torch.from_numpy(arrays["xyz"]),
        faces=torch.from_numpy(arrays["faces"].astype(np.int64)),
        rgb=torch.from_numpy(arrays["rgb"]),
    )


def _made(resolution_m: float, seed: int, cache: bool, moved: str) -> dict[str, ndarray]:
    """World points [V, 3], triangles [F, 3] and colours [V, 3]."""
    scene = load_scene(seed, cache, moved)
    chart, uv, faces = _tessellate(scene, resolution_m)
    clearance = _clearance(scene, furnishing(seed, moved))
    chart, uv, faces = _cut(chart, uv, faces, clearance)
    xyz, _ = _points(scene, chart, uv)
    a, b, c = (xyz[faces[:, k]] for k in range(3))
    faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-10]
    used, faces = np.unique(faces, return_inverse=True)
    rgb = _colours(scene, chart[used], uv[used], resolution_m)
    return {
        "xyz": xyz[used].astype(np.float32),
        "faces": faces.reshape(-1, 3).astype(np.int32),
        "rgb": rgb,
    }


def _tessellate(scene: Scene, resolution_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """Chart number [V], chart coordinates [V, 2] and triangles [F, 3] of all painted faces."""
    charts = []
    uvs = []
    faces = []
    count = 0
    for k, chart in enumerate(scene.charts):
        size_m = scene.solids[chart.solid].face_size_m(chart.face)
        nu, nv = (max(1, int(np.ceil(s / resolution_m))) for s in size_m)
        wraps = chart.face in ("side", "skin")
        if wraps:
            nu = max(nu, 12)
        if chart.face in ("skin", "top", "bottom"):
            nu = max(nu, 8)
            nv = max(nv, 6)
        u, v = np.meshgrid(np.arange(nu + 1) / nu, np.arange(nv + 1) / nv)
        index = np.arange((nu + 1) * (nv + 1)).reshape(nv + 1, nu + 1)
        if wraps:
            index[:, -1] = index[:, 0]
        p00 = index[:-1, :-1]
        p01 = index[:-1, 1:]
        p10 = index[1:, :-1]
        p11 = index[1:, 1:]
        quads = np.stack([p00, p10, p01, p01, p10, p11], -1).reshape(-1, 3)
        charts.append(np.full(u.size, k))
        uvs.append(np.stack([u.ravel(), v.ravel()], 1))
        faces.append(quads + count)
        count += u.size
    return np.concatenate(charts), np.concatenate(uvs), np.concatenate(faces)


def _points(scene: Scene, chart: ndarray, uv: ndarray) -> tuple[ndarray, ndarray]:
    """World points and outward normals at chart coordinates."""
    xyz = np.empty((len(chart), 3))
    normal = np.empty((len(chart), 3))
    order = np.argsort(chart, kind="stable")
    starts = np.flatnonzero(np.diff(chart[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        if rows.size:
            k = scene.charts[chart[rows[0]]]
            solid = scene.solids[k.solid]
            p, n = solid.surface(
                k.face,
                uv[rows, 0],
                uv[rows, 1],
            )
            xyz[rows] = p @ solid.R.T + solid.t
            normal[rows] = n @ solid.R.T
    return xyz, normal


def _clearance(scene: Scene, solids: Sequence[Solid]) -> Callable[[ndarray, ndarray], ndarray]:
    solid_of_chart = np.array([c.solid for c in scene.charts])

    def clearance(chart: ndarray, uv: ndarray) -> ndarray:
        xyz, normal = _points(scene, chart, uv)
        owner = np.maximum(solid_of_chart[chart] - SHELL_SOLIDS, -1)
        xyz_off = xyz + _LIFT_M * normal
        return signed_distance(solids, xyz_off, owner, at_most=2 * _CLEAR_M) - _CLEAR_M

    return clearance


def _cut(
    chart: ndarray, uv: ndarray, faces: ndarray, clearance: Callable
) -> tuple[ndarray, ndarray, ndarray]:
    """Remove covered parts; triangles that cross the contact line are cut along it."""
    free = clearance(chart, uv) > 0
    n_free = free[faces].sum(1)
    whole = faces[n_free == 3]
    one = _turned(faces[n_free == 1], free)
    two = _turned(faces[n_free == 2], ~free)
    # A cut triangle loses either its one odd corner or the two others.
    pairs = np.concatenate([one[:, [0, 1]], one[:, [0, 2]], two[:, [1, 0]], two[:, [2, 0]]])
    pairs, where = np.unique(pairs, axis=0, return_inverse=True)
    where = where.reshape(-1) + len(chart)
    m = len(one)
    n = len(two)
    new_one = (where[:m], where[m : 2 * m])
    new_two = (where[2 * m : 2 * m + n], where[2 * m + n :])
    parts = [
        whole,
        np.stack([one[:, 0], new_one[0], new_one[1]], 1),
        np.stack(
            [new_two[0], two[:, 1], two[:, 2]],
            1,
        ),
        np.stack([new_two[0], two[:, 2], new_two[1]], 1),
    ]
    cut_chart = chart[pairs[:, 0]]
    a = uv[pairs[:, 0]]
    b = uv[pairs[:, 1]].copy()
    b[:, 0] += np.where(
        np.abs(b[:, 0] - a[:, 0]) > 0.5,
        np.sign(a[:, 0] - b[:, 0]),
        0,
    )  # the seam of a wrapped chart
    low = np.zeros(len(pairs))
    high = np.ones(len(pairs))
    for _ in range(9):
        middle = 0.5 * (low + high)
        is_inside = (
            clearance(cut_chart, a + middle[:, None] * (b - a)) > 0 if len(pairs) else low > 0
        )
        low = np.where(is_inside, middle, low)
        high = np.where(is_inside, high, middle)
    cut_uv = a + low[:, None] * (b - a)
    return np.concatenate([chart, cut_chart]), np.concatenate([uv, cut_uv]), np.concatenate(parts)


def _turned(faces: ndarray, odd: ndarray) -> ndarray:
    """Triangles rotated so that their one ``odd`` corner comes first."""
    first = odd[faces].argmax(1)
    return np.take_along_axis(
        faces,
        (first[:, None] + np.arange(3)) % 3,
        1,
    )


def _colours(scene: Scene, chart: ndarray, uv: ndarray, resolution_m: float) -> ndarray:
    layout = scene.layout
    level = np.log2(np.maximum(resolution_m / layout.texel_m[chart], 1)).astype(int).clip(0, LEVELS)
    cols, rows = level_offsets(layout.height)
    scale = 0.5**level
    x = (layout.x[chart] + layout.w[chart] * (uv[:, 0] % 1.0001)) * scale + cols[level] - 0.5
    y = (layout.y[chart] + layout.h[chart] * uv[:, 1]) * scale + rows[level] - 0.5
    return texels(scene.atlas, x, y).astype(np.float32) / 255
