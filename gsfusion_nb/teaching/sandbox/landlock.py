"""Landlock (Linux 5.13 and newer): a process gives up files, for itself and all that it starts, without being root.

https://docs.kernel.org/userspace-api/landlock.html
"""

import ctypes
import os
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

_CREATE, _ADD, _RESTRICT = 444, 445, 446
_NO_NEW_PRIVILEGES = 38
_EXECUTE, _WRITE, _READ, _LIST = (1 << bit for bit in range(4))
_RIGHTS_OF_VERSION = {1: 13, 2: 14, 3: 15, 4: 15}
"""Version of Landlock -> number of rights to files that it knows; 16 since version 5."""


def version() -> int:
    """Version of Landlock in the running kernel; 0 where there is none."""
    if not sys.platform.startswith("linux"):
        return 0
    return max(0, ctypes.CDLL(None, use_errno=True).syscall(_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(1)))


def rules(readable: Iterable[Path], listed: Iterable[Path], written: Iterable[Path] = ()) -> int:
    """A set of rules: everything that is not named is refused; so are TCP and signals to other processes.

    Args:
        readable: Files, and folders with all that is in them.
        listed: Folders whose names may be read, also of folders in them.
        written: Files that may be written, such as /dev/null.

    Returns:
        A file descriptor for ``restrict``.

    Raises:
        OSError: the kernel has no Landlock.
    """
    libc, known = ctypes.CDLL(None, use_errno=True), version()
    rights = (1 << _RIGHTS_OF_VERSION.get(known, 16)) - 1
    attributes = struct.pack("=QQQ", rights, 3 if known >= 4 else 0, 3 if known >= 6 else 0)
    size = 8 if known < 4 else 16 if known < 6 else 24
    ruleset = libc.syscall(_CREATE, attributes, ctypes.c_size_t(size), ctypes.c_uint32(0))
    if ruleset < 0:
        raise OSError(ctypes.get_errno(), "no Landlock")
    wanted = [(p, _READ | _EXECUTE) for p in readable] + [(p, _LIST) for p in listed] + [(p, _WRITE) for p in written]
    for path, allowed in wanted:
        try:
            opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except OSError:
            continue
        if path.is_dir() and allowed & _READ:
            allowed |= _LIST
        rule = struct.pack("=Qi", allowed, opened)
        libc.syscall(_ADD, ctypes.c_int(ruleset), ctypes.c_int(1), rule, ctypes.c_uint32(0))
        os.close(opened)
    return ruleset


def restrict(ruleset: int) -> None:
    """Put this process under the rules, for ever.

    Raises:
        OSError: the kernel refuses.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.syscall(_RESTRICT, ctypes.c_int(ruleset), ctypes.c_uint32(0)):
        raise OSError(ctypes.get_errno(), "the rules were refused")
