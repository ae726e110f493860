"""The sandbox: submissions run in processes of their own; what they return comes back as values, what they do stays."""

import contextlib
import functools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ..sandbox.needed import Cell
from .clean import import_path, readable_paths, write_clean_copy
from .limits import Limits
from .remote import Remote

_START = """
import sys
sys.path[:] = {path!r}
from gsfusion_nb.teaching.sandbox import serve
serve.main({fd}, {settings!r})
"""
_START_S = 300.0
"""How long a sandbox may take to be ready."""


class NoSandbox(RuntimeError):
    """No sandbox can be started on this system; the message says what is missing."""


class Sandbox:
    """Runs submissions in processes of their own, one at a time, in an installation without the solutions.

    A context manager; its temporary folder and all processes are gone at its end.

    Args:
        limits: Of each task.

    Raises:
        NoSandbox: the system has no ``fork`` or no resource limits.
    """

    def __init__(self, limits: Limits):
        check_possible()
        self.limits = limits
        self.landlock = 0
        """Version of Landlock that guards the files; 0 if only Python's audit hook does."""
        self._folder = tempfile.TemporaryDirectory(prefix="gsnb-grade-")

    def __enter__(self) -> "Sandbox":
        tree = Path(self._folder.name).resolve() / "clean"
        empty = tree.with_name("empty")
        empty.mkdir()
        write_clean_copy(tree)
        readable, listed = readable_paths(tree)
        settings = {
            "readable": readable, "listed": listed, "memory_bytes": self.limits.memory_mb << 20,
            "cpu_s": self.limits.cpu_s,
        }  # fmt: skip
        self._control, theirs = socket.socketpair()
        start = _START.format(path=import_path(tree), fd=theirs.fileno(), settings=json.dumps(settings))
        environment = {"PATH": os.defpath, "HOME": str(empty), "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
        environment |= {"GSFUSION_BACKEND": "reference", "NUMBA_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
        self._errors = (tree.parent / "errors.txt").open("wb")
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-X", "utf8", "-c", start], pass_fds=[theirs.fileno()], env=environment,
            cwd=empty, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._errors,
        )  # fmt: skip
        theirs.close()
        self._control.settimeout(_START_S)
        ready = self._control.recv(1)
        if not ready:
            said = Path(self._errors.name).read_text(errors="replace").strip().splitlines()
            self.__exit__()
            raise NoSandbox(f"the sandbox does not start: {said[-1] if said else 'it ended'}")
        self.landlock = ready[0]
        return self

    def __exit__(self, *_: object) -> None:
        self._control.close()
        self._process.kill()
        self._process.wait()
        self._errors.close()
        self._folder.cleanup()

    @contextlib.contextmanager
    def function(self, name: str, cells: Sequence[Cell], accepted: frozenset[str] = frozenset()):
        """The function ``name`` of a submission, to be called like one of this process.

        Args:
            accepted: Exercises whose functions of the same submission were accepted.

        Yields:
            A ``Remote``, which raises ``Failed`` and ``NotWritten`` for what the submission does.
        """
        ours, theirs = socket.socketpair()
        socket.send_fds(self._control, [b"f"], [theirs.fileno()])
        theirs.close()
        process = int.from_bytes(self._control.recv(8), "big")
        stop = functools.cache(lambda: self._stop(process))
        try:
            yield Remote(ours, name, cells, accepted, self.limits, stop)
        finally:
            ours.close()
            stop()

    def _stop(self, process: int) -> int:
        """End a process, and return the signal that ended it, 0 for none."""
        for end in (os.killpg, os.kill):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                end(process, signal.SIGKILL)
        self._control.sendall(b"w")
        return self._control.recv(1)[0]


def check_possible() -> None:
    """Raise ``NoSandbox`` on a system without ``fork`` or resource limits."""
    if not (hasattr(os, "fork") and hasattr(socket, "send_fds")):
        raise NoSandbox(
            "grading needs fork and the limits of the module `resource`, which this system does not have; "
            "use Linux, macOS, or the Windows Subsystem for Linux"
        )
