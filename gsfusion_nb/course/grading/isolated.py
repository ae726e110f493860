"""The sandbox: a student's functions run behind bubblewrap, in an installation without the solutions.

bubblewrap (``bwrap``) gives them a file system that can only be read, without the notebooks, the real package and the
home folder; no network; and a numbering of processes of their own, so that all that they start ends with the sandbox.
"""

import contextlib
import functools
import json
import os
import select
import shutil
import signal
import site
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from ..sandbox.messages import decode, receive
from ..sandbox.needed import Cell
from .remote import Limits, Remote

_START = """
import sys
sys.path[:] = {path!r}
from gsfusion_nb.course.sandbox import task
task.main({fd}, {memory_bytes}, {cpu_s})
"""
_START_S = 300.0
"""How long a sandbox may take to be ready."""
_ENDS_S = 10.0
"""How long killed processes may take to end."""
_SYSTEM = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/sys/devices/system/cpu")
_TEMPORARY_BYTES = str(256 << 20)
"""Of each folder in which a submission may write; they are in memory, and end with the sandbox."""


class NoSandbox(RuntimeError):
    """No submission can be run on this system; the message says what is missing."""


class Sandbox:
    """Runs the functions of one student, each in a process of its own, one at a time, without the solutions.

    A context manager. Behind bubblewrap all processes end with it; ``unprotected`` says what holds without.

    Args:
        limits: Of each function.

    Raises:
        NoSandbox: the system has no ``fork`` or no resource limits, or Python does not start.
    """

    def __init__(self, limits: Limits):
        check_possible()
        self.limits = limits
        self._process: subprocess.Popen[bytes] | None = None
        self._first = -1

    def __enter__(self) -> "Sandbox":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._ours.close()
            if self._first >= 0:  # the first of the namespace: it ends when all others in it have ended
                select.select([self._first], [], [], _ENDS_S)
                os.close(self._first)
            self._process = None

    @contextlib.contextmanager
    def function(self, name: str, cells: Sequence[Cell], accepted: frozenset[str] = frozenset()) -> Iterator[Remote]:
        """The function ``name`` of a submission, to be called like one of this process.

        Args:
            accepted: Exercises whose functions of the same submission were accepted.

        Yields:
            A ``Remote``, which raises ``Failed`` and ``NotWritten`` for what the submission does.
        """
        if self._process is None:
            self._start()
        remote = Remote(self._ours, name, cells, accepted, self.limits)
        try:
            yield remote
        finally:
            if not remote.end():
                self.__exit__()  # the next function gets a new one

    def _start(self) -> None:
        self._ours, theirs = socket.socketpair()
        tree = Path(_clean_copy().name).resolve()
        start = _START.format(
            path=_import_path(tree), fd=theirs.fileno(), memory_bytes=self.limits.memory_mb << 20,
            cpu_s=self.limits.cpu_s,
        )  # fmt: skip
        plain = bool(why_no_bubblewrap())
        folder = str(tree / "work") if plain else "/tmp"
        environment = {"PATH": os.defpath, "HOME": folder, "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
        environment |= {"GSFUSION_BACKEND": "reference", "NUMBA_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
        about, info = os.pipe()
        command = [sys.executable, "-I", "-S", "-X", "utf8", "-c", start]
        with tempfile.TemporaryFile() as errors, open(about) as said_first:
            self._process = subprocess.Popen(
                command if plain else [*_behind_bubblewrap(tree, "--info-fd", str(info)), *command],
                pass_fds=[theirs.fileno(), info], env=environment, cwd=tree / "work", start_new_session=True,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors,
            )  # fmt: skip
            theirs.close()
            os.close(info)
            try:
                self._first = -1 if plain else os.pidfd_open(json.load(said_first)["child-pid"])
                decode(receive(self._ours, until=time.monotonic() + _START_S))
            except (ValueError, OSError):  # no message, or none that can be read
                self.__exit__()
                errors.seek(0)
                said = errors.read().decode(errors="replace").strip().splitlines()
                raise NoSandbox(f"the sandbox does not start: {said[-1] if said else 'it ended'}") from None


def check_possible() -> None:
    """Raise ``NoSandbox`` on a system without ``fork`` or resource limits."""
    if not hasattr(os, "fork"):
        raise NoSandbox(
            "grading needs fork and the limits of the module `resource`, which this system does not have; "
            "use Linux, macOS, or the Windows Subsystem for Linux"
        )


@functools.cache
def why_no_bubblewrap() -> str:
    """Why submissions do not run behind bubblewrap here; empty if they do."""
    if shutil.which("bwrap") is None:
        return "bubblewrap (bwrap) is not installed"
    command = [*_behind_bubblewrap(Path(_clean_copy().name).resolve()), sys.executable, "-I", "-S", "-c", ""]
    tried = subprocess.run(command, capture_output=True, text=True)
    return f"bubblewrap does not work here ({tried.stderr.strip()[-200:]})" if tried.returncode else ""


def unprotected() -> str:
    """What is not guarded on this system, in sentences for who grades; empty behind bubblewrap."""
    why = why_no_bubblewrap()
    return why and (
        f"{why}: each function runs in a process with limits of time and memory, but it may read and change the files "
        "of your account (also the solutions), use the network, and leave processes behind. Install bubblewrap (on "
        "Debian and Ubuntu: apt-get install bubblewrap), or grade in a container. See docs/teaching/grading.md"
    )


def _behind_bubblewrap(tree: Path, *options: str) -> list[str]:
    """The command before that of Python: system, Python and packages can be read, the real package is hidden."""
    python = [sys.base_prefix, sys.prefix, *_import_path(tree)[1:]]
    shown = [option for path in dict.fromkeys([*_SYSTEM, *python]) for option in ("--ro-bind-try", path, path)]
    empty = [option for path in ("/tmp", "/dev/shm") for option in ("--size", _TEMPORARY_BYTES, "--tmpfs", path)]
    return [
        "bwrap", "--unshare-pid", "--unshare-net", "--unshare-ipc", "--unshare-uts", "--die-with-parent",
        "--cap-drop", "ALL", *shown, "--tmpfs", str(_package_folder()), "--proc", "/proc", "--dev", "/dev", *empty,
        "--ro-bind", str(tree), str(tree), "--chdir", "/tmp", *options, "--",
    ]  # fmt: skip


@functools.cache
def _clean_copy() -> tempfile.TemporaryDirectory:
    """A folder with an installation without the solutions, kept while this program runs."""
    folder = tempfile.TemporaryDirectory(prefix="gsnb-grade-", ignore_cleanup_errors=True)
    write_clean_copy(Path(folder.name))
    (Path(folder.name) / "work").mkdir()
    return folder


def write_clean_copy(folder: Path) -> None:
    """Copy the package into ``folder``, with ``sandbox/stand_in.py`` in place of ``gsfusion_nb.course``.

    The solved notebooks, which a wheel puts into the package, are left out.
    """
    package = _package_folder()
    leave_out = shutil.ignore_patterns("*.nbi", "*.nbc", "__pycache__", "course", "notebooks", "docs")
    copy = folder / "gsfusion_nb"
    shutil.copytree(package, copy, ignore=leave_out)
    if not (copy / "kernels").exists():
        kernels = find_spec("gsfusion_nb.kernels")
        assert kernels is not None
        assert kernels.origin is not None
        shutil.copytree(Path(kernels.origin).resolve().parent, copy / "kernels", ignore=leave_out)
    shutil.copytree(package / "course" / "sandbox", copy / "course" / "sandbox", ignore=leave_out)
    shutil.copy2(package / "course" / "wall.py", copy / "course" / "wall.py")
    shutil.copy2(package / "course" / "sandbox" / "stand_in.py", copy / "course" / "__init__.py")


def _import_path(folder: Path) -> list[str]:
    """``sys.path`` of the sandbox: the clean copy, then Python's own folders and those of installed packages."""
    own = (*site.getsitepackages(), site.getusersitepackages())
    names = ("site-packages", "dist-packages", "lib-dynload")
    kept = [p for p in sys.path if p in own or Path(p).name in names or Path(p).name.startswith("python3")]
    return [str(folder), *kept]


def _package_folder() -> Path:
    """Where the package is installed."""
    spec = find_spec("gsfusion_nb")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).resolve().parent
