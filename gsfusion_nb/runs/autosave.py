"""Checkpoints while a run goes on."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from ..files import DiskFullError
from ..mapping import Mapper

log = logging.getLogger(__name__)

MAX_SHARE = 0.03
"""Checkpoints by time take at most this share of it: after one that took long, the next comes later."""


@dataclass(frozen=True, kw_only=True)
class CheckpointEvery:
    """How often a run saves where it stands. Both 0: only when it is interrupted."""

    seconds: float | int = 30.0
    """Time between two checkpoints; more if one takes more than 3 % of it."""
    frames: int = 0
    """Frames, or views of the optimisation after the scan, between two checkpoints."""

    def __post_init__(self):
        if self.seconds < 0 or self.frames < 0:
            raise ValueError(f"checkpoints come every 0 or more seconds or frames, got {self.seconds}, {self.frames}")


class Autosave:
    """Called after every step of a run; saves a checkpoint when one is due. It changes nothing in the run.

    Args:
        mapper: Nothing is saved while it holds half a frame.
        save: Saves a checkpoint.
        every: How often.
        clock: Seconds.
    """

    def __init__(
        self,
        mapper: Mapper,
        save: Callable[[], None],
        every: CheckpointEvery,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._mapper, self._save, self._every, self._clock = mapper, save, every, clock
        self._next_s, self._steps = clock() + every.seconds, 0
        self.n_saved = 0
        self.seconds = 0.0
        """Time that all checkpoints took."""

    def __call__(self) -> None:
        self._steps += 1
        every = self._every
        due = (every.frames and self._steps >= every.frames) or (every.seconds and self._clock() >= self._next_s)
        if due and not self._mapper.guard.half_mapped:
            self._steps = 0
            self._take()

    def _take(self) -> None:
        began = self._clock()
        try:
            self._save()
            self.n_saved += 1
        except DiskFullError as e:
            log.warning("no checkpoint now: %s; the last one is kept, and the run continues", e)
        took = self._clock() - began
        self.seconds += took
        self._next_s = began + took + max(self._every.seconds, took / MAX_SHARE)
