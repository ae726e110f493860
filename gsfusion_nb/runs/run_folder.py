"""The folder of a run: locked while the run writes to it, with a file that gives the run's status."""

import contextlib
import datetime
import json
import os
import platform
from pathlib import Path
from typing import Any

from .. import __version__
from ..files import remove_partial, try_lock, write_file
from ..foreign import read_json, read_object

STATUS = "status.json"
LOCK = ".lock"
METRICS = "metrics.json"
RULE = "rule.py"
"""Source of the seeding rule, if it is not part of this package."""
CHECKPOINTS = "checkpoint"
"""Folder of the checkpoints in a run's folder."""


class RunFolder:
    """A run's folder, as a context manager: no second run writes to it inside the block.

    The operating system releases the lock when the process ends, even if it is killed. If an earlier run in the folder
    was cut off, ``taken_over`` is a sentence about it; otherwise it is empty.

    Args:
        path: The folder; it is created.

    Raises:
        FileExistsError: On entering, if another run is writing to the folder; the message names its process.
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
        for folder in (self.path, self.path / CHECKPOINTS):
            remove_partial(folder)
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
        """Write the state ("running", "complete", "interrupted", "stopped" or "failed") and progress of the run.

        ``known`` (system, settings, source) is remembered and written again by later calls.
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
    """Create the folder of a run: ``folder``, which must be new or empty, or ``runs/<name>-<date>-<time>``."""
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
    """Raise ``FileExistsError``, because ``path`` is not empty; perhaps it holds a run that is running or interrupted.

    The files of a run that ended before its first checkpoint are removed instead: nothing in them can be used.
    """
    if (path / STATUS).is_file():
        with RunFolder(path):  # raises, with the process, if another run is writing to it
            if holds_nothing(path):
                for file in [*(path / CHECKPOINTS).glob("*"), path / STATUS, path / RULE]:
                    file.unlink(missing_ok=True)
                return
    resumable = any((path / CHECKPOINTS).glob("*.json"))
    hint = f"; to continue the run in it: gsfusion-nb map --resume {path}" if resumable else ""
    raise FileExistsError(f"{path} must be a new or empty folder, so that no earlier run is overwritten{hint}")


def holds_nothing(path: Path) -> bool:
    """Whether the folder holds only what a run writes before its first checkpoint."""
    names = {p.name for p in path.iterdir()}
    return names <= {STATUS, LOCK, RULE, CHECKPOINTS} and not any((path / CHECKPOINTS).glob("*.json"))


def read_status(folder: Path) -> dict[str, Any]:
    """Contents of status.json; empty if it is missing or unreadable."""
    try:
        status = read_json(folder / STATUS, "the status of a run", at_most=1_000_000)
    except (OSError, ValueError):
        return {}
    return status if isinstance(status, dict) else {}


def is_complete(folder: Path) -> bool:
    """Whether the run in ``folder`` is complete: scored, and all files written, of which metrics.json is the last.

    Raises:
        ValueError: metrics.json is damaged.
    """
    path = folder / METRICS
    return path.is_file() and read_object(path, "the numbers of a run").get("status") == "complete"


def _this_process() -> dict[str, Any]:
    return {"pid": os.getpid(), "host": platform.node(), "boot": _boot(), "process_start": _start_of(os.getpid())}


def _is_dead(status: dict[str, Any]) -> bool:
    """Whether the process that wrote the status, on this machine, has certainly ended."""
    pid = status.get("pid")
    if status.get("host") != platform.node() or not isinstance(pid, int) or not Path("/proc/self/stat").exists():
        return False
    return status.get("boot") != _boot() or status.get("process_start") != _start_of(pid)


def _start_of(pid: int) -> int | None:
    """Start time of a process, clock ticks since boot; it differs if a process id is used again. None if unknown."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        return None


def _boot() -> str:
    """An id that changes with every start of this machine; empty if unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def _who(status: dict[str, Any]) -> str:
    if "pid" not in status:
        return "another process"
    return f"process {status['pid']} on {status.get('host')} (run started {status.get('started')})"


def _is_same(path: Path, handle: int) -> bool:
    """Whether the open file is the one at ``path``."""
    try:
        there, here = path.stat(), os.fstat(handle)
    except OSError:
        return False
    return (there.st_ino, there.st_dev) == (here.st_ino, here.st_dev)
