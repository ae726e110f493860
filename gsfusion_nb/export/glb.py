"""Binary glTF 2.0: the container, arrays in its buffer, and its nodes with their places (Khronos glTF 2.0, sections
3.5, 3.6 and 4.4).
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..checks import shown
from ..files import SequenceError, atomic_file, open_regular, parse_json, parsing, read_exactly
from ..geometry import quaternion

WHAT = "a glTF file (.glb)"
_TYPES: dict[int, np.dtype] = {
    5120: np.dtype("<i1"), 5121: np.dtype("<u1"), 5122: np.dtype("<i2"), 5123: np.dtype("<u2"),
    5125: np.dtype("<u4"), 5126: np.dtype("<f4"),
}  # fmt: skip
_CODES = {dtype: code for code, dtype in _TYPES.items()}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_JSON_BYTES = 64_000_000
VERTICES, INDICES = 34962, 34963
"""What an array is for: attributes of points, numbers of vertices."""


class GlbArrays:
    """The arrays of a file that is being written."""

    def __init__(self):
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, values: np.ndarray, *, target: int = VERTICES, bounds: bool = False, normalised: bool = False) -> int:
        """Append an array [N, width] or [N] of float32, uint32 or uint8; returns the number of its accessor.

        Args:
            values: At least one row.
            target: ``VERTICES`` or ``INDICES``.
            bounds: Also store the smallest and largest value of each column, as glTF wants it for positions.
            normalised: Integers stand for 0..1.
        """
        width = 1 if values.ndim == 1 else values.shape[1]
        kind = next(name for name, n in _WIDTHS.items() if n == width)
        data = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"), copy=False)
        entry = {"bufferView": len(self.views), "componentType": _CODES[data.dtype], "count": len(data), "type": kind}
        if normalised:
            entry["normalized"] = True
        if bounds:
            entry |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        raw = data.tobytes()
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(raw), "target": target})
        self.accessors.append(entry)
        self.parts += [raw, b"\0" * (-len(raw) % 4)]
        self.size += len(raw) + (-len(raw) % 4)
        return len(self.accessors) - 1

    def document(self) -> dict[str, Any]:
        """The parts of the JSON document that describe the arrays."""
        if not self.accessors:
            return {}
        return {"accessors": self.accessors, "bufferViews": self.views, "buffers": [{"byteLength": self.size}]}


def write_glb(path: str | Path, document: dict[str, Any], arrays: GlbArrays) -> None:
    """Write a container: header, JSON padded with spaces, binary chunk padded with zeros. Atomically."""
    asset = {"asset": {"version": "2.0", "generator": "gsfusion_nb"}, "scene": 0}
    text = json.dumps(asset | document | arrays.document(), separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<I4s", arrays.size, b"BIN\0") if arrays.size else b""
    total = 12 + 8 + len(text) + len(chunk) + arrays.size
    with atomic_file(path, size_bytes=total) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON") + text + chunk)
        for part in arrays.parts:
            file.write(part)


class Glb:
    """A file that was read: its document, and its arrays on request."""

    def __init__(self, path: Path, document: dict[str, Any], chunk: bytes):
        self.path, self.document, self._chunk = path, document, chunk

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """Entry ``index`` of the list ``kind`` of the document, such as item("meshes", 0).

        Raises:
            SequenceError: there is none.
        """
        entries = self.document.get(kind)
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise SequenceError(f"{self.path} refers to entry {shown(index)} of {kind}, which it does not have")
        if not isinstance(entries[index], dict):
            raise SequenceError(f"{self.path}: entry {index} of {kind} must be an object, got {shown(entries[index])}")
        return entries[index]

    def array(self, index: object, *widths: int) -> np.ndarray:
        """An accessor as [N, width]: whole numbers as stored, normalised ones as float32.

        Raises:
            SequenceError: it has another width, lies outside the file, or is stored sparsely or in another file.
        """
        entry = self.item("accessors", index)
        width, dtype = _WIDTHS.get(str(entry.get("type"))), _TYPES.get(_whole(entry.get("componentType")))
        count = _whole(entry.get("count"))
        where = f"{self.path}: accessor {index}"
        if width not in widths or dtype is None or count < 0 or "sparse" in entry or "bufferView" not in entry:
            raise SequenceError(
                f"{where} must be a plain array with {' or '.join(map(str, widths))} numbers a row, got {shown(entry)}"
            )
        view = self.item("bufferViews", entry["bufferView"])
        start = _whole(view.get("byteOffset", 0)) + _whole(entry.get("byteOffset", 0))
        row = width * dtype.itemsize
        stride = _whole(view.get("byteStride", row))
        end = min(_whole(view.get("byteOffset", 0)) + _whole(view.get("byteLength")), len(self._chunk))
        fits = start >= 0 and stride >= row and start + (count - 1) * stride + row <= end
        if count and (view.get("buffer") != 0 or not fits):
            raise SequenceError(f"{where} reaches outside the file's binary part of {len(self._chunk)} bytes; damaged")
        shape, strides = (count, width), (stride, dtype.itemsize)
        values = np.ndarray(shape, dtype, self._chunk, start, strides) if count else np.zeros(shape, dtype)
        if not entry.get("normalized"):
            return values.copy()
        scaled = values.astype(np.float32) / np.float32(np.iinfo(dtype).max)
        return np.maximum(scaled, -1.0) if dtype.kind == "i" else scaled


def read_glb(path: str | Path) -> Glb:
    """Read a container.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no binary glTF 2.0, or it is truncated.
    """
    path = Path(path)
    with open_regular(path, WHAT) as file, parsing(path, WHAT):
        magic, version, _ = struct.unpack("<4sII", read_exactly(file, 12, path))
        if magic != b"glTF" or version != 2:
            raise SequenceError(f"{path} does not begin like binary glTF 2.0; expected {WHAT}")
        size, kind = struct.unpack("<I4s", read_exactly(file, 8, path))
        if kind != b"JSON" or size > _JSON_BYTES:
            raise SequenceError(f"{path} has no JSON part of at most {_JSON_BYTES} bytes; expected {WHAT}")
        document = parse_json(read_exactly(file, size, path).decode("utf-8"), str(path), WHAT)
        chunk, head = b"", file.read(8)
        if len(head) == 8:
            size, kind = struct.unpack("<I4s", head)
            chunk = read_exactly(file, size, path) if kind == b"BIN\0" else b""
    if not isinstance(document, dict):
        raise SequenceError(f"{path} must hold a JSON object, got {shown(document)}; expected {WHAT}")
    return Glb(path, document, chunk)


def _whole(value: object) -> int:
    """A whole number of the document; -1 for anything else."""
    return value if type(value) is int else -1


_DEEPEST = 64
_SKEW = 1e-3
"""Largest difference of the three scales of a node, as a share: Gaussians cannot be stretched."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A mesh of the file and its place: x -> scale R x + t."""

    primitives: list[dict[str, Any]]
    R: Tensor
    t: Tensor
    scale: float

    @property
    def is_identity(self) -> bool:
        """Whether nothing turns or moves."""
        return torch.equal(self.R, torch.eye(3).double()) and not bool(self.t.any())


def placed_meshes(glb: Glb, *, frame_of_map: str) -> Iterator[Placed]:
    """All meshes of the file's scene. The transform of a root node named ``frame_of_map`` is not applied.

    Raises:
        SequenceError: a node that is its own ancestor, or stretches more along one axis than along another.
    """
    scenes = glb.document.get("scenes")
    if isinstance(scenes, list) and scenes:
        roots = glb.item("scenes", glb.document.get("scene", 0)).get("nodes", [])
    else:
        roots = list(range(len(glb.document.get("nodes") or [])))
    seen: set[int] = set()
    todo = [(index, torch.eye(4, dtype=torch.float64), 0) for index in _list(glb, roots)]
    while todo:
        index, T_parent, depth = todo.pop(0)
        node = glb.item("nodes", index)
        if index in seen or depth > _DEEPEST:
            raise SequenceError(f"{glb.path} has a node {index} that is reached twice or too deep; it is damaged")
        seen.add(index)
        T = T_parent if depth == 0 and node.get("name") == frame_of_map else T_parent @ _transform(glb, node)
        if "mesh" in node:
            primitives = _list(glb, glb.item("meshes", node["mesh"]).get("primitives", []))
            if not all(isinstance(p, dict) for p in primitives):
                raise SequenceError(f"{glb.path}: the primitives of mesh {node['mesh']} must be objects")
            yield _placed(glb, index, primitives, T)
        todo += [(child, T, depth + 1) for child in _list(glb, node.get("children", []))]


def up_in_file(glb: Glb, *, frame_of_map: str) -> Tensor:
    """The up direction in the frame in which ``placed_meshes`` gives the meshes: glTF's y, seen from the map. [3]"""
    for node in _list(glb, glb.document.get("nodes", [])):
        if isinstance(node, dict) and node.get("name") == frame_of_map:
            return _transform(glb, node)[1, :3]
    return torch.tensor([0.0, 1, 0], dtype=torch.float64)


def _placed(glb: Glb, index: int, primitives: list[dict[str, Any]], T: Tensor) -> Placed:
    lengths = T[:3, :3].norm(dim=0)
    scale = float(lengths.mean())
    R = T[:3, :3] / max(scale, 1e-12)
    if not bool(((R.T @ R - torch.eye(3).double()).abs() < _SKEW).all()) or not float(torch.linalg.det(R)) > 0:
        raise SequenceError(f"{glb.path}: node {index} mirrors or stretches its mesh, got {T[:3, :3].tolist()}")
    return Placed(primitives=primitives, R=R, t=T[:3, 3], scale=1.0 if abs(scale - 1) < 1e-9 else scale)


def _transform(glb: Glb, node: dict[str, Any]) -> Tensor:
    if "matrix" in node:
        return _numbers(glb, node["matrix"], 16).view(4, 4).T
    T = torch.eye(4, dtype=torch.float64)
    x, y, z, w = _numbers(glb, node.get("rotation", [0, 0, 0, 1]), 4)
    T[:3, :3] = quaternion.to_matrix(torch.stack([w, x, y, z])) * _numbers(glb, node.get("scale", [1, 1, 1]), 3)
    T[:3, 3] = _numbers(glb, node.get("translation", [0, 0, 0]), 3)
    return T


def _numbers(glb: Glb, values: object, n: int) -> Tensor:
    if not isinstance(values, list) or len(values) != n or not all(type(v) in (int, float) for v in values):
        raise SequenceError(f"{glb.path} has a node with {shown(values)}; expected {n} numbers")
    return torch.tensor(values, dtype=torch.float64)


def _list(glb: Glb, values: object) -> list[Any]:
    if not isinstance(values, list):
        raise SequenceError(f"{glb.path} has {shown(values)} where a list is expected; it is damaged")
    return values
