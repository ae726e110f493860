"""The sandbox: the functions of one student are judged in a process of their own, with limits of
time and memory.

``python -m gsfusion_nb.course.grading.sandbox`` is the program of that process. Behind bubblewrap
(``bwrap``) it can write in a folder of its own only, has no network, and ends with all that it
started.
"""

import ast
import functools
import json
import linecache
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import types
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from typing import Any

import torch

from ...backends import use_backend
from ...errors import ArgumentError
from ..attempt import Failed, Verdict
from ..exercise import exercises
from .submission import Cell, needed

_BUBBLEWRAP = (
    "bwrap",
    "--ro-bind",
    "/",
    "/",
    "--dev",
    "/dev",
    "--proc",
    "/proc",
    "--unshare-pid",
    "--unshare-net",
    "--die-with-parent",
)
_ENVIRONMENT = {
    "GSFUSION_BACKEND": "reference",
    "GSNB_VIEW": "static",
    "MPLBACKEND": "agg",
    "OMP_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Of one exercise of one submission."""

    seconds: float = 120.0
    """For all calls of its function, on the clock. One call may take as long as in a notebook."""
    memory_mb: int = 4096
    """Of the process, with Python and torch."""


def verdicts(
    cells: Mapping[str, Sequence[Cell]],
    limits: Limits,
) -> dict[str, Verdict]:
    """The verdicts on the functions of one submission; nothing is kept or noted.

    Args:
        cells: Exercise -> the code cells that define its function.
        limits: Of each function.

    Raises:
        ValueError: this system has no resource limits.
    """
    if find_spec("resource") is None:
        raise ArgumentError("grading needs Linux, macOS, or the Windows Subsystem for Linux")
    results: dict[str, Verdict] = {}
    while open_names := [name for name in cells if name not in results]:
        task = {
            "cells": {name: [[c.label, c.source] for c in cells[name]] for name in open_names},
            **asdict(limits),
        }
        reply, code, error = _run(json.dumps(task))
        results |= {verdict["exercise"]: Verdict(**verdict) for verdict in map(json.loads, reply)}
        if len(reply) < len(open_names):  # it ended while it judged the next one
            late = code in (-signal.SIGALRM, 128 + signal.SIGALRM)
            detail = (
                f"it had not ended after {limits.seconds:g} s"
                if late
                else f"its process ended: {error}"
            )
            next_one = open_names[len(reply)]
            results[next_one] = Verdict(
                exercise=next_one, state="failed", prop="it returns an answer", detail=detail
            )
    return results


def _run(task: str) -> tuple[list[str], int, str]:
    """Lines that the process of the sandbox wrote, its exit status, and the end of what it said on
    errors."""
    with tempfile.TemporaryDirectory(prefix="gsnb-grade-", ignore_cleanup_errors=True) as folder:
        wall = (
            []
            if why_no_bubblewrap()
            else [*_BUBBLEWRAP, "--bind", folder, folder, "--chdir", folder]
        )
        own = {
            "HOME": folder,
            "TMPDIR": folder,
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        }
        command = [*wall, sys.executable, "-m", __name__]
        process = subprocess.run(
            command,
            input=task,
            capture_output=True,
            text=True,
            cwd=folder,
            env=os.environ | _ENVIRONMENT | own,
        )
    last = (process.stderr.strip().splitlines() or ["it crashed"])[-1]
    return process.stdout.splitlines(), process.returncode, last


@functools.cache
def why_no_bubblewrap() -> str:
    """Why submissions do not run behind bubblewrap here; empty if they do."""
    if shutil.which("bwrap") is None:
        return "bubblewrap (bwrap) is not installed"
    process = subprocess.run([*_BUBBLEWRAP, "true"], capture_output=True, text=True)
    return (
        f"bubblewrap does not work here ({process.stderr.strip()[-200:]})"
        if process.returncode
        else ""
    )


def main() -> None:
    """Judge the functions of the task on standard input; writes a line of JSON for each."""
    import resource

    task = json.load(sys.stdin)
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what the student prints
    torch.set_num_threads(1)
    if sys.platform.startswith("linux"):  # macOS has no such limit
        most = int(task["memory_mb"]) << 20
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    for name, cells in task["cells"].items():
        signal.setitimer(signal.ITIMER_REAL, task["seconds"])  # its signal ends the process
        verdict = _judge(name, [Cell(*cell) for cell in cells])
        signal.setitimer(signal.ITIMER_REAL, 0)
        answers.write(json.dumps(asdict(verdict)) + "\n")


def _judge(name: str, cells: Sequence[Cell]) -> Verdict:
    namespace: dict[str, Any] = vars(types.ModuleType("__main__"))
    torch.manual_seed(0)
    try:
        with use_backend("reference"):
            _define(cells, name, namespace)
            return exercises()[name].verdict(namespace[name])
    except Failed as e:
        return Verdict(exercise=name, state="failed", prop=e.prop, detail=e.detail)


def _define(
    cells: Sequence[Cell],
    name: str,
    namespace: dict[str, Any],
) -> None:
    for cell, node in needed(cells, name):
        linecache.cache[cell.label] = (
            len(cell.source),
            None,
            cell.source.splitlines(keepends=True),
            cell.label,
        )
        try:
            exec(
                compile(ast.Module(body=[node], type_ignores=[]), cell.label, "exec"),
                namespace,
            )
        except Exception as e:
            detail = f"line {node.lineno} of {cell.label} raised {type(e).__name__}: {e}"
            raise Failed("the lines that it needs run", "", detail) from None


if __name__ == "__main__":
    main()
