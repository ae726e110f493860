"""A run's folder: its lock, when checkpoints are saved, and how a run is stopped without losing
data."""

import contextlib
import datetime
import itertools
import json
import logging
import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import ArgumentError, DiskFullError
from ..files import read_object, remove_partial, try_lock
from ..mapping import Mapper, StepReport
from ..seeding.code_files import RULE_MODULES, SYSTEM_MODULES

LOCK = ".lock"
METRICS = "metrics.json"
RULE = "rule.py"
"""Source of the seeding rule, if it is not part of this package."""
SYSTEM = "system.py"
"""Source of the system, if it came from a file."""
CHECKPOINTS = "checkpoint"
"""Folder of the checkpoints in a run's folder: all of a run's state."""


class RunFolder:
    """A run's folder, as a context manager: no second run writes to it inside the block.

    The operating system releases the lock when the process ends, even if it is killed.

    Args:
        path: The folder; it is created.

    Raises:
        FileExistsError: On entering, if another run is writing to the folder.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def __enter__(self) -> "RunFolder":
        self.path.mkdir(parents=True, exist_ok=True)
        self._handle = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        if not try_lock(self._handle):
            os.close(self._handle)
            raise FileExistsError(
                f"{self.path} is in use: another run is writing to it; wait until it has ended"
            )
        for folder in (self.path, self.path / CHECKPOINTS):
            remove_partial(folder)
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._handle)


def new_folder(name: str, folder: Path | str | None = None) -> Path:
    """Create the folder of a run: ``folder``, which must be new or empty, or
    ``runs/<name>-<date>-<time>``.

    What a run leaves that ended before its first checkpoint counts as empty: nothing in it can be
    used.

    Raises:
        FileExistsError: The folder holds files, perhaps of a run that is running or interrupted.
    """
    if folder is None:
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        places = (
            Path("runs") / f"{name}-{stamp}{'' if n == 1 else f'-{n}'}" for n in itertools.count(1)
        )
        path = next(place for place in places if not place.exists())
    else:
        path = Path(folder).expanduser()
        if path.is_file() or (path.is_dir() and not holds_nothing(path)):
            resumable = any((path / CHECKPOINTS).glob("*.json"))
            hint = (
                f"; to continue the run in it: gsfusion-nb map --resume {path}" if resumable else ""
            )
            raise FileExistsError(
                f"{path} must be a new or empty folder, so that no earlier run is overwritten{hint}"
            )
    path.mkdir(parents=True, exist_ok=True)
    return path


def holds_nothing(path: Path) -> bool:
    """Whether the folder holds only what a run writes before its first checkpoint."""
    names = {p.name for p in path.iterdir() if ".partial" not in p.name}
    code = {RULE, RULE_MODULES, SYSTEM, SYSTEM_MODULES}
    return names <= {LOCK, CHECKPOINTS, *code} and not any((path / CHECKPOINTS).glob("*.json"))


def is_complete(folder: Path) -> bool:
    """Whether the run in ``folder`` is complete: scored, and all files written, of which
    metrics.json is the last.

    Raises:
        ValueError: metrics.json is damaged.
    """
    path = folder / METRICS
    return path.is_file() and read_object(path, "the numbers of a run").get("status") == "complete"


log = logging.getLogger(__name__)

NOT_SAVED = "this checkpoint could not be saved: %s; the last one is kept, and the run continues"
MAX_SHARE = 0.03
"""Checkpoints at time intervals take at most this share of the run: after a slow one, the next is
saved later."""
BLOCK = 256
"""Number of steps that are packed together."""


@dataclass(frozen=True, kw_only=True)
class CheckpointEvery:
    """How often a run saves a checkpoint. If both are 0, only when it is interrupted."""

    seconds: float | int = 30.0
    """Time between two checkpoints; longer if saving one takes more than 3 % of it. 0: not by
    time."""
    frames: int = 0
    """Frames, or views of the optimisation after the scan, between two checkpoints. 0: not by
    frames."""

    def __post_init__(self):
        if self.seconds < 0 or self.frames < 0:
            raise ArgumentError(
                "the interval of checkpoints must be at least 0 s and 0 frames, got "
                f"{self.seconds} s and {self.frames} frames"
            )


class Autosave:
    """Called after every step of a run; saves a checkpoint when one is due. It does not change the
    run.

    Args:
        mapper: Nothing is saved while a frame is only partly in its map.
        save: Saves a checkpoint.
        every: How often to save.
        clock: Returns the time in seconds.
    """

    def __init__(
        self,
        mapper: Mapper,
        save: Callable[[], None],
        every: CheckpointEvery,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._mapper = mapper
        self._save = save
        self._every = every
        self._clock = clock
        self._next_s = clock() + every.seconds
        self._steps = 0
        self.n_saved = 0
        self.seconds = 0.0
        """Total time spent on checkpoints."""

    def __call__(self) -> None:
        self._steps += 1
        every = self._every
        due = (every.frames and self._steps >= every.frames) or (
            every.seconds and self._clock() >= self._next_s
        )
        if due and not self._mapper.guard.half_mapped:
            self._steps = 0
            self._take()

    def _take(self) -> None:
        """Save a checkpoint; the next one is due later the longer this one took."""
        began = self._clock()
        try:
            self._save()
            self.n_saved += 1
        except DiskFullError as e:
            log.warning(NOT_SAVED, e)
        took = self._clock() - began
        self.seconds += took
        self._next_s = began + took + max(self._every.seconds, took / MAX_SHARE)


class StepLog:
    """Packs a list of reports that grows at its end."""

    def __init__(self):
        self.blocks: list[Tensor] = []
        """Full blocks; these tensors never change."""

    def state_dict(self, steps: list[StepReport]) -> dict[str, Any]:
        """All reports as tensors of bytes."""
        while len(steps) >= BLOCK * (len(self.blocks) + 1):
            at = BLOCK * len(self.blocks)
            self.blocks.append(packed([vars(step) for step in steps[at : at + BLOCK]]))
        return {
            "blocks": list(self.blocks),
            "rest": packed([vars(step) for step in steps[BLOCK * len(self.blocks) :]]),
        }

    def load_state_dict(self, state: dict[str, Any]) -> list[StepReport]:
        """The reports that ``state_dict`` packed."""
        self.blocks = list(state["blocks"])
        rows = [row for block in (*self.blocks, state["rest"]) for row in unpacked(block)]
        return [StepReport(**{**row, "losses": tuple(row["losses"])}) for row in rows]


def packed(value: Any) -> Tensor:
    """Plain values as a tensor of bytes: JSON."""
    return torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)


def unpacked(block: Tensor) -> Any:
    """What ``packed`` packed."""
    return json.loads(block.cpu().numpy().tobytes())


def random_state() -> dict[str, Any]:
    """States of the global generators of torch, numpy and Python."""
    name, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002
    version, words, next_gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "torch_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
        "numpy": [
            name,
            torch.from_numpy(np.asarray(keys).astype(np.int64)),
            position,
            has_gauss,
            gauss,
        ],
        "python": [version, torch.tensor(words, dtype=torch.int64), json.dumps(next_gauss)],
    }


def load_random_state(state: dict[str, Any]) -> None:
    """Set the generators to what ``random_state`` returned."""
    torch.set_rng_state(state["torch"].cpu())
    if (
        state["torch_cuda"]
        and torch.cuda.is_available()
        and len(state["torch_cuda"]) == torch.cuda.device_count()
    ):
        torch.cuda.set_rng_state_all([s.cpu() for s in state["torch_cuda"]])
    name, keys, *rest = state["numpy"]
    np.random.set_state((name, keys.cpu().numpy().astype(np.uint32), *rest))  # noqa: NPY002
    version, words, next_gauss = state["python"]
    random.setstate((version, tuple(words.tolist()), json.loads(next_gauss)))


class StopRequest:
    """Turns Ctrl-C, an interrupt of the notebook kernel or SIGTERM into a request to stop after the
    current step.

    A second signal has no effect for ``PATIENCE_S`` seconds; after that, or if ``at_once`` is set,
    a signal raises ``KeyboardInterrupt`` immediately. While files are written (``saving``) it never
    does.
    """

    PATIENCE_S = 5.0

    def __init__(self):
        self.wanted = False
        self.at_once = False
        """True while stopping at any point loses no data, as when views are scored."""
        self.saving = False
        self._since = 0.0

    def __bool__(self) -> bool:
        return self.wanted

    def _handle(self, signum, frame) -> None:
        first = not self.wanted
        self.wanted = True
        if first:
            self._since = time.monotonic()
        if self.saving:
            return
        if self.at_once or (not first and time.monotonic() - self._since > self.PATIENCE_S):
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def ending_at_once(self) -> Iterator[None]:
        """A block that a signal ends immediately, because nothing is lost; the code after it runs
        as usual."""
        self.at_once = True
        try:
            if not self.wanted:
                yield
        except KeyboardInterrupt:
            if not self.wanted:
                raise
        finally:
            self.at_once = False

    @contextlib.contextmanager
    def held_back(self) -> Iterator[None]:
        """A block that no signal interrupts, for writing files."""
        was_saving = self.saving
        self.saving = True
        try:
            yield
        finally:
            self.saving = was_saving

    @contextlib.contextmanager
    def listening(self) -> Iterator["StopRequest"]:
        """Catch signals inside the block; does nothing outside the main thread, where that is not
        possible."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        handlers = {
            number: signal.signal(number, self._handle)
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            yield self
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
