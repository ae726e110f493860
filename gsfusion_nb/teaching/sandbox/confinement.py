"""What a process gives up before a submission runs in it: files, other processes, the network, memory and time.

Two guards: Landlock, where the kernel has it, which nothing in the process can lift; and a hook of Python's audit
events (PEP 578), everywhere, whose refusals are sentences.
"""

import contextlib
import os
import resource
import sys
from pathlib import Path
from typing import Any

_NO_PROCESSES = (
    "os.fork", "os.forkpty", "os.exec", "os.posix_spawn", "os.spawn", "os.system", "os.startfile", "subprocess.Popen",
    "pty.spawn", "os.kill", "os.killpg",
)  # fmt: skip
_NO_CHANGES = (
    "os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.chmod", "os.chown", "os.link", "os.symlink", "os.truncate",
    "os.utime", "shutil.rmtree", "shutil.move", "shutil.copyfile", "tempfile.mkstemp", "tempfile.mkdtemp",
)  # fmt: skip
_READS = ("open", "os.listdir", "os.scandir")


def limit(memory_bytes: int, cpu_s: int) -> None:
    """Limits of this process: memory beyond what it has now, processor time (SIGXCPU ends it), no files, no core
    dump."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform.startswith("linux") else 0
    most = pages * resource.getpagesize() + memory_bytes
    for kind, value in (("AS", most), ("CPU", cpu_s), ("CORE", 0), ("FSIZE", 0)):
        with contextlib.suppress(ValueError, OSError):  # macOS does not limit the address space
            resource.setrlimit(getattr(resource, f"RLIMIT_{kind}"), (value, value + (kind == "CPU")))


def refuse(readable: list[str]) -> None:
    """From now on Python code in this process may read only files in ``readable`` folders, and start nothing."""
    roots = tuple(readable)
    real, as_text = os.path.realpath, os.fsdecode
    no_processes, no_changes, reads = frozenset(_NO_PROCESSES), frozenset(_NO_CHANGES), frozenset(_READS)
    inside = False

    def hook(event: str, args: tuple[Any, ...]) -> None:
        nonlocal inside
        if event in no_processes:
            raise PermissionError(f"a submission may not start or end processes ({event})")
        if event.startswith(("socket.", "ctypes.dlopen", "ctypes.dlsym")):
            raise PermissionError(f"a submission may not use the network or load libraries ({event})")
        if event in no_changes:
            raise PermissionError(f"a submission may not change files ({event})")
        if event in reads and not inside and args and isinstance(args[0], (str, bytes, os.PathLike)):
            writes = event == "open" and isinstance(args[1], str) and set(args[1]) & set("wax+")
            inside = True
            try:
                path = real(as_text(args[0]))
            finally:
                inside = False
            if path == os.devnull:
                return
            if writes or not any(path == root or path.startswith(root + os.sep) for root in roots):
                raise PermissionError(f"a submission may not open {path}")

    sys.addaudithook(hook)
