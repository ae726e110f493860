"""What a seeding rule reads besides its context: files that it does not declare, the environment, other programs.

Python tells what it opens and starts (audit events, PEP 578). What compiled code opens by itself is not told.
"""

import contextlib
import functools
import importlib.util
import itertools
import os
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from ..files import cache_folder
from .code_values import CHECKS_TYPES, is_library_namespace
from .installed import is_installed

_PACKAGE = __name__.partition(".")[0]


def _folders_of_kernels() -> list[str]:
    """Where the package's kernels are, which may lie beside it, and where numba keeps them compiled."""
    found = importlib.util.find_spec(f"{_PACKAGE}.kernels")
    sources = found.submodule_search_locations or () if found is not None else ()
    compiled = (os.environ.get("NUMBA_CACHE_DIR"), user_cache_path("numba", appauthor=False, opinion=False))
    return [str(folder) for folder in (*sources, *compiled) if folder]


SYSTEM_FOLDERS = (
    *("/dev", "/proc", "/sys", "/etc", "/usr", sys.prefix, sys.base_prefix, str(Path(__file__).parents[1])),
    *_folders_of_kernels(),
)
"""What the rule's own process may read without being told: the system, Python, and this package."""
_COMPILED = {".nbi", ".nbc"}
_IMPORT = {"importlib._bootstrap_external", "_frozen_importlib_external"}
_NEW = os.O_CREAT | os.O_EXCL
_COMPILERS = {"torch", "triton", "numba"}
"""Libraries that start a compiler for the code that they are given."""
_PROGRAMS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.startfile", "pty.spawn"}
_NETWORK = {"socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto", "urllib.Request"}
_READING = {"os", "_collections_abc", "collections.abc"}
"""Modules through which the environment is read."""
_OF_THE_USER = {"posixpath", "ntpath", "tempfile"}
"""Modules that look up the user's folders in the environment; what is read there is looked at by itself."""
_FOLDERS = {"os.listdir", "os.scandir", "glob.glob", "os.walk", "glob.glob/2"}


class UndeclaredError(ValueError):
    """A rule reads something that decides its seeds and that no option names."""


class _Watch:
    """What one call of a rule may read, and what it did read."""

    def __init__(self, rule: str, paths: Iterable[Path]):
        self.rule = rule
        self.allowed = [place.expanduser().resolve() for place in (*map(Path, SYSTEM_FOLDERS), cache_folder(), *paths)]
        self.written: set[str] = set()
        self.imported: set[Path] = set()
        """Files of own modules that were imported."""
        self.offence = ""

    def note(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Look at an audit event of this thread."""
        if event == "open":
            self._opened(*arguments[:3])
        elif event in _FOLDERS:
            self._listed(arguments[0] if arguments else None)
        elif event == "sqlite3.connect":
            self._opened(arguments[0], "r", 0)
        elif event in _PROGRAMS and _caller() not in _COMPILERS and not _is_for_package():
            self._refuse(f"starts a program ({_words(arguments[:1])})", "compute in the rule, or give it the result")
        elif event in _NETWORK and not _is_for_package():
            self._refuse(f"uses the network ({_words(arguments[-1:])})", "load it before, as a file")

    def thread(self) -> None:
        """A thread is started, in which nothing would be noticed."""
        if not _is_for_package() and _caller() not in _COMPILERS:
            self._refuse("starts a thread", "compute in the rule's own thread")

    def environment(self, name: str) -> None:
        """The environment variable ``name`` is read."""
        askers = itertools.islice((name for name, _ in _frames() if name not in _READING), 1)
        if _caller() == "" and _OF_THE_USER.isdisjoint(askers):
            self._refuse(f"reads the environment variable {name}", f'make it an option: {name.lower()}: str = "..."')

    def _opened(self, file: Any, _mode: Any, flags: Any) -> None:
        if isinstance(file, int) or file is None:  # a file that is open already
            return
        path = os.path.abspath(os.fsdecode(file)) if os.fsdecode(file) != ":memory:" else ""
        if isinstance(flags, int) and flags & _NEW == _NEW:
            self.written.add(path)
        if not path or path in self.written or _is_for_package():
            return
        opener = _asker()
        if opener == "tokenize":  # the source of a function, for a message
            return
        is_import = opener in _IMPORT
        if is_import:
            path = _source_of(path)
        if self._may_read(Path(path)):
            return
        if is_import:
            self.imported.add(Path(path))
        elif isinstance(flags, int) and flags & os.O_WRONLY:
            self._refuse(f"writes {path}", "keep what it must remember in ctx.memory")
        elif os.path.isfile(path):
            self._refuse(
                f"reads {path}, which none of its options names", f'declare it: weights: Path = Path("{path}")'
            )

    def _listed(self, folder: Any) -> None:
        if folder is None or isinstance(folder, int) or _caller() != "":
            return
        path = Path(os.path.abspath(os.fsdecode(folder)))
        if not self._may_read(path):
            self._refuse(f"lists {path}, which none of its options names", f'declare it: masks: Path = Path("{path}")')

    def _may_read(self, path: Path) -> bool:
        if path.suffix in _COMPILED or is_installed(path):
            return True
        try:
            places = {path, path.resolve()}
        except OSError:
            places = {path}
        return any(place.is_relative_to(folder) for place in places for folder in self.allowed)

    def _refuse(self, what: str, instead: str) -> None:
        self.offence = self.offence or (
            f"the seeding rule {self.rule!r} {what}, so a comparison would keep its old results when that changes; "
            f"{instead}"
        )


def _source_of(path: str) -> str:
    """The source of a file that Python compiled."""
    try:
        return importlib.util.source_from_cache(path) if path.endswith(".pyc") else path
    except ValueError:
        return path


def _words(arguments: tuple[Any, ...]) -> str:
    return " ".join(str(a) for a in arguments)[:200]


def _frames() -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and names of the modules on the stack, the nearest first, from where this one was called."""
    frame: Any = sys._getframe(1)
    is_ours = True
    while frame is not None:
        name = frame.f_globals.get("__name__") or ""
        is_ours = is_ours and (name == __name__ or name.startswith(CHECKS_TYPES))
        if not is_ours:
            yield name, frame.f_globals
        frame = frame.f_back


def _asker() -> str:
    """Name of the module whose code made the call itself."""
    return next((name for name, _ in _frames()), "")


def _caller() -> str:
    """Name of the package whose function asked for it: the nearest on the stack that is not Python's own; empty for
    somebody's own code."""
    for name, names in _frames():
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names:
            return top if is_library_namespace(names) else ""
    return "python"


def _is_for_package() -> bool:
    """Whether this package asked for it, through whatever library, and not the rule's own code."""
    for name, names in _frames():
        if name.startswith(f"{_PACKAGE}."):
            return True
        if not is_library_namespace(names):
            return False
    return True


_now = threading.local()
_patching = threading.RLock()


def _watch() -> _Watch | None:
    return getattr(_now, "watch", None)


@functools.cache
def _listen() -> None:
    # A lambda, which no tool that checks types wraps: a wrapper raises events itself, and they would never end.
    sys.addaudithook(lambda event, arguments: _tell(event, arguments))


def _tell(event: str, arguments: tuple[Any, ...]) -> None:
    watch: _Watch | None = getattr(_now, "watch", None)
    if watch is None:
        return
    _now.watch = None  # what is opened while this is looked at is not the rule's
    try:
        watch.note(event, arguments)
    finally:
        _now.watch = watch


@contextlib.contextmanager
def _calls_watched(watch: _Watch) -> Iterator[None]:
    """Tell ``watch`` of the variables that are read, and the threads that are started, in this thread."""
    kind: Any = type(os.environ)
    thread_kind: Any = threading.Thread
    read = kind.__getitem__
    start = thread_kind.start

    def tell(environ: Any, name: Any) -> Any:
        if _watch() is watch:
            watch.environment(os.fsdecode(name))
        return read(environ, name)

    def tell_of_thread(thread: threading.Thread) -> None:
        if _watch() is watch:
            watch.thread()
        start(thread)

    with _patching:
        kind.__getitem__ = tell
        thread_kind.start = tell_of_thread
        try:
            yield
        finally:
            kind.__getitem__ = read
            thread_kind.start = start


@contextlib.contextmanager
def noted(rule: str, paths: Iterable[Path] = ()) -> Iterator[_Watch]:
    """Context that notes what a rule reads besides the files and folders ``paths``, those of Python and of packages."""
    _listen()
    tempfile.gettempdir()  # which reads the environment, once
    watch = _Watch(rule, paths)
    before = _watch()
    with _calls_watched(watch):
        _now.watch = watch
        try:
            yield watch
        finally:
            _now.watch = before


@contextlib.contextmanager
def only_declared(rule: str, paths: Iterable[Path] = ()) -> Iterator[None]:
    """Context in which a rule may read the files and folders ``paths`` only, and those of Python and of packages.

    No environment variable, no other program, no network. A temporary file that it makes itself may be read.

    Args:
        rule: Name of the rule, for the message.
        paths: Its options of type ``Path``, and the files of its modules.

    Raises:
        UndeclaredError: at the end of the context, if it read something else, also where it caught its own error.
    """
    with noted(rule, paths) as watch:
        try:
            yield
        except Exception as e:
            if offence := watch.offence:
                raise UndeclaredError(offence) from e
            raise
    refuse(watch.rule, watch.offence, watch.imported)


def refuse(rule: str, offence: str, imported: Iterable[Path] = ()) -> None:
    """Raise ``UndeclaredError`` if a rule read something that no option names, or imported unseen modules."""
    unseen = sorted(map(str, imported))
    if unseen and not offence:
        offence = (
            f"the seeding rule {rule!r} imports {unseen[0]} by a name that it makes while it runs, so a comparison "
            "would keep its old results when that changes; use an import statement"
        )
    if offence:
        raise UndeclaredError(offence)
