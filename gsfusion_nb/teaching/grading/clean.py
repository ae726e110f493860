"""An installation of the package from which the solutions are left out: what a submission can import."""

import shutil
import site
import sys
import sysconfig
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

_HARMLESS = ("attempt.py", "guard.py", "place.py", "wall.py", "sandbox")
"""Of ``gsfusion_nb/teaching``: what the sandbox itself needs."""
_SYSTEM = (
    "/lib", "/lib64", "/usr/lib", "/usr/lib64", "/usr/share/zoneinfo", "/etc/ld.so.cache", "/dev/urandom",
    "/proc/meminfo", "/proc/cpuinfo", "/sys/fs/cgroup",
)  # fmt: skip
"""Of the system: libraries, and how much memory there is."""


def write_clean_copy(folder: Path) -> None:
    """Copy the package into ``folder``, with ``sandbox/stand_in.py`` in place of ``gsfusion_nb.teaching``.

    The solved notebooks, which a wheel puts into the package, are left out.
    """
    package = package_folder()
    leave_out = shutil.ignore_patterns("*.nbi", "*.nbc", "teaching", "notebooks", "docs")
    copy = folder / "gsfusion_nb"
    shutil.copytree(package, copy, ignore=leave_out)
    if not (copy / "kernels").exists():
        shutil.copytree(_kernels_folder(), copy / "kernels", ignore=leave_out)
    (copy / "teaching").mkdir()
    for name in _HARMLESS:
        source = package / "teaching" / name
        if source.is_dir():
            shutil.copytree(source, copy / "teaching" / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, copy / "teaching" / name)
    shutil.copy2(package / "teaching" / "sandbox" / "stand_in.py", copy / "teaching" / "__init__.py")


def import_path(folder: Path) -> list[str]:
    """``sys.path`` of the sandbox: the clean copy, then Python's own folders and those of installed packages."""
    own = (*site.getsitepackages(), site.getusersitepackages())
    names = ("site-packages", "dist-packages", "lib-dynload")
    kept = [
        p for p in sys.path if p in own or Path(p).name in names or Path(p).name.startswith("python3")
    ]  # fmt: skip
    return [str(folder), *kept]


def readable_paths(folder: Path) -> tuple[list[str], list[str]]:
    """What a submission may read, and folders whose names it may read: the rest of Python, never the real package."""
    hidden = frozenset(p.resolve() for p in (package_folder(), _kernels_folder()))
    standard = [sysconfig.get_paths()[key] for key in ("stdlib", "platstdlib")]
    wanted = [Path(p).resolve() for p in (*import_path(folder), *standard, *_SYSTEM)]
    wanted = [p for p in dict.fromkeys(wanted) if p.exists()]
    listed = [p for p in wanted if p.is_dir()]
    return [str(p) for root in wanted for p in _without(root, hidden)], [str(p) for p in listed]


def package_folder() -> Path:
    """Where the package is installed."""
    spec = find_spec("gsfusion_nb")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).resolve().parent


def _kernels_folder() -> Path:
    spec = find_spec("gsfusion_nb.kernels")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).resolve().parent


def _without(folder: Path, hidden: frozenset[Path]) -> Iterator[Path]:
    """``folder``, or, if something hidden is inside, all that is in it and is not hidden."""
    if not any(folder == h or folder in h.parents for h in hidden):
        yield folder
    elif folder not in hidden:
        for inner in sorted(folder.iterdir()):
            yield from _without(inner.resolve(), hidden)
