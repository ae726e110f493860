"""PLY files: of 3D Gaussian splatting, which public viewers can open (layout of Kerbl et al. 2023's released code), and
of coloured triangle meshes.

Gaussians are binary little endian, 62 float32 properties, 248 bytes each, before activation:
``x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3``. Normals are 0; ``f_rest`` holds 15 coefficients
of red, then 15 of green, then 15 of blue; opacity is a logit, scales are logarithms, the quaternion is wxyz.

Meshes are binary little endian, with float32 positions, 8-bit colours and shared vertices.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..files import SequenceError, atomic_file, open_regular, parsing
from ..types import GaussianParams, Mesh

FARTHEST = 1e7
"""No coordinate and no size of a Gaussian is larger in a map, in any unit."""

_REST = 45
_NAMES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(_REST)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
"""The 62 properties in the order of the file."""


def write_gaussian_ply(path: str | Path, params: GaussianParams) -> None:
    """Write a Gaussian map in the standard layout, atomically.

    Colours of a lower SH degree are padded with zero coefficients to degree 3, which looks the same and can be opened
    by every viewer.

    Raises:
        ValueError: The SH degree is above 3.
    """
    from plyfile import PlyData, PlyElement

    n, coefficients = params.sh.shape[:2]
    if coefficients not in (1, 4, 9, 16):
        raise ValueError(f"sh must have 1, 4, 9 or 16 coefficients (degree 0 to 3), got {coefficients}")
    sh = params.sh.detach()
    rest = sh.new_zeros(n, 3, 15)
    rest[:, :, : coefficients - 1] = sh[:, 1:].transpose(1, 2)  # by channel, then coefficient
    columns = [
        params.xyz_W,
        torch.zeros_like(params.xyz_W),
        sh[:, 0],
        rest.reshape(n, _REST),
        params.opacity_logit[:, None],
        params.log_scale,
        params.quat,
    ]
    table = torch.cat([c.detach().to("cpu", torch.float32) for c in columns], dim=1).contiguous().numpy()
    rows = table.astype("<f4", copy=False).view([(name, "<f4") for name in _NAMES]).reshape(n)
    with atomic_file(path) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], text=False, byte_order="<").write(str(temporary))


def read_gaussian_ply(path: str | Path) -> GaussianParams:
    """Read a Gaussian map written by this or another program; 0, 9, 24 or 45 ``f_rest`` properties give degree 0 to 3.

    The order of the properties, their types and the byte order do not matter; what is not needed is skipped.

    Raises:
        FileNotFoundError: The file does not exist. ValueError: The file is not a PLY file of Gaussians, is truncated,
            contains NaN, or Gaussians that no map has; the message names the missing part or the first such row.
    """
    path, what = Path(path), "a PLY file of Gaussians"
    ply = _read(path, what)
    data = ply["vertex"].data if "vertex" in ply else np.zeros(0, [])
    present = data.dtype.names or ()
    n_rest = sum(name.startswith("f_rest_") for name in present)
    rest_names = tuple(f"f_rest_{i}" for i in range(n_rest))
    lacking = [n for n in (*_NAMES[:3], *_NAMES[6:9], *rest_names, *_NAMES[-8:]) if n not in present]
    if lacking:
        raise ValueError(f"{path} has no properties {', '.join(lacking)}; expected {what}")
    if n_rest not in (0, 9, 24, 45):
        raise ValueError(f"{path} must have 0, 9, 24 or 45 f_rest properties (degree 0 to 3), got {n_rest}")

    def columns(*names: str) -> torch.Tensor:
        out = np.empty((len(data), len(names)), dtype=np.float32)
        with parsing(path, what), np.errstate(over="ignore"):
            for i, name in enumerate(names):
                out[:, i] = data[name]
        _check_rows(path, out, names)
        return torch.from_numpy(out)

    rest = columns(*rest_names).reshape(len(data), 3, n_rest // 3).transpose(1, 2)
    gaussians = GaussianParams(
        xyz_W=columns("x", "y", "z"),
        log_scale=columns("scale_0", "scale_1", "scale_2"),
        quat=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacity_logit=columns("opacity")[:, 0],
        sh=torch.cat([columns(*_NAMES[6:9])[:, None], rest], dim=1),
    )
    for wrong, rows in (
        (f"a place beyond {FARTHEST:g}", (gaussians.xyz_W.abs() > FARTHEST).any(dim=1)),
        (f"a size above {FARTHEST:g}", (gaussians.log_scale > math.log(FARTHEST)).any(dim=1)),
        ("a rotation whose quaternion is zero", (gaussians.quat == 0).all(dim=1)),
    ):
        if rows.any():
            raise SequenceError(f"{path} has {wrong} in row {int(rows.int().argmax())} of Gaussians; expected {what}")
    return gaussians


def _check_rows(path: Path, columns: np.ndarray, names: tuple[str, ...]) -> None:
    """Raise ``SequenceError`` if a row of ``columns`` [N, C] contains NaN or infinities; names the first."""
    if (bad := np.argwhere(~np.isfinite(columns))).size:
        row, column = bad[0]
        raise SequenceError(
            f"{path} contains NaN or infinities, the first is {names[column]} of row {row}; expected finite numbers"
        )


def _read(path: Path, what: str, **options: Any) -> Any:
    """The parsed file. It is memory-mapped, which is faster, where its rows have a fixed size."""
    from plyfile import PlyData, PlyParseError

    with open_regular(path, what) as file:
        head = file.read(1 << 16).partition(b"end_header")[0]
    rows = sum(int(n) for n in re.findall(rb"(?m)^\s*element\s+\S+\s+(\d{1,18})", head))
    if rows > path.stat().st_size:
        raise SequenceError(f"{path} claims {rows:,} rows, more than it has bytes; expected {what}")
    with parsing(path, what):
        try:
            return PlyData.read(str(path), **options)
        except (PlyParseError, ValueError):
            return PlyData.read(str(path), mmap=False)  # pyright: ignore[reportArgumentType]


_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_FACE_LISTS = ("vertex_indices", "vertex_index")
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
_ROWS = 1 << 18
"""Rows that are written together."""


def write_mesh_ply(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh, atomically. Colours are rounded to 8 bits. MeshLab, Blender, Open3D and PyVista can read it."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(mesh.vertices_W)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, ""]).encode("ascii"))
        for xyz, rgb in zip(mesh.vertices_W.split(_ROWS), mesh.rgb.split(_ROWS), strict=True):
            vertices = np.zeros(len(xyz), dtype=_VERTEX)
            vertices["xyz"] = xyz.detach().cpu().numpy()
            vertices["rgb"] = (rgb.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()
            file.write(vertices.tobytes())
        for part in mesh.faces.split(_ROWS):
            faces = np.zeros(len(part), dtype=_FACE)
            faces["count"], faces["vertices"] = 3, part.cpu().numpy()
            file.write(faces.tobytes())


def read_mesh_ply(path: str | Path) -> Mesh:
    """Read a triangle mesh written by this or another program; without colours it is grey (0.5).

    Raises:
        FileNotFoundError: The file does not exist. ValueError: The file is not a PLY file of a triangle mesh, contains
            NaN or infinities, or has faces with vertices that do not exist.
    """
    path, what = Path(path), "a PLY file of a mesh"
    ply = _read(path, what, known_list_len={"face": dict.fromkeys(_FACE_LISTS, 3)})
    if "vertex" not in ply or not {"x", "y", "z"} <= set(ply["vertex"].data.dtype.names or ()):
        raise ValueError(f"{path} has no element 'vertex' with x, y, z; expected a PLY file of a mesh")
    vertex = ply["vertex"].data
    with parsing(path, what), np.errstate(over="ignore"):
        xyz = np.stack([vertex[axis].astype(np.float32) for axis in "xyz"], axis=-1)
        rgb = np.full((len(vertex), 3), 0.5, dtype=np.float32)
        if {"red", "green", "blue"} <= set(vertex.dtype.names):
            colour = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=-1)
            rgb = colour.astype(np.float32) / (255.0 if colour.dtype == np.uint8 else 1.0)
    _check_rows(path, xyz, ("x", "y", "z"))
    _check_rows(path, rgb, ("red", "green", "blue"))
    faces = _triangles(ply, path)
    try:
        return Mesh(vertices_W=torch.from_numpy(xyz), faces=faces, rgb=torch.from_numpy(rgb).to(torch.float32))
    except ValueError as e:
        raise SequenceError(f"{path}: {e}") from None


def _triangles(ply, path: Path) -> torch.Tensor:
    if "face" not in ply or not len(ply["face"].data):
        return torch.zeros(0, 3, dtype=torch.int32)
    data = ply["face"].data
    name = next((n for n in _FACE_LISTS if n in data.dtype.names), None)
    if name is None:
        raise ValueError(f"{path} has no face property vertex_indices; expected a PLY file of a mesh")
    column = data[name]
    if column.dtype == object:
        sizes = {len(face) for face in column}
        if sizes != {3}:
            raise ValueError(
                f"{path} must contain only triangles, got faces with {', '.join(map(str, sorted(sizes)))} vertices"
            )
        column = np.stack(list(column))
    if column.dtype.kind not in "iu" or int(column.max()) >= 2**31:
        raise ValueError(f"{path} must have whole vertex numbers below 2^31, got {column.dtype} up to {column.max()}")
    return torch.from_numpy(np.array(column, dtype=np.int32))
