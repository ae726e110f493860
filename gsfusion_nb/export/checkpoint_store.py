"""Checkpoints of a run: each is complete, but what has not changed since the last one is not
written again.

For each checkpoint n a folder holds ``n.state`` (the state) and ``n.constants`` (what earlier
checkpoints do not have of images, and of large tensors in parts of some rows), both as torch saves
them, and ``n.json``, which lists every file that the checkpoint needs with its SHA-256. ``n.json``
is written last; until then the previous checkpoint is the valid one, and it is kept until the next
is complete. Several checkpoints need the same ``n.constants``, so each has a copy, ``n.copy``,
which is read if it is damaged; on a disk that is nearly full there is none.

No code from the files is executed when they are read.
"""

import contextlib
import hashlib
import json
import re
import shutil
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..checks import shown
from ..errors import ArgumentError, DiskFullError, reason_of
from ..files import (
    LEAST_MEMORY_BYTES,
    MOST_MEMORY_PER_BYTE,
    atomic_file,
    open_regular,
    read_object,
    write_file,
)
from ..resources import MAP_MEMORY
from .checkpoint_values import (
    CONSTANT,
    PARTS,
    FileThatGivesBack,
    check_buffers,
    is_one_part,
    joined_bytes,
    on_disk,
    parts_of,
    plain_values,
    whole_values,
)

FORMAT = "gsfusion_nb checkpoint"

VERSION = 7

_NAME = re.compile(r"\d{6}\.(state|constants)")

_ROOM_FOR_COPY = 4
"""A file of constants is copied where the disk has room for so many of them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Loaded:
    """A checkpoint that was read."""

    state: dict[str, Any]
    number: int
    passed_over: str
    """Why a later checkpoint could not be used; empty if this is the latest."""
    copies: list[str]
    """Which of its files are damaged, so that their copies were read, as sentences."""


class CheckpointStore:
    """Saves and loads checkpoints in one folder."""

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self._number = max([0, *self._numbers()])
        self._constants: dict[int, tuple[Tensor, str]] = {}
        self._parts: dict[str, str] = {}
        """SHA-256 of each part of a tensor in the last checkpoint -> its place, as of a
        constant."""
        self._files: dict[str, str] = {}
        """SHA-256 of every file of constants that the last checkpoint needs."""
        self._sizes: dict[str, int] = {}
        """Number of tensors in every file of constants that this object wrote."""
        self._before: set[str] = set()
        """Files of the last checkpoint."""

    def save(
        self,
        state: dict[str, Any],
        *,
        constant: Iterable[Tensor] = (),
    ) -> None:
        """Write a checkpoint: nested dictionaries, lists and tuples of tensors, numbers, strings
        and None.

        Args:
            state: What to save. Tensors on a GPU are copied to the CPU.
            constant: Tensors in it that never change (images); they are written only once.

        Raises:
            TypeError: Another type in ``state``; the message names the place.
            DiskFullError: The disk is full; the previous checkpoint is still valid.
        """
        number = self._number + 1
        fresh = {}
        constants = {id(tensor) for tensor in constant}
        used = {}
        parts = dict[str, str]()

        def stored(tensor: Tensor) -> Any:
            if id(tensor) not in constants:
                plain = on_disk(tensor)
                return (
                    plain if is_one_part(plain) else {PARTS: [in_part(x) for x in parts_of(plain)]}
                )
            if id(tensor) not in used:
                used[id(tensor)] = self._constants.get(
                    id(tensor), (tensor, f"{number:06d}.constants {len(fresh)}")
                )
                if id(tensor) not in self._constants:
                    fresh[used[id(tensor)][1]] = on_disk(tensor)
            return {CONSTANT: used[id(tensor)][1]}

        def in_part(rows: Tensor) -> str:
            digest = hashlib.sha256(rows.view(torch.uint8).view(-1).numpy().data).hexdigest()
            MAP_MEMORY.give_back()
            if digest not in parts:
                parts[digest] = self._parts.get(digest, f"{number:06d}.constants {len(fresh)}")
                if digest not in self._parts:
                    fresh[parts[digest]] = rows
            return parts[digest]

        tree = plain_values(state, "state", stored)
        needed_files = {
            place.partition(" ")[0]
            for place in (*(place for _, place in used.values()), *parts.values())
        }
        files = {name: digest for name, digest in self._files.items() if name in needed_files}
        if fresh:
            name = f"{number:06d}.constants"
            files[name] = self._write(name, fresh)
            self._copy(name)
        name = f"{number:06d}.state"
        document = {
            "format": FORMAT,
            "version": VERSION,
            "files": files | {name: self._write(name, tree)},
        }
        write_file(self.folder / f"{number:06d}.json", json.dumps(document))
        files_now = {*document["files"], f"{number:06d}.json"}
        self._remove_all_but(_with_copies(files_now | self._before))
        self._number = number
        self._constants = used
        self._files = files
        self._before = files_now
        self._parts = self._worth_keeping(parts, number, len(fresh))

    def _worth_keeping(
        self,
        parts: dict[str, str],
        number: int,
        n_fresh: int,
    ) -> dict[str, str]:
        """The parts without those in files of which less than half is needed: they are written
        again next time."""
        self._sizes[f"{number:06d}.constants"] = n_fresh
        of_file = Counter(place.partition(" ")[0] for place in parts.values())
        of_file.update(place.partition(" ")[0] for _, place in self._constants.values())
        worthy = {name for name, n in of_file.items() if 2 * n >= self._sizes[name]}
        return {
            digest: place for digest, place in parts.items() if place.partition(" ")[0] in worthy
        }

    def load(self) -> Loaded:
        """The latest checkpoint that is not damaged, on the CPU; its constants are read when they
        are used.

        Raises:
            FileNotFoundError: There is none. ValueError: All are damaged, or from another version.
        """
        problems: list[str] = []
        for number in sorted(self._numbers(), reverse=True):
            path = self.folder / f"{number:06d}.json"
            copies: list[str] = []
            try:
                state, files = self._read(path, copies)
            except Exception as e:  # damaged content can cause any error
                problems.append(f"{path} cannot be used ({reason_of(e)})")
                continue
            self._before = {path.name, *files}
            return Loaded(
                state=state, number=number, passed_over="; ".join(problems), copies=copies
            )
        if not problems:
            raise FileNotFoundError(f"{self.folder} holds no checkpoint")
        raise ArgumentError("; ".join(problems))

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
                torch.save(content, FileThatGivesBack(file))  # pyright: ignore[reportArgumentType]
            except RuntimeError as e:  # torch's writer fails once more after the error of the disk
                cause: BaseException | None = e
                while cause is not None and not isinstance(cause, OSError):
                    cause = cause.__context__
                raise cause or e from None
            file.seek(0)
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _copy(self, name: str) -> None:
        """Copy a file of constants beside it, if the disk has room for it and for what comes after
        it."""
        size = (self.folder / name).stat().st_size
        if shutil.disk_usage(self.folder).free < _ROOM_FOR_COPY * size:
            return
        with (
            contextlib.suppress(DiskFullError),
            atomic_file(self.folder / _copy_of(name)) as temporary,
        ):
            shutil.copyfile(self.folder / name, temporary)

    def _intact(self, name: str, digest: str, copies: list[str]) -> Path:
        """The file of this name, or its copy if it is damaged, which is then told in ``copies``.

        Raises:
            ValueError, OSError: neither is intact.
        """
        if not _NAME.fullmatch(name):
            raise ArgumentError(f"expected a file name like 000001.state, got {shown(name)}")
        try:
            return _checked(self.folder / name, digest)
        except (ValueError, OSError) as e:
            try:
                copy = _checked(self.folder / _copy_of(name), digest)
            except (ValueError, OSError):
                raise e from None
            copies.append(
                f"{self.folder / name} is damaged ({reason_of(e)}); its copy, which is intact, is "
                "used instead"
            )
            return copy

    def _read(
        self,
        path: Path,
        copies: list[str],
    ) -> tuple[dict[str, Any], list[str]]:
        document = read_object(path, "a checkpoint", objects=("files",))
        if document.get("format") != FORMAT or document.get("version") != VERSION:
            raise ArgumentError(
                f"expected a {FORMAT} of version {VERSION}, got version "
                f"{shown(document.get('version'))}: map again, "
                "or continue with the version of gsfusion_nb that began the run"
            )
        constants: dict[str, Tensor] = {}
        state: Any = None
        used: list[Path] = []
        for name, digest in document["files"].items():
            source = self._intact(name, digest, copies)
            with open_regular(source, "a part of a checkpoint") as file:
                maps_memory = sys.platform != "win32"  # more than memory may hold
                content = torch.load(
                    source if maps_memory else file,
                    map_location="cpu",
                    weights_only=True,
                    mmap=maps_memory,
                )
                check_buffers(content, name)
            used.append(source)
            if name.endswith(".constants"):
                constants |= content
            else:
                state = content
        size = sum(source.stat().st_size for source in used)
        whole = joined_bytes(state, constants)
        if whole > max(LEAST_MEMORY_BYTES, MOST_MEMORY_PER_BYTE * size):
            raise ArgumentError(
                f"its files of {size / 1e6:.1f} MB ask for {whole / 1e9:.1f} GB of memory"
            )
        return whole_values(state, constants), list(document["files"])

    def _remove_all_but(self, names: set[str]) -> None:
        """Remove the files of other checkpoints, also those left by a killed process."""
        if not self.folder.is_dir():
            return
        for path in self.folder.iterdir():
            if path.name not in names and re.fullmatch(r"\.?\d{6}\.[\w.]+", path.name):
                path.unlink()


def _copy_of(name: str) -> str:
    return f"{name.partition('.')[0]}.copy"


def _with_copies(names: set[str]) -> set[str]:
    return names | {_copy_of(name) for name in names if name.endswith(".constants")}


def _checked(path: Path, digest: str) -> Path:
    """The path, if the content of the file has this SHA-256. Raises ``ValueError`` if it has
    not."""
    with open_regular(path, "a part of a checkpoint") as file:
        if hashlib.file_digest(file, "sha256").hexdigest() != digest:
            raise ArgumentError(f"the checksum of {path.name} is wrong")
    return path
