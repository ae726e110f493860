"""What one call of a seeding rule may read, and what it did read besides."""

import importlib.util
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from ..code_keys.installed import is_installed
from ..code_keys.origin import OWN_PACKAGE
from ..files import cache_folder
from .callers import (
    asker,
    caller,
    functions,
    is_for_a_message,
    is_for_package,
    is_only_a_name,
)


def _folders_of_kernels() -> list[str]:
    """Where the package's kernels are, which may lie beside it, and where numba keeps them
    compiled."""
    spec = importlib.util.find_spec(f"{OWN_PACKAGE}.kernels")
    sources = spec.submodule_search_locations or () if spec is not None else ()
    caches = (
        os.environ.get("NUMBA_CACHE_DIR"),
        user_cache_path("numba", appauthor=False, opinion=False),
    )
    return [str(folder) for folder in (*sources, *caches) if folder]


SYSTEM_FOLDERS = (
    "/dev",
    "/proc",
    "/sys",
    "/etc",
    "/usr",
    sys.prefix,
    sys.base_prefix,
    str(Path(__file__).parents[1]),
    *_folders_of_kernels(),
)
"""What libraries may read in the rule's process without being told: the system, Python, and this
package. The rule's own code may not: a file of the system is another one on another machine."""
_FOR_THE_RULE = (str(Path(__file__).parents[1]), *_folders_of_kernels(), os.devnull)
"""What the rule's own code may read without being told, besides modules of Python and packages."""
_DATA_READERS = {"numpy", "PIL", "scipy"}
"""Libraries that open only the files that they are told to."""
_COMPILED = {".nbi", ".nbc"}
_IMPORT = {"importlib._bootstrap_external", "_frozen_importlib_external"}
_NEW = os.O_CREAT | os.O_EXCL
_COMPILERS = {"torch", "triton", "numba"}
"""Libraries that start a compiler for the code that they are given."""
_PROGRAMS = {
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.startfile",
    "pty.spawn",
    "os.fork",
    "os.forkpty",
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


class RuleWatch:
    """What one call of a rule may read, and what it did read."""

    def __init__(self, rule: str, paths: Iterable[Path]):
        self.rule = rule
        self.open_places = [
            place.expanduser().resolve()
            for place in (*map(Path, SYSTEM_FOLDERS), cache_folder(), *paths)
        ]
        self.own_places = [
            place.expanduser().resolve()
            for place in (*map(Path, _FOR_THE_RULE), cache_folder(), *paths)
        ]
        """Of these, those for the rule's own code."""
        self.own_files: set[str] = set()
        """Files and folders that the rule made itself."""
        self.imported_files: set[Path] = set()
        """Files of own modules that were imported."""
        self.offence = ""

    def note(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Look at an audit event of this thread."""
        if event == "open":
            self._note_open(*arguments[:3])
        elif event in _FOLDERS:
            self._note_listing(arguments[0] if arguments else None)
        elif event == "sqlite3.connect" or (event == "ctypes.dlopen" and arguments[0]):
            self._note_open(arguments[0], "r", 0)
        elif event == "os.mkdir":
            self._note_new_folder(arguments[0])
        elif event in _CHANGES and caller() == "" and not is_only_a_name():
            self._note_change(arguments[0])
        elif event == "builtins.input":
            self._refuse("asks the user", "make it an option")
        elif event in _PROGRAMS and caller() not in _COMPILERS and not is_for_package():
            self._refuse(
                f"starts a program ({_words(arguments[:1])})",
                "compute in the rule, or give it the result",
            )
        elif event in _NETWORK and not is_for_package():
            self._refuse(
                f"uses the network ({_words(arguments[-1:])})", "load it before, as a file"
            )

    def note_thread(self) -> None:
        """A thread is started, in which nothing would be noticed."""
        if not is_for_package() and caller() not in _COMPILERS:
            self._refuse("starts a thread", "compute in the rule's own thread")

    def note_variable(self, name: str) -> None:
        """The environment variable ``name`` is read."""
        if _asks_for_variables():
            self._refuse(
                f"reads the environment variable {name}",
                f'make it an option: {name.lower()}: str = "..."',
            )

    def note_variables(self) -> None:
        """The names of all environment variables are read, or their number."""
        if _asks_for_variables():
            self._refuse(
                "reads which environment variables there are",
                'make an option of what it looks for: mode: str = "..."',
            )

    def _note_open(self, file: Any, _mode: Any, flags: Any) -> None:
        if isinstance(file, int) or file is None:  # a file that is open already
            return
        path = os.path.abspath(os.fsdecode(file)) if os.fsdecode(file) != ":memory:" else ""
        if isinstance(flags, int) and flags & _NEW == _NEW:
            self.own_files.add(path)
        if not path or self._is_its_own(path) or is_for_package():
            return
        opener = asker()
        if opener == "tokenize" and is_for_a_message():  # the source of a function
            return
        is_import = opener in _IMPORT
        if is_import:
            path = _source_of(path)
        if self._may_read(Path(path), is_own=not is_import and _reads_for_the_rule(opener)):
            return
        if is_import:
            self.imported_files.add(Path(path))
        elif isinstance(flags, int) and flags & os.O_WRONLY:
            self._refuse(f"writes {path}", "keep what it must remember in ctx.memory")
        elif os.path.exists(path) and not os.path.isdir(path):
            self._refuse(
                f"reads {path}, which none of its options names",
                f'declare it: weights: Path = Path("{path}")',
            )

    def _note_new_folder(self, folder: Any) -> None:
        path = os.path.abspath(os.fsdecode(folder))
        if not os.path.exists(path):
            self.own_files.add(path)

    def _note_change(self, file: Any) -> None:
        path = None if isinstance(file, int) else os.path.abspath(os.fsdecode(file))
        if path is not None and not self._is_its_own(path):
            self._refuse(f"changes {path}", "keep what it must remember in ctx.memory")

    def _is_its_own(self, path: str | Path) -> bool:
        """Whether it has made a file, or a folder around it, itself."""
        return any(str(place) in self.own_files for place in (path, *Path(path).parents))

    def note_compiled_read(self, file: Any) -> None:
        """Compiled code is told to read a file."""
        if isinstance(file, str | bytes | os.PathLike):
            self._note_open(file, "r", 0)

    def note_query(self, file: Any) -> None:
        """Something is asked of a file: whether it is there, its size or its date."""
        if not isinstance(file, str | bytes | os.PathLike) or caller() != "" or is_only_a_name():
            return
        path = Path(os.path.abspath(os.fsdecode(file)))
        if not self._may_read(path, is_own=True) and not self._is_its_own(path):
            self._refuse(
                f"asks for {path} (whether it exists, its size or date), which none of its options "
                "names",
                f'declare it: weights: Path = Path("{path}")',
            )

    def _note_listing(self, folder: Any) -> None:
        if folder is None or isinstance(folder, int) or caller() != "":
            return
        path = Path(os.path.abspath(os.fsdecode(folder)))
        if not self._may_read(path, is_own=True) and not self._is_its_own(path):
            self._refuse(
                f"lists {path}, which none of its options names",
                f'declare it: masks: Path = Path("{path}")',
            )

    def _may_read(self, path: Path, *, is_own: bool) -> bool:
        """Whether a file may be read; ``is_own``: by the rule's own code."""
        if path.suffix in _COMPILED or is_installed(path):
            return True
        places = self.own_places if is_own else self.open_places
        try:
            paths = {path, path.resolve()}
        except OSError:
            paths = {path}
        return any(path.is_relative_to(place) for path in paths for place in places)

    def _refuse(self, what: str, advice: str) -> None:
        self.offence = self.offence or (
            f"the seeding rule {self.rule!r} {what}, so a comparison would keep its old results "
            f"when that changes; {advice}"
        )


def _asks_for_variables() -> bool:
    """Whether the rule's own code looks into the environment, and not for the user's folders."""
    asker, function = next(
        (asking for asking in functions() if asking[0] not in _READING), ("", "")
    )
    return caller() == "" and (asker not in _OF_THE_USER or function.startswith("expandvars"))


def _reads_for_the_rule(opener: str) -> bool:
    """Whether a file is opened by the rule's own code, or by a library that it told to do so."""
    return caller() in ("", *_DATA_READERS) or opener == "torch.serialization"


def _source_of(path: str) -> str:
    """The source of a file that Python compiled."""
    try:
        return importlib.util.source_from_cache(path) if path.endswith(".pyc") else path
    except ValueError:
        return path


def _words(arguments: tuple[Any, ...]) -> str:
    return " ".join(str(a) for a in arguments)[:200]
