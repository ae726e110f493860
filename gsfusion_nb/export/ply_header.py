"""Checks the header of a PLY file against the size of the file before the rest is read.

The header gives the number of rows; a reader that trusts a wrong number asks for too much memory.
"""

from pathlib import Path

import numpy as np

from ..errors import SequenceError, shown
from ..foreign import open_regular

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
