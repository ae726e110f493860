"""Hashes of the content of everything that a run reads, by which the same data are recognised.

Every file is hashed from its first byte to its last, links followed. The hashes are kept in the cache folder by path,
size, times and inode, so that a file is hashed once. A file that was changed within the last two seconds is hashed
again: a second change in the same tick of the file system's clock would not be seen.
"""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from ..files import cache_folder, write_file
from ..progress import ProgressDisplay
from ..strict_json import read_object
from .adjust.repair import RepairedSequence
from .adjust.select import OpenedSequence, SequenceView
from .recorded.recorded_sequence import RecordedSequence
from .sequence import SequenceError

_SETTLED_NS = 2_000_000_000
"""Ticks of file systems are at most this long (FAT)."""
_LONG_BYTES = 1 << 30
"""Hashing more than this shows a bar."""
UNREADABLE = "missing, or cannot be read"
"""In place of the hash of such a file."""


def sequence_fingerprint(sequence: OpenedSequence) -> str:
    """A hash of an open sequence: frames to map, frames held out, camera, poses, and the content of all their images.

    Of a recording on disk the files are hashed, those with poses and intrinsics too; of any other sequence the pixels
    of every frame, unless its source has a ``content``, a text that decides its frames (the built-in room).
    """
    digest = hashlib.blake2b(digest_size=16)
    views = (sequence.mapping, sequence.held_out)
    for view in views:
        digest.update(repr((view.positions, view.camera, view.depth_min_m, view.depth_max_m)).encode())
        for i in range(len(view)):
            digest.update(_pose_bytes(view, i))
    source = sequence.source
    if isinstance(source, RepairedSequence):
        digest.update(repr(source.repair).encode())
        source = source.source
    if isinstance(source, RecordedSequence):
        stored = (source.depth_scale, source.depth_invalid, source.stored_size, source.fit_sizes)
        digest.update(repr((stored, list(data_files(sequence).values()))).encode())
        if source.rectify is not None:  # what it does to the images shows in one of them
            _add_pixels(digest, sequence.mapping, at_most=1)
    elif content := getattr(source, "content", ""):
        digest.update(content.encode())
    else:
        for view in views:
            _add_pixels(digest, view)
    return digest.hexdigest()


def data_files(sequence: OpenedSequence) -> dict[str, str]:
    """Path -> hash of each file that a run on ``sequence`` reads; empty for a sequence that is not on disk."""
    source = sequence.source.source if isinstance(sequence.source, RepairedSequence) else sequence.source
    if not isinstance(source, RecordedSequence):
        return {}
    positions = [*sequence.mapping.positions, *sequence.held_out.positions]
    images = [file for i in positions for file in (source.rgb_files[i], source.depth_files[i])]
    return file_hashes([*source.read_from, *images])


def file_hashes(files: Iterable[str | Path]) -> dict[str, str]:
    """Path -> hash of the content of each file, 32 hexadecimal digits, or ``UNREADABLE``."""
    marks = {path: _mark(path) for path in (os.path.abspath(file) for file in files)}
    known = {folder: _Known(folder) for folder in dict.fromkeys(map(os.path.dirname, marks))}
    found = {path: known[os.path.dirname(path)].hash_of(path, mark) for path, mark in marks.items()}
    left = [path for path, mark in marks.items() if mark and not found[path]]
    is_long = sum(marks[path][0] for path in left) > _LONG_BYTES
    with ProgressDisplay("hashing the data", total=len(left), unit="file", leave=False, shown=is_long) as progress:
        for n, path in enumerate(left, start=1):
            found[path] = known[os.path.dirname(path)].add(path, marks[path])
            progress.show(n)
    for folder in known.values():
        folder.save()
    return {path: digest or UNREADABLE for path, digest in found.items()}


class _Known:
    """Hashes of the files of one folder that are known from before: name -> size, times, inode and hash."""

    def __init__(self, folder: str):
        name = hashlib.blake2b(folder.encode(errors="surrogateescape"), digest_size=16).hexdigest()
        self._path, self._changed = cache_folder() / "hashes" / f"{name}.json", False
        self._rows: dict[str, Any] = {}
        with contextlib.suppress(ValueError, OSError):  # none yet, or damaged: hashed again
            self._rows = read_object(self._path, "hashes of files")

    def hash_of(self, path: str, mark: tuple[int, ...]) -> str:
        """The hash of a file that is as it was; empty if it is not known."""
        then, _, digest = str(self._rows.get(os.path.basename(path), "")).rpartition(" ")
        return digest if mark and then == " ".join(map(str, mark)) else ""

    def add(self, path: str, mark: tuple[int, ...]) -> str:
        """Hash a file; the hash is kept, unless the file changed while it was read, or shortly before."""
        digest = _hash(path)
        if digest and mark == _mark(path) and time.time_ns() - max(mark[1:3]) > _SETTLED_NS:
            self._rows[os.path.basename(path)] = f"{' '.join(map(str, mark))} {digest}"
            self._changed = True
        return digest

    def save(self) -> None:
        """Write what is new; a cache that cannot be written only costs time."""
        if self._changed:
            with contextlib.suppress(OSError, ValueError):
                write_file(self._path, json.dumps(self._rows))


def _mark(path: str) -> tuple[int, ...]:
    """Size, times (nanoseconds) and inode of a file, or of the file that a link leads to; empty if there is none."""
    try:
        stat = os.stat(path)
    except (OSError, ValueError):
        return ()
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino


def _hash(path: str) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    except OSError:
        return ""


def _pose_bytes(view: SequenceView, i: int) -> bytes:
    try:
        return view.pose(i).to("cpu", torch.float64).contiguous().numpy().tobytes()
    except SequenceError:
        return b"no pose"


def _add_pixels(digest: Any, view: SequenceView, at_most: int = -1) -> None:
    """Add the images of the first ``at_most`` frames that can be read; of all by default."""
    for i in range(len(view)):
        try:
            frame = view[i]
        except SequenceError:
            digest.update(b"no frame")
            continue
        for pixels in (frame.colour, frame.depth_m):
            digest.update(pixels.cpu().contiguous().numpy().tobytes())
        at_most -= 1
        if at_most == 0:
            return
