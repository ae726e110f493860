"""The sandbox's program: waits for tasks, forks a process for each, and lets the submission's function be called.

``grading/isolated.py`` starts it with an installation without solutions. It gets a socket
for each task over the control socket. Only the forked process runs the submission's code, and gives up files, other
processes and the network first.
"""

import importlib
import json
import os
import socket
from pathlib import Path
from typing import Any

import torch

from . import confinement, landlock
from .task import run_task

_READY = ("gsfusion_nb.seeding", "gsfusion_nb.mapping", "gsfusion_nb.tracking", "gsfusion_nb.teaching.wall")
"""Imported before the first task, so that a task begins at once."""


def main(control_fd: int, settings_json: str) -> None:
    """Serve tasks until the control socket is closed.

    Args:
        control_fd: A socket: gets ``b"f"`` with a task's socket and answers with a process; gets ``b"w"`` and answers
            when that process has ended, with the signal that ended it, or 0.
        settings_json: ``readable``, ``listed`` (paths), ``memory_bytes`` and ``cpu_s``.
    """
    settings = json.loads(settings_json)
    control = socket.socket(fileno=control_fd)
    torch.set_num_threads(1)
    for name in _READY:
        importlib.import_module(name)
    quiet = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(quiet, stream)
    readable, listed = ([Path(p) for p in settings[key]] for key in ("readable", "listed"))
    ruleset = landlock.rules(readable, listed, [Path(os.devnull)]) if landlock.version() else -1
    control.sendall(bytes([landlock.version()]))
    running = 0
    while True:
        word, fds, _, _ = socket.recv_fds(control, 1, 1)
        if not word:
            return
        if word == b"w":
            _, status = os.waitpid(running, 0)
            control.sendall(bytes([os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0]))
            continue
        running = os.fork()
        if running == 0:
            control.close()
            line = socket.socket(fileno=fds[0])
            _become_sandbox(ruleset, settings)
            run_task(line)
            os._exit(0)
        os.close(fds[0])
        control.sendall(running.to_bytes(8, "big"))


def _become_sandbox(ruleset: int, settings: dict[str, Any]) -> None:
    os.setsid()
    confinement.limit(settings["memory_bytes"], settings["cpu_s"])
    if ruleset >= 0:
        landlock.restrict(ruleset)
        os.close(ruleset)
    confinement.refuse(settings["readable"])
