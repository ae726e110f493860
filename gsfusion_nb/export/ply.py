"""PLY files of coloured triangle meshes, and the reading of PLY files of any kind.

Meshes are binary little endian, with float32 positions, 8-bit colours and shared vertices.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..errors import ArgumentError, SequenceError
from ..files import atomic_file, open_regular, parsing
from ..types import Mesh


def _check_rows(
    path: Path,
    columns: np.ndarray,
    names: tuple[str, ...],
) -> None:
    """Raise ``SequenceError`` if a row of ``columns`` [N, C] contains NaN or infinities; names the
    first."""
    if (bad := np.argwhere(~np.isfinite(columns))).size:
        row, column = bad[0]
        raise SequenceError(
            f"{path} contains NaN or infinities, the first is {names[column]} of row {row}; "
            "expected finite numbers"
        )


def read_ply(path: Path, what: str, **options: Any) -> Any:
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
    """Write a mesh, atomically. Colours are rounded to 8 bits. MeshLab, Blender, Open3D and PyVista
    can read it."""
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
        for xyz, rgb in zip(
            mesh.vertices_W.split(_ROWS),
            mesh.rgb.split(_ROWS),
            strict=True,
        ):
            vertices = np.zeros(len(xyz), dtype=_VERTEX)
            vertices["xyz"] = xyz.detach().cpu().numpy()
            vertices["rgb"] = (
                (rgb.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()
            )
            file.write(vertices.tobytes())
        for part in mesh.faces.split(_ROWS):
            faces = np.zeros(len(part), dtype=_FACE)
            faces["count"] = 3
            faces["vertices"] = part.cpu().numpy()
            file.write(faces.tobytes())


def read_mesh_ply(path: str | Path) -> Mesh:
    """Read a triangle mesh written by this or another program; without colours it is grey (0.5).

    Raises:
        FileNotFoundError: The file does not exist. ValueError: The file is not a PLY file of a
            triangle mesh, contains NaN or infinities, or has faces with vertices that do not exist.
    """
    path = Path(path)
    what = "a PLY file of a mesh"
    ply = read_ply(path, what, known_list_len={"face": dict.fromkeys(_FACE_LISTS, 3)})
    if "vertex" not in ply or not {"x", "y", "z"} <= set(ply["vertex"].data.dtype.names or ()):
        raise ArgumentError(
            f"{path} has no element 'vertex' with x, y, z; expected a PLY file of a mesh"
        )
    vertex = ply["vertex"].data
    with parsing(path, what), np.errstate(over="ignore"):
        xyz = np.stack(
            [vertex[axis].astype(np.float32) for axis in "xyz"],
            axis=-1,
        )
        rgb = np.full((len(vertex), 3), 0.5, dtype=np.float32)
        if {"red", "green", "blue"} <= set(vertex.dtype.names):
            colour = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=-1)
            rgb = colour.astype(np.float32) / (255.0 if colour.dtype == np.uint8 else 1.0)
    _check_rows(path, xyz, ("x", "y", "z"))
    _check_rows(path, rgb, ("red", "green", "blue"))
    faces = _triangles(ply, path)
    try:
        return Mesh(
            vertices_W=torch.from_numpy(xyz),
            faces=faces,
            rgb=torch.from_numpy(rgb).to(torch.float32),
        )
    except ValueError as e:
        raise SequenceError(f"{path}: {e}") from None


def _triangles(ply, path: Path) -> torch.Tensor:
    if "face" not in ply or not len(ply["face"].data):
        return torch.zeros(0, 3, dtype=torch.int32)
    data = ply["face"].data
    name = next((n for n in _FACE_LISTS if n in data.dtype.names), None)
    if name is None:
        raise ArgumentError(
            f"{path} has no face property vertex_indices; expected a PLY file of a mesh"
        )
    column = data[name]
    if column.dtype == object:
        sizes = {len(face) for face in column}
        if sizes != {3}:
            raise ArgumentError(
                f"{path} must contain only triangles, got faces with "
                f"{', '.join(map(str, sorted(sizes)))} vertices"
            )
        column = np.stack(list(column))
    if column.dtype.kind not in "iu" or int(column.max()) >= 2**31:
        raise ArgumentError(
            f"{path} must have whole vertex numbers below 2^31, got {column.dtype} up to "
            f"{column.max()}"
        )
    return torch.from_numpy(np.array(column, dtype=np.int32))
