"""Checkpoints of a run: each is complete, but images and other tensors that never change are written once.

For each checkpoint n a folder holds ``n.state`` (the state) and ``n.constants`` (constant tensors that earlier
checkpoints do not have), both as torch saves them, and ``n.json``, which lists every file that the checkpoint needs
with its SHA-256. ``n.json`` is written last; until then the previous checkpoint is the valid one, and it is kept until
the next is complete.

No code from the files is executed when they are read.
"""

import hashlib
import json
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..checks import shown
from ..files import atomic_file, open_regular, read_object, reason_of, write_file

FORMAT = "gsfusion_nb checkpoint"
VERSION = 6
_CONSTANT = "$constant"
_NAME = re.compile(r"\d{6}\.(state|constants)")


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
        self._number = max([0, *self._numbers()])
        self._constants: dict[int, tuple[Tensor, str]] = {}
        self._files: dict[str, str] = {}
        """SHA-256 of every file of constants that the last checkpoint needs."""
        self._before: set[str] = set()
        """Files of the last checkpoint."""

    def save(self, state: dict[str, Any], *, constant: Iterable[Tensor] = ()) -> None:
        """Write a checkpoint: nested dictionaries, lists and tuples of tensors, numbers, strings and None.

        Args:
            state: What to save. Tensors on a GPU are copied to the CPU.
            constant: Tensors in it that never change (images); they are written only once.

        Raises:
            TypeError: Another type in ``state``; the message names the place.
            DiskFullError: The disk is full; the previous checkpoint is still valid.
        """
        number, fresh = self._number + 1, {}
        constants, used = {id(tensor) for tensor in constant}, {}

        def stored(tensor: Tensor) -> Any:
            if id(tensor) not in constants:
                return _on_disk(tensor)
            if id(tensor) not in used:
                used[id(tensor)] = self._constants.get(id(tensor), (tensor, f"{number:06d}.constants {len(fresh)}"))
                if id(tensor) not in self._constants:
                    fresh[used[id(tensor)][1]] = _on_disk(tensor)
            return {_CONSTANT: used[id(tensor)][1]}

        tree = _plain(state, "state", stored)
        needed = {place.partition(" ")[0] for _, place in used.values()}
        files = {name: digest for name, digest in self._files.items() if name in needed}
        if fresh:
            name = f"{number:06d}.constants"
            files[name] = self._write(name, fresh)
        name = f"{number:06d}.state"
        document = {"format": FORMAT, "version": VERSION, "files": files | {name: self._write(name, tree)}}
        write_file(self.folder / f"{number:06d}.json", json.dumps(document))
        wanted = {*document["files"], f"{number:06d}.json"}
        self._remove_all_but(wanted | self._before)
        self._number, self._constants, self._files, self._before = number, used, files, wanted

    def load(self) -> Loaded:
        """The latest checkpoint that is not damaged, on the CPU; its constants are read when they are used.

        Raises:
            FileNotFoundError: There is none. ValueError: All are damaged, or from another version.
        """
        problems: list[str] = []
        for number in sorted(self._numbers(), reverse=True):
            path = self.folder / f"{number:06d}.json"
            try:
                state, files = self._read(path)
            except Exception as e:  # damaged content can cause any error
                problems.append(f"{path} cannot be used ({reason_of(e)})")
                continue
            self._before = {path.name, *files}
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

    def _write(self, name: str, content: Any) -> str:
        """Write one file; returns its SHA-256."""
        with atomic_file(self.folder / name) as temporary, temporary.open("w+b") as file:
            try:
                torch.save(content, file)
            except RuntimeError as e:  # torch's writer fails once more after the error of the disk
                cause: BaseException | None = e
                while cause is not None and not isinstance(cause, OSError):
                    cause = cause.__context__
                raise cause or e from None
            file.seek(0)
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _read(self, path: Path) -> tuple[dict[str, Any], list[str]]:
        document = read_object(path, "a checkpoint", objects=("files",))
        if document.get("format") != FORMAT or document.get("version") != VERSION:
            raise ValueError(
                f"expected a {FORMAT} of version {VERSION}, got version {shown(document.get('version'))}: map again, "
                "or continue with the version of gsfusion_nb that began the run"
            )
        constants: dict[str, Tensor] = {}
        state: Any = None
        for name, digest in document["files"].items():
            if not _NAME.fullmatch(name):
                raise ValueError(f"expected a file name like 000001.state, got {shown(name)}")
            with open_regular(self.folder / name, "a part of a checkpoint") as file:
                if hashlib.file_digest(file, "sha256").hexdigest() != digest:
                    raise ValueError(f"the checksum of {name} is wrong")
                file.seek(0)
                mapped = name.endswith(".constants") and sys.platform != "win32"  # more than memory may hold
                source = self.folder / name if mapped else file
                content = torch.load(source, map_location="cpu", weights_only=True, mmap=mapped)
            if name.endswith(".constants"):
                constants |= content
            else:
                state = content
        return _whole(state, constants), list(document["files"])

    def _remove_all_but(self, wanted: set[str]) -> None:
        """Remove the files of other checkpoints, also those left by a killed process."""
        if not self.folder.is_dir():
            return
        for path in self.folder.iterdir():
            if path.name not in wanted and re.fullmatch(r"\.?\d{6}\.[\w.]+", path.name):
                path.unlink()


def _plain(value: Any, name: str, stored: Callable[[Tensor], Any]) -> Any:
    """``value`` with what is ``stored`` in place of each tensor. Raises ``TypeError`` for what cannot be saved."""
    if isinstance(value, Tensor):
        return stored(value)
    if value is None or type(value) in (bool, int, float, str):
        return value
    if type(value) is dict:
        for key in value:
            if type(key) is not str or key == _CONSTANT:
                raise TypeError(f"{name} must have strings as keys, got {key!r}")
        return {key: _plain(v, f"{name}[{key!r}]", stored) for key, v in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_plain(v, f"{name}[{i}]", stored) for i, v in enumerate(value))
    raise TypeError(
        f"{name} must be a tensor, number, string, None, or a dict, list or tuple of those, got {type(value)}"
    )


def _on_disk(tensor: Tensor) -> Tensor:
    """The tensor on the CPU, with a buffer of its own size: torch saves whole buffers."""
    plain = tensor.detach().cpu().contiguous()
    return plain if plain.untyped_storage().nbytes() == plain.nbytes else plain.clone()


def _whole(value: Any, constants: dict[str, Tensor]) -> Any:
    """The state that ``_plain`` was given. Raises ``KeyError`` for a constant that is nowhere."""
    if type(value) is dict:
        if _CONSTANT in value:
            return constants[value[_CONSTANT]]
        return {key: _whole(v, constants) for key, v in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_whole(v, constants) for v in value)
    return value
