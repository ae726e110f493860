"""What a seeding rule reads besides its context: files that it does not declare, the environment,
other programs.

Python tells what it opens and starts (audit events, PEP 578). What compiled code opens by itself is
not told.
"""

import _thread
import contextlib
import functools
import importlib.util
import itertools
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from ..errors import ForeseenError
from ..files import cache_folder
from .code_origin import CHECKS_TYPES, is_library_namespace
from .installed import is_installed

_PACKAGE = __name__.partition(".")[0]


def _folders_of_kernels() -> list[str]:
    """Where the package's kernels are, which may lie beside it, and where numba keeps them
    compiled."""
    found = importlib.util.find_spec(f"{_PACKAGE}.kernels")
    sources = found.submodule_search_locations or () if found is not None else ()
    compiled = (
        os.environ.get("NUMBA_CACHE_DIR"),
        user_cache_path("numba", appauthor=False, opinion=False),
    )
    return [str(folder) for folder in (*sources, *compiled) if folder]


SYSTEM_FOLDERS = (
    *(
        "/dev",
        "/proc",
        "/sys",
        "/etc",
        "/usr",
        sys.prefix,
        sys.base_prefix,
        str(Path(__file__).parents[1]),
    ),
    *_folders_of_kernels(),
)
"""What the rule's own process may read without being told: the system, Python, and this package."""
_COMPILED = {".nbi", ".nbc"}
_IMPORT = {"importlib._bootstrap_external", "_frozen_importlib_external"}
_NEW = os.O_CREAT | os.O_EXCL
_COMPILERS = {"torch", "triton", "numba"}
"""Libraries that start a compiler for the code that they are given."""
_PROGRAMS = {
    *(
        "subprocess.Popen",
        "os.system",
        "os.exec",
        "os.posix_spawn",
        "os.spawn",
        "os.startfile",
        "pty.spawn",
    ),
    *("os.fork", "os.forkpty"),
}
_NETWORK = {
    "socket.connect",
    "socket.getaddrinfo",
    "socket.gethostbyname",
    "socket.sendto",
    "urllib.Request",
}
_READING = {"os", "_collections_abc", "collections.abc"}
"""Modules through which the environment is read."""
_OF_THE_USER = {"posixpath", "ntpath", "tempfile"}
"""Modules that look up the user's folders in the environment; what is read there is looked at by
itself."""
_ASKS = ("stat", "lstat", "access", "readlink")
"""Functions of ``os`` that say something of a file without opening it, of which Python does not
tell."""
_ONLY_NAMES = {
    "resolve",
    "realpath",
    "_joinrealpath",
    "checkcache",
    "updatecache",
    "getsourcefile",
    "rmtree",
}
"""Functions of Python that ask so on the way to a path's full name, a message's source line, or to
remove something."""
_COMPILED_READERS = (
    *(("cv2", name) for name in ("imread", "imreadmulti", "VideoCapture", "FileStorage")),
    *(("torch", "from_file"), ("torch.jit", "load")),
)
"""Functions whose compiled code opens the file that their first argument names."""
_CHANGES = {
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "os.utime",
}
_FOLDERS = {"os.listdir", "os.scandir", "glob.glob", "os.walk", "glob.glob/2"}


class UndeclaredError(ForeseenError, ValueError):
    """A rule reads something that decides its seeds and that no option names."""


class _Watch:
    """What one call of a rule may read, and what it did read."""

    def __init__(self, rule: str, paths: Iterable[Path]):
        self.rule = rule
        self.allowed = [
            place.expanduser().resolve()
            for place in (*map(Path, SYSTEM_FOLDERS), cache_folder(), *paths)
        ]
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
        elif event == "sqlite3.connect" or (event == "ctypes.dlopen" and arguments[0]):
            self._opened(arguments[0], "r", 0)
        elif event == "os.mkdir":
            self._makes_folder(arguments[0])
        elif event in _CHANGES and _caller() == "" and not _is_only_a_name():
            self._changed(arguments[0])
        elif event == "builtins.input":
            self._refuse("asks the user", "make it an option")
        elif event in _PROGRAMS and _caller() not in _COMPILERS and not _is_for_package():
            self._refuse(
                f"starts a program ({_words(arguments[:1])})",
                "compute in the rule, or give it the result",
            )
        elif event in _NETWORK and not _is_for_package():
            self._refuse(
                f"uses the network ({_words(arguments[-1:])})", "load it before, as a file"
            )

    def thread(self) -> None:
        """A thread is started, in which nothing would be noticed."""
        if not _is_for_package() and _caller() not in _COMPILERS:
            self._refuse("starts a thread", "compute in the rule's own thread")

    def environment(self, name: str) -> None:
        """The environment variable ``name`` is read."""
        asker, function = next(
            (asked for asked in _functions() if asked[0] not in _READING), ("", "")
        )
        if _caller() == "" and (asker not in _OF_THE_USER or function.startswith("expandvars")):
            self._refuse(
                f"reads the environment variable {name}",
                f'make it an option: {name.lower()}: str = "..."',
            )

    def _opened(self, file: Any, _mode: Any, flags: Any) -> None:
        if isinstance(file, int) or file is None:  # a file that is open already
            return
        path = os.path.abspath(os.fsdecode(file)) if os.fsdecode(file) != ":memory:" else ""
        if isinstance(flags, int) and flags & _NEW == _NEW:
            self.written.add(path)
        if not path or self._is_its_own(path) or _is_for_package():
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
                f"reads {path}, which none of its options names",
                f'declare it: weights: Path = Path("{path}")',
            )

    def _makes_folder(self, folder: Any) -> None:
        path = os.path.abspath(os.fsdecode(folder))
        if not os.path.exists(path):
            self.written.add(path)

    def _changed(self, file: Any) -> None:
        path = None if isinstance(file, int) else os.path.abspath(os.fsdecode(file))
        if path is not None and not self._is_its_own(path):
            self._refuse(f"changes {path}", "keep what it must remember in ctx.memory")

    def _is_its_own(self, path: str | Path) -> bool:
        """Whether it has made a file, or a folder around it, itself."""
        return any(str(place) in self.written for place in (path, *Path(path).parents))

    def compiled(self, file: Any) -> None:
        """Compiled code is told to read a file."""
        if isinstance(file, str | bytes | os.PathLike):
            self._opened(file, "r", 0)

    def asked(self, file: Any) -> None:
        """Something is asked of a file: whether it is there, its size or its date."""
        if not isinstance(file, str | bytes | os.PathLike) or _caller() != "" or _is_only_a_name():
            return
        path = Path(os.path.abspath(os.fsdecode(file)))
        if not self._may_read(path) and not self._is_its_own(path):
            self._refuse(
                f"asks for {path} (whether it exists, its size or date), which none of its options "
                "names",
                f'declare it: weights: Path = Path("{path}")',
            )

    def _listed(self, folder: Any) -> None:
        if folder is None or isinstance(folder, int) or _caller() != "":
            return
        path = Path(os.path.abspath(os.fsdecode(folder)))
        if not self._may_read(path) and not self._is_its_own(path):
            self._refuse(
                f"lists {path}, which none of its options names",
                f'declare it: masks: Path = Path("{path}")',
            )

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
            f"the seeding rule {self.rule!r} {what}, so a comparison would keep its old results "
            f"when that changes; {instead}"
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
    """Name and names of the modules on the stack, the nearest first, from where this one was
    called."""
    frame: Any = sys._getframe(1)
    is_ours = True
    while frame is not None:
        name = frame.f_globals.get("__name__") or ""
        is_ours = is_ours and (name == __name__ or name.startswith(CHECKS_TYPES))
        if not is_ours:
            yield name, frame.f_globals
        frame = frame.f_back


def _functions() -> Iterator[tuple[str, str]]:
    """Module and name of the functions on the stack, the nearest first, from where this module was
    called."""
    frame: Any = sys._getframe(1)
    is_ours = True
    while frame is not None:
        name = frame.f_globals.get("__name__") or ""
        is_ours = is_ours and (name == __name__ or name.startswith(CHECKS_TYPES))
        if not is_ours:
            yield name, frame.f_code.co_name
        frame = frame.f_back


def _is_only_a_name() -> bool:
    """Whether Python asks of a file only to find its full name, the line of a message, or to remove
    it."""
    of_python = itertools.takewhile(
        lambda asked: asked[0].partition(".")[0] in sys.stdlib_module_names, _functions()
    )
    return any(function in _ONLY_NAMES for _, function in of_python)


def _asker() -> str:
    """Name of the module whose code made the call itself."""
    return next((name for name, _ in _frames()), "")


def _caller() -> str:
    """Name of the package whose function asked for it: the nearest on the stack that is not
    Python's own; empty for somebody's own code."""
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
    # A lambda, which no tool that checks types wraps: a wrapper raises events itself, and they
    # would never end.
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
    """Tell ``watch`` of what Python does not tell of: the variables that are read, files that are
    asked for, and those that compiled code opens, in this thread."""
    kind: Any = type(os.environ)

    def told(function: Any, tell: Callable[[Any], None]) -> Any:
        @functools.wraps(function)
        def first_told(*arguments: Any, **options: Any) -> Any:
            if _watch() is watch and arguments:
                tell(arguments[0])
            return function(*arguments, **options)

        return first_told

    def tell_of_thread(_: Any) -> None:
        watch.thread()

    def tell_of_variable(environ: Any, name: Any) -> Any:
        if _watch() is watch:
            watch.environment(os.fsdecode(name))
        return read(environ, name)

    with _patching:
        read = kind.__getitem__
        replaced: list[tuple[Any, str, Any]] = [(kind, "__getitem__", tell_of_variable)]
        replaced += [(os, name, told(getattr(os, name), watch.asked)) for name in _ASKS]
        starts = ((threading.Thread, "start"), (_thread, "start_new_thread"))
        replaced += [
            (owner, name, told(getattr(owner, name), tell_of_thread)) for owner, name in starts
        ]
        for module, name in _COMPILED_READERS:
            if (owner := sys.modules.get(module)) is not None:
                replaced.append((owner, name, told(getattr(owner, name), watch.compiled)))
        before = [(owner, name, getattr(owner, name)) for owner, name, _ in replaced]
        for owner, name, value in replaced:
            setattr(owner, name, value)
        try:
            yield
        finally:
            for owner, name, value in before:
                setattr(owner, name, value)


@contextlib.contextmanager
def noted(rule: str, paths: Iterable[Path] = ()) -> Iterator[_Watch]:
    """Context that notes what a rule reads besides the files and folders ``paths``, those of Python
    and of packages."""
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
    """Context in which a rule may read the files and folders ``paths`` only, and those of Python
    and of packages.

    No environment variable, no other program, no network. A temporary file that it makes itself may
    be read.

    Args:
        rule: Name of the rule, for the message.
        paths: Its options of type ``Path``, and the files of its modules.

    Raises:
        UndeclaredError: at the end of the context, if it read something else, also where it caught
            its own error.
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
    """Raise ``UndeclaredError`` if a rule read something that no option names, or imported unseen
    modules."""
    unseen = sorted(map(str, imported))
    if unseen and not offence:
        offence = (
            f"the seeding rule {rule!r} imports {unseen[0]} by a name that it makes while it runs, "
            "so a comparison would keep its old results when that changes; use an import statement"
        )
    if offence:
        raise UndeclaredError(offence)
