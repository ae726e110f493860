"""The folder of a run: locked while the run writes to it, with a file that says how the run stands."""

import contextlib
import datetime
import json
import os
import platform
from pathlib import Path
from typing import Any

from .. import __version__
from ..files import try_lock, write_file
from ..strict_json import read_json

STATUS = "status.json"
LOCK = ".lock"
CHECKPOINTS = "checkpoint"
"""Folder of the checkpoints in a run's folder."""


class RunFolder:
    """A run's folder, as a context manager: no second run writes to it inside the block.

    The operating system frees the lock when its holder ends, however it ends. ``taken_over`` is then a sentence about
    the run that was cut off; else it is empty.

    Args:
        path: The folder; it is made.

    Raises:
        FileExistsError: on entering: another run is writing to the folder; the message names its process.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.taken_over = ""
        self._handle = -1
        self._known: dict[str, Any] = {}

    def __enter__(self) -> "RunFolder":
        self.path.mkdir(parents=True, exist_ok=True)
        status = read_status(self.path)
        if not self._lock() and not _is_dead(status):
            raise FileExistsError(f"{self.path} is in use: {_who(status)} is writing to it; wait until it has ended")
        if status.get("state") == "running":
            self.taken_over = f"{_who(status)} was interrupted; its run continues from the last checkpoint"
        return self

    def __exit__(self, *_: object) -> None:
        if self._handle >= 0:
            with contextlib.suppress(PermissionError):  # Windows: not while it is open
                (self.path / LOCK).unlink(missing_ok=True)
            os.close(self._handle)
            self._handle = -1
            with contextlib.suppress(OSError):
                if os.name == "nt":
                    (self.path / LOCK).unlink(missing_ok=True)

    def write_status(self, state: str, progress: dict[str, Any], **known: Any) -> None:
        """Say how the run stands: "running", "complete", "interrupted", "stopped" or "failed", and how far it is.

        ``known`` (system, settings, source) is kept for the calls that follow.
        """
        self._known |= known
        now = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
        self._known.setdefault("started", now)
        document = {"state": state, "updated": now, "progress": progress, "gsfusion_nb": __version__}
        write_file(self.path / STATUS, json.dumps(document | _this_process() | self._known, indent=1))

    def _lock(self) -> bool:
        """Lock the folder, unless another process holds it."""
        path = self.path / LOCK
        while True:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            if not try_lock(handle):
                os.close(handle)
                return False
            if _is_same(path, handle):
                self._handle = handle
                return True
            os.close(handle)  # its holder removed it meanwhile


def new_folder(name: str, folder: Path | str | None = None) -> Path:
    """Make the folder of a run: ``folder``, which must be new or empty, or ``runs/<name>-<date>-<time>``."""
    if folder is None:
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        path = Path("runs") / f"{name}-{stamp}"
        n = 1
        while path.exists():
            n += 1
            path = Path("runs") / f"{name}-{stamp}-{n}"
    else:
        path = Path(folder).expanduser()
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            _refuse(path)
    path.mkdir(parents=True, exist_ok=True)
    return path


def _refuse(path: Path) -> None:
    """Raise ``FileExistsError``: something is at ``path``, perhaps a run that is going on, or was cut off.

    A run that was cut off before its first checkpoint left nothing that is worth anything: its files are removed.
    """
    if (path / STATUS).is_file():
        with RunFolder(path):  # says who, if another run is writing to it
            if _holds_nothing(path):
                for file in [*(path / CHECKPOINTS).glob("*"), path / STATUS, *path.glob(".*.partial*")]:
                    file.unlink()
                return
    hint = f"; to continue the run in it: gsfusion-nb map --resume {path}" if (path / CHECKPOINTS).is_dir() else ""
    raise FileExistsError(f"{path} must be a new or empty folder, so that no earlier run is overwritten{hint}")


def _holds_nothing(path: Path) -> bool:
    """Nothing is in the folder but what a run writes before its first checkpoint."""
    names = {p.name for p in path.iterdir() if not (p.name.startswith(".") and ".partial" in p.name)}
    return names <= {STATUS, LOCK, CHECKPOINTS} and not any((path / CHECKPOINTS).glob("*.json"))


def read_status(folder: Path) -> dict[str, Any]:
    """What status.json says; empty if there is none, or it is unreadable."""
    try:
        status = read_json(folder / STATUS, "the status of a run", at_most=1_000_000)
    except (OSError, ValueError):
        return {}
    return status if isinstance(status, dict) else {}


def _this_process() -> dict[str, Any]:
    return {"pid": os.getpid(), "host": platform.node(), "boot": _boot(), "process_start": _start_of(os.getpid())}


def _is_dead(status: dict[str, Any]) -> bool:
    """The process that wrote the status has certainly ended: on this host, since another boot or start, or is gone."""
    pid = status.get("pid")
    if status.get("host") != platform.node() or not isinstance(pid, int) or not Path("/proc/self/stat").exists():
        return False
    return status.get("boot") != _boot() or status.get("process_start") != _start_of(pid)


def _start_of(pid: int) -> int | None:
    """When a process started, clock ticks since boot: a process id that is used again has another."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        return None


def _boot() -> str:
    """A name for the time since this machine was started."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def _who(status: dict[str, Any]) -> str:
    if "pid" not in status:
        return "another process"
    return f"process {status['pid']} on {status.get('host')} (run started {status.get('started')})"


def _is_same(path: Path, handle: int) -> bool:
    """The open file is the one at ``path``."""
    try:
        there, here = path.stat(), os.fstat(handle)
    except OSError:
        return False
    return (there.st_ino, there.st_dev) == (here.st_ino, here.st_dev)
