"""Binary glTF 2.0: the container, and arrays in its buffer (Khronos glTF 2.0, sections 3.6 and 4.4)."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SequenceError, shown
from ..files import atomic_file
from ..foreign import open_regular, parse_json, parsing, read_exactly

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
