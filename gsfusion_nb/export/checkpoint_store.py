"""Checkpoints of a run: each is complete, but only what has changed since the previous one is written.

A state becomes plain values for JSON, with its tensors stored separately. For each checkpoint n a folder holds
``n.json`` (the structure of the state, and the list of its pieces) and ``n.pieces`` (the data that is new). Tensors are
cut into pieces that are identified by the SHA-256 of their bytes: a piece that is in an earlier file is not written
again, and a damaged piece is detected. ``n.json`` begins with its own SHA-256 and is written last, after the pieces;
until then the previous checkpoint is the valid one, and it is kept until the next is complete. When less than half of
the bytes on disk are still needed, all pieces are written again.

No code from the files is executed when they are read.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..checks import check_whole, shown
from ..files import atomic_file, open_regular, read_exactly, read_text, reason_of, write_file
from ..work import available_memory

SMALL_BYTES = 1 << 12
"""Tensors below this size are written together, as one."""
_TAG = "$"
_DTYPES = {str(t).removeprefix("torch."): t for t in (
    torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.int16, torch.int8,
    torch.uint8, torch.bool,
)}  # fmt: skip


class Packing:
    """Turns a state into JSON with tensors stored separately: large ones in a list, small ones in one buffer."""

    def __init__(self):
        self.large: list[Tensor] = []
        self.small = bytearray()

    def plain(self, value: Any, name: str) -> Any:
        """``value`` for JSON. Raises ``TypeError``, with the place, for a type that cannot be saved."""
        if isinstance(value, Tensor):
            return self._tensor(value.detach() if value.requires_grad else value)
        if value is None or type(value) in (bool, int, float, str):
            return value
        if type(value) is dict:
            for key in value:
                if type(key) is not str or key == _TAG:
                    raise TypeError(f"{name} must have strings as keys, got {key!r}")
            return {key: self.plain(v, f"{name}[{key!r}]") for key, v in value.items()}
        if type(value) in (list, tuple):
            items = [self.plain(v, f"{name}[{i}]") for i, v in enumerate(value)]
            return items if type(value) is list else {_TAG: "tuple", "items": items}
        raise TypeError(
            f"{name} must be a tensor, number, string, None, or a dict, list or tuple of those, got {type(value)}"
        )

    def _tensor(self, value: Tensor) -> dict[str, Any]:
        if value.nbytes >= SMALL_BYTES:
            self.large.append(value)
            return {_TAG: "tensor", "n": len(self.large) - 1}
        at = len(self.small)
        self.small += bytes_of(value).tobytes()
        dtype = str(value.dtype).removeprefix("torch.")
        return {_TAG: "small", "dtype": dtype, "shape": list(value.shape), "at": at}


def unpack(value: Any, tensors: list[Tensor], small: bytes, device: torch.device | str) -> Any:
    """The state that ``Packing.plain`` was given. Raises ``ValueError`` for missing tensors."""
    if type(value) is list:
        return [unpack(v, tensors, small, device) for v in value]
    if type(value) is not dict:
        return value
    kind = value.get(_TAG)
    if kind == "tuple":
        return tuple(unpack(v, tensors, small, device) for v in value["items"])
    if kind == "tensor":
        check_whole("number of a tensor", value["n"], 0, len(tensors) - 1)
        return tensors[value["n"]]
    if kind == "small":
        check_whole("place of a tensor", value["at"], 0, len(small))
        size = _DTYPES[value["dtype"]].itemsize * math.prod(value["shape"])
        return tensor_of(value["dtype"], value["shape"], small[value["at"] : value["at"] + size], device)
    if kind is not None:
        raise ValueError(f"it contains a value of the unknown kind {shown(kind)}")
    return {key: unpack(v, tensors, small, device) for key, v in value.items()}


def tensor_of(dtype: str, shape: list[int], content: bytes, device: torch.device | str) -> Tensor:
    """A tensor from the bytes of its numbers, row by row. Raises ``ValueError`` if their number does not fit."""
    for side in shape:
        check_whole("side of a tensor", side, 0)
    if len(content) != _DTYPES[dtype].itemsize * math.prod(shape):
        raise ValueError(f"a tensor {shape} of {dtype} cannot have {len(content)} bytes")
    if dtype == "bool" and content and np.frombuffer(content, np.uint8).max() > 1:
        raise ValueError("a boolean tensor must hold 0 and 1")
    flat = (
        torch.frombuffer(bytearray(content), dtype=_DTYPES[dtype]) if content else torch.zeros(0, dtype=_DTYPES[dtype])
    )
    return flat.reshape(shape).to(device)


def bytes_of(tensor: Tensor) -> np.ndarray:
    """The bytes of a tensor's numbers, row by row."""
    flat = tensor.detach().cpu().contiguous().reshape(-1)
    if flat.stride() != (1,):  # a single element of an expanded tensor
        flat = torch.empty(flat.shape, dtype=flat.dtype).copy_(flat)
    return flat.view(torch.uint8).numpy()


FORMAT = "gsfusion_nb checkpoint"
VERSION = 5
PIECE_BYTES = 1 << 18

Piece = tuple[str, str, int, int]
"""SHA-256, file, offset and size of a piece."""


@dataclass(frozen=True, kw_only=True)
class Saved:
    """Result of saving a checkpoint."""

    number: int
    written_bytes: int
    total_bytes: int
    """Size of the whole checkpoint, in this and earlier files."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Loaded:
    """A checkpoint that was read."""

    state: dict[str, Any]
    number: int
    passed_over: str
    """Why a later checkpoint could not be used; empty if this is the latest."""


class CheckpointStore:
    """Saves and loads checkpoints in one folder."""

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self._known: dict[str, Piece] = {}
        self._constant: dict[int, tuple[Tensor, list[str]]] = {}
        self._number = self._before = max([0, *self._numbers()])
        self._files_before: set[str] = set()

    def save(self, state: dict[str, Any], *, constant: Iterable[Tensor] = ()) -> Saved:
        """Write a checkpoint: nested dictionaries, lists and tuples of tensors, numbers, strings and None.

        Args:
            state: What to save. Tensors on a GPU are copied to the CPU.
            constant: Tensors in it that never change (images); they are hashed only once.

        Raises:
            TypeError: Another type in ``state``; the message names the place.
            DiskFullError: The disk is full; the previous checkpoint is still valid.
        """
        packing = Packing()
        tree = packing.plain(state, "state")
        constants = {id(t) for t in constant}
        pieces, content = self._pieces(packing.large, constants), packing.small
        number = self._number + 1
        tensors = [[str(t.dtype).removeprefix("torch."), list(t.shape), keys] for t, keys in pieces]
        small = torch.frombuffer(content, dtype=torch.uint8) if content else torch.zeros(0, dtype=torch.uint8)
        small_keys = [key for key, _ in _cut(small)]
        blobs = [*pieces, (small, small_keys)]
        live = {key: size for t, keys in blobs for key, size in zip(keys, _sizes(t.nbytes), strict=True)}
        name = f"{number:06d}.pieces"
        self._forget_sparse_files(live)
        fresh = {key for key in live if key not in self._known}
        places = self._write(name, blobs, fresh, sum(live[key] for key in fresh))
        known = {key: piece for key, piece in (self._known | places).items() if key in live}
        document = {
            "format": FORMAT, "version": VERSION, "number": number, "state": tree, "tensors": tensors,
            "small": small_keys, "pieces": list(known.values()),
        }  # fmt: skip
        text = json.dumps(document, separators=(",", ":"))
        write_file(self.folder / f"{number:06d}.json", f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}")
        self._known = known
        self._constant = {id(t): (t, keys) for t, keys in pieces if id(t) in constants}
        files = {piece[1] for piece in self._known.values()}
        self._remove_all_but({f"{n:06d}.json" for n in (self._before, number)} | files | self._files_before)
        self._number, self._before, self._files_before = number, number, files
        return Saved(number=number, written_bytes=sum(live[key] for key in fresh), total_bytes=sum(live.values()))

    def load(self, device: torch.device | str = "cpu") -> Loaded:
        """The latest checkpoint that is not damaged.

        Raises:
            FileNotFoundError: There is none. ValueError: All are damaged, or from another version.
        """
        problems: list[str] = []
        for number in sorted(self._numbers(), reverse=True):
            path = self.folder / f"{number:06d}.json"
            try:
                state, pieces = self._read(path, device)
            except Exception as e:  # damaged content can cause any error
                problems.append(f"{path} cannot be used ({reason_of(e)})")
                continue
            self._known = {piece[0]: piece for piece in pieces}
            self._before, self._files_before = number, {piece[1] for piece in pieces}
            return Loaded(state=state, number=number, passed_over="; ".join(problems))
        if not problems:
            raise FileNotFoundError(f"{self.folder} holds no checkpoint")
        raise ValueError("; ".join(problems))

    @property
    def exists(self) -> bool:
        """Whether there is a checkpoint, damaged or not."""
        return bool(self._numbers())

    def remove(self) -> None:
        """Remove all checkpoints, and the folder if it is empty afterwards."""
        self._remove_all_but(set())
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _numbers(self) -> list[int]:
        names = [p.name for p in self.folder.iterdir()] if self.folder.is_dir() else []
        return [int(name[:6]) for name in names if re.fullmatch(r"\d{6}\.json", name)]

    def _pieces(self, tensors: list[Tensor], constants: set[int]) -> list[tuple[Tensor, list[str]]]:
        """The keys of the pieces of every tensor."""
        found = []
        for tensor in tensors:
            known = self._constant.get(id(tensor)) if id(tensor) in constants else None
            found.append(known or (tensor, [key for key, _ in _cut(tensor)]))
        return found

    def _forget_sparse_files(self, live: dict[str, int]) -> None:
        """Forget all earlier pieces, so that they are written again, if less than half of their files is still used."""
        used = {self._known[key][1] for key in live if key in self._known}
        on_disk = sum((self.folder / name).stat().st_size for name in used)
        if on_disk > 2 * sum(live.values()):
            self._known = {}

    def _write(self, name: str, blobs: list[tuple[Tensor, list[str]]], fresh: set[str], size: int) -> dict[str, Piece]:
        places: dict[str, Piece] = {}
        if not fresh:
            return places
        with atomic_file(self.folder / name, size_bytes=size) as temporary, temporary.open("wb") as file:
            for tensor, keys in blobs:
                if fresh.isdisjoint(keys):
                    continue
                for key, piece in zip(keys, _split(tensor), strict=True):
                    if key in fresh and key not in places:
                        places[key] = (key, name, file.tell(), len(piece))
                        file.write(piece)
        return places

    def _read(self, path: Path, device: torch.device | str) -> tuple[dict[str, Any], list[Piece]]:
        checksum, _, text = read_text(path, "a checkpoint").partition("\n")
        if hashlib.sha256(text.encode()).hexdigest() != checksum:
            raise ValueError("its checksum is wrong")
        document = json.loads(text)
        if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
            got = shown(document.get("version")) if isinstance(document, dict) else "none"
            raise ValueError(
                f"expected a {FORMAT} of version {VERSION}, got version {got}: map again, or continue with the version "
                "of gsfusion_nb that began the run (status.json names it)"
            )
        pieces = [_piece(*row) for row in document["pieces"]]
        sizes = {key: size for key, _, _, size in pieces}
        _check_memory(sum(sizes[key] for _, _, keys in document["tensors"] for key in keys))
        content = self._content(pieces)
        small = b"".join(content[key] for key in document["small"])
        tensors = [
            tensor_of(d, shape, b"".join(content[k] for k in keys), device) for d, shape, keys in document["tensors"]
        ]
        return unpack(document["state"], tensors, small, device), pieces

    def _content(self, pieces: list[Piece]) -> dict[str, bytes]:
        content: dict[str, bytes] = {}
        for name in sorted({piece[1] for piece in pieces}):
            with open_regular(self.folder / name, "pieces of a checkpoint") as file:
                for key, _, at, size in sorted((p for p in pieces if p[1] == name), key=lambda p: p[2]):
                    file.seek(at)
                    content[key] = read_exactly(file, size, name)
                    if hashlib.sha256(content[key]).hexdigest() != key:
                        raise ValueError(f"{name} is damaged at byte {at}")
        return content

    def _remove_all_but(self, wanted: set[str]) -> None:
        """Remove the files of other checkpoints, also those left by a killed process."""
        if not self.folder.is_dir():
            return
        for path in self.folder.iterdir():
            if path.name not in wanted and re.search(r"\.(json|pieces)$", path.name):
                path.unlink(missing_ok=True)


def _piece(key: object, name: object, at: object, size: object) -> Piece:
    """Check a row of the list of pieces."""
    if not isinstance(key, str) or not isinstance(name, str) or not re.fullmatch(r"\d{6}\.pieces", name):
        raise ValueError(f"expected a file name like 000001.pieces, got {shown(name)}")
    check_whole("offset of a piece", at, 0)
    check_whole("size of a piece", size, 0)
    assert isinstance(at, int)
    assert isinstance(size, int)
    return key, name, at, size


def _check_memory(size_bytes: int) -> None:
    """Raise ``ValueError`` if memory is too small: pieces can be used repeatedly, so small files can hold much data."""
    free = available_memory(torch.device("cpu"))
    if free is not None and size_bytes > free:
        raise ValueError(
            f"its tensors need {size_bytes / 1e6:.0f} MB, but only {free / 1e6:.0f} MB of memory are available"
        )


def _split(tensor: Tensor) -> Iterable[memoryview]:
    content = bytes_of(tensor).data
    return (content[at : at + PIECE_BYTES] for at in range(0, len(content), PIECE_BYTES))


def _cut(tensor: Tensor) -> Iterable[tuple[str, memoryview]]:
    return ((hashlib.sha256(piece).hexdigest(), piece) for piece in _split(tensor))


def _sizes(n_bytes: int) -> list[int]:
    return [min(PIECE_BYTES, n_bytes - at) for at in range(0, n_bytes, PIECE_BYTES)]
