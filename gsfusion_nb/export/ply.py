"""PLY files: of 3D Gaussian splatting, which public viewers can open (layout of Kerbl et al. 2023's released code), of
PlayCanvas and SuperSplat (compressed, read only), and of coloured triangle meshes.

Gaussians are binary little endian, 62 float32 properties, 248 bytes each, before activation:
``x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3``. Normals are 0; ``f_rest`` holds 15 coefficients
of red, then 15 of green, then 15 of blue; opacity is a logit, scales are logarithms, the quaternion is wxyz.

Compressed ones come in groups of 256 with bounds, 16 bytes per Gaussian. Element ``chunk`` has the smallest and largest
position, logarithm of the scale and colour of each group. Element ``vertex`` has four words of 32 bits: position and
scale as shares of the bounds in 11, 10 and 11 bits; the rotation without its largest part, 10 bits each, and that
part's place in 2; colour and opacity in 8 bits each. Element ``sh`` has a byte for each coefficient, from -4 to 4.

Meshes are binary little endian, with float32 positions, 8-bit colours and shared vertices. The header of every file is
checked against the size of the file before the rest is read: a reader that trusts a wrong number of rows asks for too
much memory.
"""

import math
from pathlib import Path

import numpy as np
import torch

from ..checks import shown
from ..files import SequenceError, atomic_file, open_regular, parsing
from ..geometry.spherical_harmonics import rgb_to_sh_dc
from ..types import GaussianParams, Mesh
from .packed_values import params_of, quaternion_of_three, sh_of_rgb, share

_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_HEADER_BYTES = 1 << 20


def check_ply_header(path: Path, what: str) -> None:
    """Raise ``SequenceError`` unless ``path`` is a regular PLY file, large enough for the rows in its header."""
    with open_regular(path, what) as file:
        head = file.read(_HEADER_BYTES)
        size = file.seek(0, 2)
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        raise SequenceError(f"{path} is not a readable PLY file (it does not begin with a PLY header); expected {what}")
    lines = [line.split() for line in head[:end].decode("ascii", errors="replace").splitlines()]
    text = any(words[:2] == ["format", "ascii"] for words in lines)
    needed, rows, name = 0, 0, ""
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            name, rows = words[1], int(words[2])
        elif words[:1] == ["property"] and len(words) in (3, 5):
            kind = words[2] if words[1] == "list" else words[1]  # an empty list still has its length
            if kind not in _BYTES:
                raise SequenceError(f"{path} has a property of the unknown type {shown(kind)}; expected {what}")
            needed += rows * (2 if text else _BYTES[kind])
            if needed > size:
                raise SequenceError(
                    f"{path} says it has {rows} rows of {name}, but its {size} bytes are too few for them; it is "
                    "truncated or damaged"
                )


def check_ply_rows(path: Path, element: str, columns: np.ndarray, names: tuple[str, ...]) -> None:
    """Raise ``SequenceError`` if a row of ``columns`` [N, C] contains NaN or infinities; names the first."""
    bad = ~np.isfinite(columns)
    if bad.any():
        rows = bad.any(axis=1)
        row = int(rows.argmax())
        raise SequenceError(
            f"{path} contains NaN or infinities in {int(rows.sum())} rows of {element}, the first is "
            f"{names[int(bad[row].argmax())]} of row {row}; expected finite numbers"
        )


_REST = 45
_RGB = ("red", "green", "blue")
_DISC_LOG_M = math.log(1e-6)
NAMES = (
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
    rows = table.astype("<f4", copy=False).view([(name, "<f4") for name in NAMES]).reshape(n)
    with atomic_file(path, size_bytes=table.nbytes) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], text=False, byte_order="<").write(str(temporary))


def read_gaussian_ply(path: str | Path) -> GaussianParams:
    """Read a Gaussian map written by this or another program; 0, 9, 24 or 45 ``f_rest`` properties give degree 0 to 3.

    The order of the properties, their types and the byte order do not matter; what is not needed is skipped. A file of
    2D Gaussian splatting has no ``scale_2``: its discs get a thickness of a micrometre. Colours given as ``red green
    blue`` 0..255 instead of ``f_dc`` are accepted, and so are compressed PLY files.

    Raises:
        FileNotFoundError: The file does not exist. ValueError: The file is not a PLY file of Gaussians, is truncated,
            or contains NaN; the message names the missing part or the first such row.
    """
    path, what = Path(path), "a PLY file of Gaussians"
    check_ply_header(path, what)
    with parsing(path, what):
        ply = _read(path)
    if "vertex" not in ply:
        raise ValueError(f"{path} has no element 'vertex'; expected a PLY file of Gaussians")
    if is_compressed(ply):
        with parsing(path, what):
            return decompressed(path, ply)
    data = ply["vertex"].data
    present = set(data.dtype.names or ())
    n_rest = sum(name.startswith("f_rest_") for name in present)
    rest_names = tuple(f"f_rest_{i}" for i in range(n_rest))
    has_rgb = not present.intersection(NAMES[6:9]) and present.issuperset(_RGB)
    colour_names = _RGB if has_rgb else NAMES[6:9]
    flat = "scale_2" not in present
    shape_names = [n for n in NAMES[-8:] if not (flat and n == "scale_2" and "scale_1" in present)]
    lacking = [n for n in (*NAMES[:3], *colour_names, *rest_names, *shape_names) if n not in present]
    if lacking:
        raise ValueError(f"{path} has no properties {', '.join(lacking)}; expected a PLY file of Gaussians")
    if n_rest not in (0, 9, 24, 45):
        raise ValueError(f"{path} must have 0, 9, 24 or 45 f_rest properties (degree 0 to 3), got {n_rest}")

    def columns(*names: str) -> torch.Tensor:
        out = np.empty((len(data), len(names)), dtype=np.float32)
        with parsing(path, what), np.errstate(over="ignore"):
            for i, name in enumerate(names):
                out[:, i] = data[name]
        check_ply_rows(path, "vertex", out, names)
        return torch.from_numpy(out)

    rest = columns(*rest_names).reshape(len(data), 3, n_rest // 3).transpose(1, 2)
    scale = columns("scale_0", "scale_1") if flat else columns("scale_0", "scale_1", "scale_2")
    scale = torch.cat([scale, torch.full_like(scale[:, :1], _DISC_LOG_M)], dim=1) if flat else scale
    dc = columns(*colour_names)
    dc = rgb_to_sh_dc(dc / 255) if has_rgb else dc
    return GaussianParams(
        xyz_W=columns("x", "y", "z"),
        log_scale=scale,
        quat=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacity_logit=columns("opacity")[:, 0],
        sh=torch.cat([dc[:, None], rest], dim=1),
    )


def _read(path: Path):
    """The parsed file. It is memory-mapped, which is faster; a file without rows cannot be, and is read normally."""
    from plyfile import PlyData

    try:
        return PlyData.read(str(path))
    except ValueError:
        return PlyData.read(str(path), mmap=False)  # pyright: ignore[reportArgumentType]


GROUP = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(ply) -> bool:
    """Whether a parsed PLY file is one of these."""
    return "chunk" in ply and "vertex" in ply and "packed_position" in (ply["vertex"].data.dtype.names or ())


def decompressed(path: Path, ply) -> GaussianParams:
    """The Gaussians of a parsed file.

    Raises:
        SequenceError: a property is missing, or there are fewer groups than Gaussians need.
    """
    rows, groups = ply["vertex"].data, ply["chunk"].data
    n = len(rows)
    bounds = [f"{side}_{a}" for a in ("x", "y", "z", "scale_x", "scale_y", "scale_z") for side in ("min", "max")]
    lacking = [name for name in _PACKED if name not in rows.dtype.names]
    lacking += [name for name in bounds if name not in groups.dtype.names]
    if lacking or len(groups) * GROUP < n:
        raise SequenceError(
            f"{path} has {len(groups)} groups for {n} Gaussians and lacks {', '.join(lacking) or 'no property'}; "
            f"expected a compressed PLY file with a group for every {GROUP}"
        )
    group = np.arange(n) // GROUP
    position, rotation, scale, colour = (rows[name].astype(np.uint32) for name in _PACKED)

    def between(shares: np.ndarray, axes: tuple[str, ...]) -> np.ndarray:
        low, high = (np.stack([groups[f"{side}_{a}"] for a in axes], 1).astype(np.float64) for side in ("min", "max"))
        check_ply_rows(path, "chunk", np.concatenate([low, high], 1), tuple(f"min_{a}" for a in axes + axes))
        return low[group] * (1 - shares) + high[group] * shares

    def in_32_bits(packed: np.ndarray) -> np.ndarray:
        return np.stack([share(packed, 21, 11), share(packed, 11, 10), share(packed, 0, 11)], axis=1)

    rgb = np.stack([share(colour, shift, 8) for shift in (24, 16, 8)], axis=1)
    rgb = between(rgb, ("r", "g", "b")) if "min_r" in groups.dtype.names else rgb
    three = np.stack([share(rotation, shift, 10) for shift in (20, 10, 0)], axis=1)
    quat = quaternion_of_three((three - 0.5) * np.sqrt(2.0), (rotation >> np.uint32(30)).astype(np.int64))
    sh = np.concatenate([sh_of_rgb(rgb)[:, None], _rest(path, ply, n)], axis=1)
    return params_of(
        between(in_32_bits(position), ("x", "y", "z")),
        between(in_32_bits(scale), ("scale_x", "scale_y", "scale_z")),
        quat, share(colour, 0, 8), sh,
    )  # fmt: skip


def _rest(path: Path, ply, n: int) -> np.ndarray:
    """The coefficients of higher degree. [N, K - 1, 3]"""
    if "sh" not in ply:
        return np.zeros((n, 0, 3))
    data = ply["sh"].data
    names = [f"f_rest_{i}" for i in range(len(data.dtype.names))]
    if len(names) not in (9, 24, 45) or set(names) != set(data.dtype.names) or len(data) != n:
        raise SequenceError(f"{path} has {len(data)} rows of {len(names)} coefficients for {n} Gaussians; damaged")
    steps = np.stack([data[name] for name in names], axis=1).astype(np.float64)
    shares = np.where(steps == 0, 0.0, np.where(steps == 255, 1.0, (steps + 0.5) / 256))
    return ((shares - 0.5) * 8).reshape(n, 3, -1).transpose(0, 2, 1)


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
        ply = _read_mesh(path)
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


def _read_mesh(path: Path):
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
