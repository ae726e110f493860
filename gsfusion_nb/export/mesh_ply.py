"""A coloured triangle mesh as PLY: binary little endian, float32 positions, 8-bit colours, shared vertices."""

from pathlib import Path

import numpy as np
import torch

from ..errors import SequenceError
from ..files import atomic_file
from ..foreign import parsing
from ..types import Mesh
from .ply_header import check_ply_header, check_ply_rows

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_FACE_LISTS = ("vertex_indices", "vertex_index")
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_mesh_ply(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh, atomically. Colours are rounded to 8 bits. MeshLab, Blender, Open3D and PyVista can read it."""
    vertices = np.zeros(mesh.vertices_W.shape[0], dtype=_VERTEX)
    vertices["xyz"] = mesh.vertices_W.detach().cpu().numpy()
    vertices["rgb"] = (mesh.rgb.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()
    faces = np.zeros(mesh.faces.shape[0], dtype=_FACE)
    faces["count"] = 3
    faces["vertices"] = mesh.faces.cpu().numpy()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    size = vertices.nbytes + faces.nbytes
    with atomic_file(path, size_bytes=size) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, ""]).encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def read_mesh_ply(path: str | Path) -> Mesh:
    """Read a triangle mesh written by this or another program; without colours it is grey (0.5).

    Raises:
        FileNotFoundError: The file does not exist. ValueError: The file is not a PLY file of a triangle mesh, contains
            NaN or infinities, or has faces with vertices that do not exist.
    """
    path, what = Path(path), "a PLY file of a mesh"
    check_ply_header(path, what)
    with parsing(path, what):
        ply = _read(path)
    if "vertex" not in ply or not {"x", "y", "z"} <= set(ply["vertex"].data.dtype.names or ()):
        raise ValueError(f"{path} has no element 'vertex' with x, y, z; expected a PLY file of a mesh")
    vertex = ply["vertex"].data
    with parsing(path, what), np.errstate(over="ignore"):
        xyz = np.stack([vertex[axis].astype(np.float32) for axis in "xyz"], axis=-1)
        rgb = np.full((len(vertex), 3), 0.5, dtype=np.float32)
        if {"red", "green", "blue"} <= set(vertex.dtype.names):
            colour = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=-1)
            rgb = colour.astype(np.float32) / (255.0 if colour.dtype == np.uint8 else 1.0)
    check_ply_rows(path, "vertex", xyz, ("x", "y", "z"))
    check_ply_rows(path, "vertex", rgb, ("red", "green", "blue"))
    faces = _triangles(ply, path)
    try:
        return Mesh(vertices_W=torch.from_numpy(xyz), faces=faces, rgb=torch.from_numpy(rgb).to(torch.float32))
    except ValueError as e:
        raise SequenceError(f"{path}: {e}") from None


def _read(path: Path):
    """The parsed file. A list of triangles is memory-mapped; other polygons are read row by row, which is slower."""
    from plyfile import PlyData, PlyParseError

    try:
        return PlyData.read(str(path), known_list_len={"face": dict.fromkeys(_FACE_LISTS, 3)})
    except (PlyParseError, ValueError):
        return PlyData.read(str(path), mmap=False)  # pyright: ignore[reportArgumentType]


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
