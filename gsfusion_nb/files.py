"""Files: written completely or not at all, hashed, and read within limits; errors of files; the
cache folder.

A complete file is written under a temporary name in the same folder, flushed to disk and renamed,
which every file system does in one step. So a reader finds the old content or the new one, also
after a crash or a power failure. A killed program may leave a temporary file, which is never read
(``remove_partial``).

A file of other people and programs may be damaged, of another kind, or made to harm. So nothing
here opens a pipe or a device, which would wait or never end; nothing takes more memory than the
caller allows, also when the content is packed; and whatever a parser of another project raises
becomes a ``SequenceError`` that names the file. All other modules read through this one.
"""

import contextlib
import datetime
import errno
import hashlib
import json
import linecache
import math
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
import traceback
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

from platformdirs import user_cache_path

MAX_SENTENCE = 1000
"""Characters of a message; a path has at most a few hundred."""


def as_sentence(text: str) -> str:
    """A message as one line; of a very long one, which holds a long name of somebody else's,
    beginning and end."""
    text = " ".join(text.splitlines())
    half = MAX_SENTENCE // 2 - 5
    return text if len(text) <= MAX_SENTENCE else f"{text[:half]} [...] {text[-half:]}"


class SequenceError(ValueError):
    """A file or folder that was given, or what was asked of it, makes no sense; one sentence that
    names the file."""

    def __str__(self) -> str:
        return as_sentence(super().__str__())


class SequenceNotFoundError(SequenceError, FileNotFoundError):
    """A folder or file that the sequence needs is not there."""


class BadFrameError(SequenceError):
    """One frame cannot be used (damaged image, no depth, invalid pose, tracking lost); the next
    frame may be fine."""


def is_foreseen(error: BaseException) -> bool:
    """The text of ``error`` is a sentence for people: an error of this package's own, what a
    ``raise`` of this package wrote, or an error about a file.

    A ``ValueError`` of a text that is no number, somewhere deep inside, is none.
    """
    package = __name__.partition(".")[0]
    if isinstance(error, OSError) or type(error).__module__.startswith(package):
        return True
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None or not isinstance(error, (ValueError, TypeError, KeyError, MemoryError)):
        return False
    ours = str(last.tb_frame.f_globals.get("__name__", "")).startswith(package)
    line = linecache.getline(last.tb_frame.f_code.co_filename, last.tb_lineno).strip()
    return ours and (not line or line.startswith("raise"))


def unforeseen(error: BaseException, command: str, arguments: list[str]) -> str:
    """One sentence on ``error`` that names the log with the traceback, in the system's folder for
    temporary files.

    Args:
        error: What was raised.
        command: The command as it was typed, without its arguments, such as ``gsfusion-nb map``.
        arguments: The arguments.
    """
    from .work import memory_is_full

    said = f" ({str(error).strip().splitlines()[0][:160]})" if str(error).strip() else ""
    if memory_is_full(error):
        return f"the memory is full{said}; use smaller or fewer images, or close other programs"
    reason = f"ended by an unexpected error, {type(error).__name__}{said}"
    name = f"{command.replace(' ', '-')}-{datetime.datetime.now():%Y%m%d-%H%M%S}-{os.getpid()}.log"
    log = Path(tempfile.gettempdir(), name)
    text = "".join([f"{command} {' '.join(arguments)}\n\n", *traceback.format_exception(error)])
    try:
        log.write_text(text, encoding="utf-8", errors="backslashreplace")
    except OSError as e:
        return f"{reason}; the traceback could not be written to {log} ({e.strerror})"
    return f"{reason}; the traceback is in {log}"


_FULL = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
"""No space, a file larger than allowed, a user's quota."""


class DiskFullError(OSError):
    """There is no room for a file; the message names it, and what leaves none: the disk, a quota or
    a limit."""

    def __str__(self) -> str:
        return str(self.args[1])


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to, which takes the place of ``path`` when the block ends without
    an exception.

    The temporary file is in the same folder (created if needed) and has the same suffix. After an
    exception, Ctrl-C included, it is removed, and a previous file at ``path`` is unchanged.

        with atomic_file("run/map.npz") as temporary:
            np.savez(temporary, xyz=xyz)

    Raises:
        FileNotFoundError: the block wrote nothing to the temporary path.
        DiskFullError: there is no room for the file; the previous one, if any, is unchanged.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        if not temporary.exists():
            raise FileNotFoundError(
                f"nothing was written for {path}; expected the block to write to the path it was "
                "given"
            )
        move_into_place(temporary, path)
    except OSError as e:
        if not _is_full(e):
            raise
        raise DiskFullError(
            e.errno or errno.ENOSPC, f"{path} cannot be written: {_why_no_room(e, path.parent)}"
        ) from e
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _why_no_room(error: OSError, folder: Path) -> str:
    """What leaves no room for a file in a folder, in words."""
    if error.errno == errno.EFBIG:
        most = _largest_file_bytes()
        if most is None:
            return "the file system of its folder takes no file that is so large"
        return (
            f"this process may write no file of more than {most / 1e6:.1f} MB (the limit "
            "RLIMIT_FSIZE of the system, in a shell: ulimit -f); `ulimit -f unlimited` lifts it"
        )
    free = f"{shutil.disk_usage(folder).free / 1e6:.1f} MB are free"
    if error.errno == getattr(errno, "EDQUOT", None):
        return f"the quota of this user is used up, though {free}"
    return f"the disk is full, {free}"


def _largest_file_bytes() -> int | None:
    """How large a file of this process may become; None: as large as the file system allows."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    most, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    return None if most == resource.RLIM_INFINITY else most


def remove_partial(folder: Path) -> None:
    """Remove the temporary files that a killed program left in ``folder``; nobody else may be
    writing there."""
    for path in folder.glob(".*.partial*"):
        if re.fullmatch(r"\..+\.[0-9a-f]{8}\.partial(\.\w+)?", path.name):
            path.unlink(missing_ok=True)


def write_file(path: str | Path, content: bytes | str) -> None:
    """Write a whole file at once (``atomic_file``); text is encoded as UTF-8."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def atomic_folder(path: Path, temporary: Path) -> Iterator[Path]:
    """The folder ``temporary`` to fill, which becomes ``path`` when the block ends without an
    exception.

    After an exception, Ctrl-C included, it is removed, and the folders above it that were made for
    it; what a killed program left there is removed at the next start.

    Args:
        path: Folder to make; an empty one may be there.
        temporary: Where to fill it, on the same disk.

    Raises:
        FileExistsError: ``path`` exists and is not an empty folder.
    """
    if path.exists() and not (path.is_dir() and next(path.iterdir(), None) is None):
        raise FileExistsError(f"{path} already exists; expected the name of a new or empty folder")
    if temporary.exists():
        shutil.rmtree(temporary)
    new_folders = [folder for folder in temporary.parents if not folder.exists()]
    temporary.mkdir(parents=True)
    try:
        yield temporary
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            path.rmdir()
        move_into_place(temporary, path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        for folder in new_folders:
            with contextlib.suppress(OSError):  # only one that is still empty goes
                folder.rmdir()
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def move_into_place(temporary: Path, path: Path) -> None:
    """Flush a complete file or folder to disk and rename it to ``path``, on the same disk.

    A file at ``path`` is replaced; a folder there must be empty.
    """
    if temporary.is_dir():
        for root, _, names in os.walk(temporary, topdown=False):
            for name in names:
                _flush(Path(root, name))
            _flush_folder(Path(root))
    else:
        _flush(temporary)
    os.replace(temporary, path)
    _flush_folder(path.parent)


def try_lock(handle: int) -> bool:
    """Lock an open file for this process; whether no other one holds it.

    The operating system frees the lock when the file is closed or its holder ends, however it ends.
    A file system that has no locks keeps nobody out.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as e:
        return e.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
    return True


def cache_folder() -> Path:
    """``$GSFUSION_CACHE``, or the folder ``gsfusion_nb`` in the place that the system has for
    caches."""
    if given := os.environ.get("GSFUSION_CACHE"):
        return Path(given).expanduser()
    return user_cache_path("gsfusion_nb", appauthor=False, opinion=False)


def _is_full(error: OSError) -> bool:
    # numpy says how much it could write, and no reason
    return error.errno in _FULL or (
        error.errno is None and re.search(r"requested and \d+ written", str(error)) is not None
    )


def _flush(file: Path) -> None:
    # Windows flushes only what is open for writing; elsewhere a read-only file must be flushed too.
    handle = os.open(file, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _flush_folder(folder: Path) -> None:
    """Flush the names in a folder, where the system can: Windows and some network disks cannot."""
    with contextlib.suppress(OSError):
        _flush(folder)


_FORMULAS = ("=", "+", "-", "@", "\t", "\r")
"""First characters that make a spreadsheet compute a cell."""


def plain_cell(text: str) -> str:
    """Text on one line that a spreadsheet shows and does not compute."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return f"'{line}" if line.lstrip().startswith(_FORMULAS) or text.startswith(_FORMULAS) else line


_SETTLED_NS = 2_000_000_000
"""Ticks of file systems are at most this long (FAT)."""
_LONG_BYTES = 1 << 30
"""Hashing more than this shows a bar."""
UNREADABLE = "missing, or cannot be read"
"""In place of the hash of such a file."""


def file_hashes(files: Iterable[str | Path]) -> dict[str, str]:
    """Path -> hash of the content of each file, 32 hexadecimal digits, or ``UNREADABLE``.

    Every file is hashed from its first byte to its last, links followed. The hashes are kept in the
    cache folder by path, size, times and inode, so that a file is hashed once. A file that was
    changed within the last two seconds is hashed again: a second change in the same tick of the
    file system's clock would not be seen.
    """
    marks = {path: _mark(path) for path in (os.path.abspath(file) for file in files)}
    known = {folder: _Known(folder) for folder in dict.fromkeys(map(os.path.dirname, marks))}
    found = {path: known[os.path.dirname(path)].hash_of(path, mark) for path, mark in marks.items()}
    left = [path for path, mark in marks.items() if mark and not found[path]]
    is_long = sum(marks[path][0] for path in left) > _LONG_BYTES
    from .work import ProgressDisplay

    with ProgressDisplay(
        "hashing the data", total=len(left), unit="file", leave=False, shown=is_long
    ) as progress:
        for n, path in enumerate(left, start=1):
            found[path] = known[os.path.dirname(path)].add(path, marks[path])
            progress.show(n)
    for folder in known.values():
        folder.save()
    return {path: digest or UNREADABLE for path, digest in found.items()}


class _Known:
    """Hashes of the files of one folder that are known from before: name -> size, times, inode and
    hash."""

    def __init__(self, folder: str):
        name = hashlib.blake2b(folder.encode(errors="surrogateescape"), digest_size=16).hexdigest()
        self._path = cache_folder() / "hashes" / f"{name}.json"
        self._changed = False
        self._rows: dict[str, Any] = {}
        with contextlib.suppress(ValueError, OSError):  # none yet, or damaged: hashed again
            rows = json.loads(self._path.read_text(encoding="utf-8"))
            self._rows = rows if isinstance(rows, dict) else {}

    def hash_of(self, path: str, mark: tuple[int, ...]) -> str:
        """The hash of a file that is as it was; empty if it is not known."""
        then, _, digest = str(self._rows.get(os.path.basename(path), "")).rpartition(" ")
        return digest if mark and then == " ".join(map(str, mark)) else ""

    def add(self, path: str, mark: tuple[int, ...]) -> str:
        """Hash a file; the hash is kept, unless the file changed while it was read, or shortly
        before."""
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
    """Size, times (nanoseconds) and inode of a file, or of the file that a link leads to; empty if
    there is none."""
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


TEXT_BYTES = 256_000_000
"""Of a text file: the poses of a million frames."""
IMAGE_BYTES = 256_000_000
"""Of an encoded image."""
_noted: ContextVar[list[Path] | None] = ContextVar("noted", default=None)


def is_file(path: Path) -> bool:
    """Whether there is a file; False for a name, written by somebody else, that no file can
    have."""
    try:
        return path.is_file()
    except OSError:
        return False


@contextmanager
def noting_files() -> Iterator[list[Path]]:
    """A block in which every file that is opened by this module is added to the list that it
    gives."""
    noted = []
    outer = _noted.get()
    token = _noted.set(noted)
    try:
        yield noted
    finally:
        _noted.reset(token)
        if outer is not None:
            outer += noted


LEAST_MEMORY_BYTES = 1 << 29
MOST_MEMORY_PER_BYTE = 100
"""A packed file of ours may take as much memory as the first, or as many times its size as the
second: the TSDFs of runs take 8 to 16 times the size of their files, and files that are made to
harm a thousand times and more."""


def open_regular(path: str | Path, what: str) -> BufferedReader:
    """Open a plain file for reading bytes. Pipes, sockets, devices and folders are refused, before
    anything waits.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no plain file, or it may not be read.
    """
    try:
        # A pipe that nobody writes to blocks on opening, unless it is opened without waiting.
        handle = os.open(
            path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        )
    except (FileNotFoundError, NotADirectoryError):
        raise SequenceNotFoundError(f"{path} does not exist; expected {what}") from None
    except (OSError, ValueError) as e:
        reason = getattr(e, "strerror", None) or e
        if os.path.isdir(path):
            reason = "it is a folder"
        raise SequenceError(f"{path} cannot be read ({reason}); expected {what}") from None
    mode = os.fstat(handle).st_mode
    if not stat.S_ISREG(mode):
        os.close(handle)
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe or device"
        raise SequenceError(f"{path} is {kind}, not a plain file; expected {what}")
    noted = _noted.get()
    if noted is not None:
        noted.append(Path(path))
    return os.fdopen(handle, "rb")


def read_bytes(path: str | Path, what: str, *, at_most: int = TEXT_BYTES) -> bytes:
    """Content of a plain file (``open_regular``) of at most ``at_most`` bytes."""
    with open_regular(path, what) as file:
        try:
            data = file.read(at_most + 1)
        except OSError as e:
            raise SequenceError(f"{path} cannot be read ({e.strerror}); expected {what}") from None
    if len(data) > at_most:
        raise SequenceError(f"{path} is larger than {at_most / 1e6:g} MB; expected {what}")
    return data


def read_text(path: str | Path, what: str, *, at_most: int = TEXT_BYTES) -> str:
    """Text of a plain file in UTF-8, with or without a byte order mark."""
    try:
        return read_bytes(path, what, at_most=at_most).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SequenceError(f"{path} is not a text file; expected {what}") from None


def read_exactly(file: BinaryIO, n: int, path: str | Path) -> bytes:
    """The next ``n`` bytes of an open file.

    Raises:
        SequenceError: it has fewer; nothing is read then, so a length that is wrong costs no
            memory.
    """
    left = os.fstat(file.fileno()).st_size - file.tell()
    if not 0 <= n <= left:
        raise SequenceError(
            f"{path} is truncated: it ends {n - left} bytes too early; copy it again"
        )
    return file.read(n)


def inflate(data: bytes, source: str | Path, *, at_most: int) -> bytes:
    """Unpacked content of a zlib stream. Raises ``BadFrameError`` when it is damaged or larger than
    ``at_most``."""
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(data, at_most + 1)
    except zlib.error as e:
        raise BadFrameError(f"{source} cannot be unpacked ({e})") from None
    if len(content) > at_most:
        raise BadFrameError(f"{source} unpacks to more than the {at_most} bytes that were expected")
    if not unpacker.eof:
        raise BadFrameError(f"{source} cannot be unpacked (it is truncated)")
    return content


def open_archive(path: str | Path, what: str) -> zipfile.ZipFile:
    """A zip archive for reading. Raises ``SequenceError`` for another file."""
    open_regular(path, what).close()
    with parsing(path, what):
        return zipfile.ZipFile(path)


def read_member(
    archive: zipfile.ZipFile,
    name: str,
    source: str | Path,
    *,
    at_most: int,
) -> bytes:
    """Content of one member of an archive, of at most ``at_most`` bytes unpacked.

    Raises:
        KeyError: no such member. BadFrameError: it is damaged, encrypted or larger.
    """
    info = archive.getinfo(name)
    if info.file_size > at_most:
        raise BadFrameError(
            f"{source}: {name} unpacks to {info.file_size} bytes; expected at most {at_most}"
        )
    try:
        with archive.open(info) as member:
            return member.read(at_most)
    except Exception as e:
        raise BadFrameError(f"{source}: {name} is damaged ({reason_of(e)})") from None


@contextmanager
def parsing(
    source: str | Path, what: str, error: type[SequenceError] = SequenceError
) -> Iterator[None]:
    """Whatever a parser of another project raises in the block becomes one sentence that names
    ``source``.

    Such parsers were written for files in order: from a damaged one follows any exception, such as
    ``struct.error`` or ``AssertionError``. Errors that are sentences already pass as they are.
    """
    try:
        yield
    except SequenceError:
        raise
    except MemoryError:
        raise error(
            f"{source} asks for more memory than there is; it is damaged; expected {what}"
        ) from None
    except Exception as e:
        raise error(
            f"{source} is not readable as {what} ({reason_of(e)}); it may be truncated or damaged"
        ) from e


@contextmanager
def refusing(before: str = "", error: type[SequenceError] = SequenceError) -> Iterator[None]:
    """A ``ValueError`` that a check raises in the block becomes an ``error`` with the text
    ``before`` its message."""
    try:
        yield
    except ValueError as e:
        raise error(f"{before}{e}") from None


def reason_of(error: Exception) -> str:
    """The kind and the first sentence of an error, short enough to be a part of another
    sentence."""
    lines = str(error).strip().splitlines()
    text = lines[0].split(". ")[0][:160] if lines else ""
    return (
        text
        if isinstance(error, OSError | ValueError) and text
        else f"{type(error).__name__} {text}".strip()
    )


def read_object(
    path: str | Path,
    what: str,
    *,
    at_most: int = TEXT_BYTES,
    objects: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Content of a JSON file that must hold an object, and in it an object at each of the keys
    ``objects``.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no JSON, or refused by ``parse_json``;
            names the file.
    """
    values = parse_json(read_text(path, what, at_most=at_most), str(path), what)
    if not isinstance(values, dict):
        raise SequenceError(
            f"{path} must hold a JSON object ({what}), got a {type(values).__name__}"
        )
    for key in objects:
        if not isinstance(values.get(key), dict):
            got = f"a {type(values[key]).__name__}" if key in values else "none"
            raise SequenceError(f"{path} must hold an object at the key {key} ({what}), got {got}")
    return values


def write_sealed(path: str | Path, values: dict[str, Any]) -> None:
    """Write a JSON object with a checksum of its content, for ``read_sealed``."""
    write_file(
        path,
        json.dumps(values | {_SEAL: _seal_of(values)}, indent=1, allow_nan=False),
    )


def read_sealed(path: str | Path, what: str) -> dict[str, Any]:
    """What ``write_sealed`` wrote, if nobody has changed it since.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no JSON object, or not with the checksum
            of its content.
    """
    values = read_object(path, what)
    seal = values.pop(_SEAL, None)
    if seal is None:
        raise SequenceError(f"{path} is not {what} of this version: it has no checksum")
    if seal != _seal_of(values):
        raise SequenceError(
            f"{path} was changed after it was written: its checksum is not that of its content"
        )
    return values


_SEAL = "checksum"


def _seal_of(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def parse_json(text: str, source: str, what: str) -> Any:
    """Values of a JSON text; ``source`` is its name for messages.

    What is no number for a computer is refused. Python's parser reads NaN and Infinity, which JSON
    does not have, and makes infinities of numbers that are too large. Of two equal keys it takes
    the last one, which is refused here.
    """
    try:
        return json.loads(
            text,
            object_pairs_hook=_object,
            parse_constant=_finite,
            parse_float=_finite,
            parse_int=_whole,
        )
    except (
        ValueError,
        RecursionError,
    ) as e:  # a ValueError also where a number has thousands of digits
        raise SequenceError(f"{source} is not valid JSON ({e}); expected {what}") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(
            f"the key {next(k for k in keys if keys.count(k) > 1)[:40]!r} appears twice in an "
            "object"
        )
    return values


def _whole(text: str) -> int:
    _finite(text)
    return int(text)


def _finite(text: str) -> float:
    if not math.isfinite(float(text)):
        raise ValueError(f"{text[:40]} is not a finite number")
    return float(text)
