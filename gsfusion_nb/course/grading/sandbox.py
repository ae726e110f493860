"""The sandbox: a student's functions run in a process of their own, in an installation without the solutions.

The process has limits of time and memory. Behind bubblewrap (``bwrap``) it has, besides, a file system that can only be
read, without the notebooks, the real package and the home folder; no network; and a numbering of processes of its own,
so that all that is started ends with the sandbox. ``unprotected`` says what remains possible without bubblewrap.
"""

import contextlib
import functools
import inspect
import io
import os
import pickle
import re
import shutil
import signal
import site
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

import torch

from ...mapping import GSFusion
from ...optim import Keyframe
from ...types import Camera, Frame, Seeds
from ..attempt import NotCallable
from ..exercise import exercises
from ..learner_code import Failed
from .sandbox_program import WITHIN, Cell

ENDED = "it returns an answer"
LENT = {"quadtree_leaves": ("contrast", "split_cell")}
"""Exercise -> others whose reference may stand in for the student's that failed, as it does in the notebook."""
_COPIED = ("learner_code.py", "progress.py", "seeding_scene.py", "grading/__init__.py", "grading/sandbox_program.py")
"""Files of ``gsfusion_nb.course`` that are in the sandbox: none has a solution."""
_START = "import sys; sys.path[:] = {path!r}; from gsfusion_nb.course.grading import sandbox_program as program; "
_START_S = 300.0
"""How long a sandbox may take to be ready."""
_LARGEST_BYTES = 32 << 20
"""Of an answer."""
_SYSTEM = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/sys/devices/system/cpu")
_TEMPORARY_BYTES = str(256 << 20)
"""Of each folder in which a submission may write; they are in memory, and end with the sandbox."""
_COURSE = ". The course's own modules are not there when a submission is marked: write the function yourself"


class NoSandbox(RuntimeError):
    """No submission can be run on this system; the message says what is missing."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Of one exercise of one submission."""

    seconds: float = 30.0
    """Processor time for its function, all calls together, so that a busy machine changes no mark. An answer that
    takes 30 s and four times as long on the clock ends it, too."""
    memory_mb: int = 1024
    """Beyond what Python, torch and this package take."""


class Sandbox:
    """Runs the functions of one student, one after the other. A context manager; its processes end with it.

    Args:
        limits: Of each function.

    Raises:
        NoSandbox: the system has no resource limits, or Python does not start.
    """

    def __init__(self, limits: Limits):
        check_possible()
        self.limits = limits
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Sandbox":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> int:
        """End the process and all of its group; returns the signal that had ended it before, or 0."""
        if self._process is None:
            return 0
        process, self._process = self._process, None
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(1.0)
        ended_with = process.returncode
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        self._to.close()
        return 0 if ended_with is None else -ended_with if ended_with < 0 else max(ended_with - 128, 0)

    def function(self, name: str, cells: Sequence[Cell], accepted: frozenset[str] = frozenset()) -> "Remote":
        """The function ``name`` of a submission, to be called like one of this process.

        Args:
            name: Of the function, and of its exercise.
            cells: Of the submission.
            accepted: Exercises whose functions of the same submission were accepted.
        """
        return Remote(self, name, cells, accepted)

    def say(self, *message: Any) -> None:
        """Send a message; starts the process if there is none."""
        if self._process is None:
            self._start()
        with contextlib.suppress(ConnectionError):  # the answer is then missing, too
            self._to.send_bytes(pickle.dumps(message))

    def hear(self, wait_s: float) -> tuple[Any, ...] | None:
        """The next answer, made of plain values; ``None`` if none comes in time.

        Raises:
            EOFError, OSError: the process has ended.
            pickle.UnpicklingError: the answer holds other objects.
        """
        if not self._to.poll(wait_s):
            return None
        message = torch.load(io.BytesIO(self._to.recv_bytes(_LARGEST_BYTES)), weights_only=True)
        if not isinstance(message, tuple) or not message:
            raise pickle.UnpicklingError
        return message

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        tree = Path(_clean_copy().name).resolve()
        program = _START.format(path=_import_path(tree)) + (
            f"program.main({theirs.fileno()}, {self.limits.memory_mb << 20}, {max(1, round(self.limits.seconds))})"
        )
        behind_bubblewrap = not why_no_bubblewrap()
        folder = "/tmp" if behind_bubblewrap else str(tree / "work")
        environment = {"PATH": os.defpath, "HOME": folder, "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
        environment |= {"GSFUSION_BACKEND": "reference", "NUMBA_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
        command = [sys.executable, "-I", "-S", "-X", "utf8", "-c", program]
        with tempfile.TemporaryFile() as errors:
            self._process = subprocess.Popen(
                [*_behind_bubblewrap(tree), *command] if behind_bubblewrap else command,
                pass_fds=[theirs.fileno()], env=environment, cwd=tree / "work", start_new_session=True,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors,
            )  # fmt: skip
            theirs.close()
            self._to = Connection(ours.detach())
            try:
                started = self.hear(_START_S)
            except (EOFError, OSError):
                started = None
            if started is None:
                self.end()
                errors.seek(0)
                said = errors.read().decode(errors="replace").strip().splitlines()
                raise NoSandbox(f"the sandbox does not start: {said[-1] if said else 'it ended'}")


class Remote:
    """A submission's function in a sandbox, called like one of this process: values go there and back.

    It raises ``Failed`` for what the submission does, and ``NotImplementedError`` where it has no body.
    """

    def __init__(self, sandbox: Sandbox, name: str, cells: Sequence[Cell], accepted: frozenset[str]):
        self.__name__ = self.__qualname__ = name
        self._sandbox, self._define = sandbox, ([(cell.label, cell.source) for cell in cells], name, accepted)
        self._begun = False
        self._lost: Failed | None = None
        self._parameters: Any = None

    @property
    def __signature__(self) -> inspect.Signature:
        """That of the submission's function."""
        self._begin()
        if self._parameters is None:
            raise ValueError("the function has no signature")
        return inspect.Signature([
            inspect.Parameter(
                name, inspect._ParameterKind(kind), default=default if optional else inspect.Parameter.empty
            )
            for name, kind, optional, default in self._parameters
        ])  # fmt: skip

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call it with copies of the arguments; the mappers among them are left as it left its copies."""
        self._begin()
        self._sandbox.say("call", [_sent(i, value) for i, value in enumerate(args)], kwargs)
        result, changed, states = self._answer("returned", args)
        _apply_states(args, states)
        if changed:
            detail = "a tensor or an array that was passed in has changed; work on a copy"
            raise Failed("it does not change its inputs", "", detail)
        return Seeds(**result["Seeds"]) if isinstance(result, dict) and set(result) == {"Seeds"} else result

    def _begin(self) -> None:
        if self._lost:
            raise self._lost
        if not self._begun:
            self._begun = True
            self._sandbox.say("define", *self._define)
            try:
                (self._parameters,) = self._answer("ready", ())
            except Failed as e:
                self._lost = NotCallable(e.prop, "", e.detail)
                raise self._lost from None

    def _answer(self, wanted: str, args: tuple[Any, ...]) -> Sequence[Any]:
        """The rest of the answer of kind ``wanted``; meanwhile the submission's questions are answered."""
        limits = self._sandbox.limits
        while True:
            try:
                message = self._sandbox.hear(30.0 + 4.0 * limits.seconds)
            except (pickle.UnpicklingError, RuntimeError, ValueError):
                self._lose("it returns plain values", "it returned an object that cannot be sent, or is damaged")
            except (EOFError, OSError):
                stopped = self._sandbox.end() == signal.SIGXCPU
                if stopped:
                    rest = "is there a loop that does not end, or a much too slow one?"
                    detail = f"it had not ended after {limits.seconds:g} s of processor time, and was stopped: {rest}"
                    self._lose(WITHIN, detail)
                self._lose(
                    ENDED, "its process ended without an answer: it crashed, left Python, or used too much memory"
                )
            if message is None:
                self._lose(WITHIN, "no answer came for a long time: does it sleep, or wait for something?")
            kind, *rest = message
            if kind == wanted:
                return rest
            if kind == "ask":
                what, inner, states = rest
                _apply_states(args, states)
                self._sandbox.say(*self._asked(what, args, inner))
            elif kind == "not written":
                raise NotImplementedError
            else:
                prop, detail = rest
                course = _COURSE if re.search(r"No module named 'gsfusion_nb\.course\b", detail) else ""
                raise Failed(prop, "", detail + course)

    def _asked(self, what: int | str, args: tuple[Any, ...], inner: list[Any]) -> tuple[str, Any]:
        """The answer to a call of a function that was an argument, or of another exercise's reference."""
        try:
            if isinstance(what, int):
                return "value", args[what](*map(_view, inner))
            if what in LENT.get(self.__name__, ()):
                return "value", exercises()[what]._solution(*inner)
            return "refused", f"the reference's {what} is for the rest of the chapter; write your own"
        except Exception as e:
            return "refused", f"{type(e).__name__}: {e}"

    def _lose(self, prop: str, detail: str) -> NoReturn:
        """There is no process any more that could be called; the next function gets a new one."""
        self._sandbox.end()
        self._lost = Failed(prop, "", detail)
        raise self._lost from None


def _sent(number: int, value: Any) -> Any:
    """An argument as it is sent: a function as the right to ask for its value, a mapper as its state."""
    if isinstance(value, GSFusion):
        return ("mapper", value.config, value.state_dict() if value.volume.n_blocks else None)
    return ("function", number) if callable(value) else value


def _view(value: Any) -> Any:
    """A view that was handed to a function of the grader: what is known of it is its kind and its index."""
    if not (isinstance(value, tuple) and value[:1] == ("view",)):
        return value
    camera = Camera(width=1, height=1, fx=1.0, fy=1.0, cx=0.5, cy=0.5)
    if value[1] == "keyframe":
        return Keyframe(index=value[2], rgb_u8=torch.zeros(1, 1, 3).byte(), camera=camera, T_WC=torch.eye(4))
    rgb, depth_m = torch.zeros(1, 1, 3), torch.zeros(1, 1)
    return Frame(index=value[2], timestamp_s=0.0, rgb=rgb, depth_m=depth_m, camera=camera, T_WC=torch.eye(4))


def _apply_states(args: tuple[Any, ...], states: dict[int, Any]) -> None:
    """Put the mappers in ``args`` into the states that the submission left them in; settings and rule stay."""
    for i, state in states.items():
        kept = {key: args[i].state_dict()[key] for key in ("config", "rule")}
        try:
            vars(args[i]).update(vars(GSFusion.from_state_dict(state | kept)))
        except Exception as e:
            raise Failed("it leaves the mapper in order", "", f"{type(e).__name__}: {e}") from None


def check_possible() -> None:
    """Raise ``NoSandbox`` on a system without resource limits."""
    if find_spec("resource") is None:
        raise NoSandbox(
            "grading needs the limits of the module `resource`, which this system does not have; "
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


def _behind_bubblewrap(tree: Path) -> list[str]:
    """The command before that of Python: system, Python and packages can be read, the real package is hidden."""
    python = [sys.base_prefix, sys.prefix, *_import_path(tree)[1:]]
    shown = [option for path in dict.fromkeys([*_SYSTEM, *python]) for option in ("--ro-bind-try", path, path)]
    empty = [option for path in ("/tmp", "/dev/shm") for option in ("--size", _TEMPORARY_BYTES, "--tmpfs", path)]
    return [
        "bwrap", "--unshare-pid", "--unshare-net", "--unshare-ipc", "--unshare-uts", "--die-with-parent",
        "--cap-drop", "ALL", *shown, "--tmpfs", str(_package_folder()), "--proc", "/proc", "--dev", "/dev", *empty,
        "--ro-bind", str(tree), str(tree), "--chdir", "/tmp", "--",
    ]  # fmt: skip


@functools.cache
def _clean_copy() -> tempfile.TemporaryDirectory:
    """A folder with an installation without the solutions, kept while this program runs."""
    folder = tempfile.TemporaryDirectory(prefix="gsnb-grade-", ignore_cleanup_errors=True)
    write_clean_copy(Path(folder.name))
    (Path(folder.name) / "work").mkdir()
    return folder


def write_clean_copy(folder: Path) -> None:
    """Copy the package into ``folder``, of ``gsfusion_nb.course`` only what runs submissions, and no notebook."""
    package = _package_folder()
    leave_out = shutil.ignore_patterns("*.nbi", "*.nbc", "__pycache__", "course", "notebooks", "docs")
    copy = folder / "gsfusion_nb"
    shutil.copytree(package, copy, ignore=leave_out)
    if not (copy / "kernels").exists():
        kernels = find_spec("gsfusion_nb.kernels")
        assert kernels is not None
        assert kernels.origin is not None
        shutil.copytree(Path(kernels.origin).resolve().parent, copy / "kernels", ignore=leave_out)
    (copy / "course" / "grading").mkdir(parents=True)
    (copy / "course" / "__init__.py").touch()
    for name in _COPIED:
        shutil.copy2(package / "course" / name, copy / "course" / name)


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
