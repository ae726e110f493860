"""Checkpoints saved at intervals during a run."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from ..files import DiskFullError
from ..mapping import Mapper

log = logging.getLogger(__name__)

MAX_SHARE = 0.03
"""Checkpoints at time intervals take at most this share of the run: after a slow one, the next is saved later."""


@dataclass(frozen=True, kw_only=True)
class CheckpointEvery:
    """How often a run saves a checkpoint. If both are 0, only when it is interrupted."""

    seconds: float | int = 30.0
    """Time between two checkpoints; longer if saving one takes more than 3 % of it. 0: not by time."""
    frames: int = 0
    """Frames, or views of the optimisation after the scan, between two checkpoints. 0: not by frames."""

    def __post_init__(self):
        if self.seconds < 0 or self.frames < 0:
            raise ValueError(
                f"the interval of checkpoints must be at least 0 s and 0 frames, got {self.seconds} s and "
                f"{self.frames} frames"
            )


class Autosave:
    """Called after every step of a run; saves a checkpoint when one is due. It does not change the run.

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
        self._mapper, self._save, self._every, self._clock = mapper, save, every, clock
        self._next_s, self._steps = clock() + every.seconds, 0
        self.n_saved = 0
        self.seconds = 0.0
        """Total time spent on checkpoints."""

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
            log.warning("this checkpoint could not be saved: %s; the last one is kept, and the run continues", e)
        took = self._clock() - began
        self.seconds += took
        self._next_s = began + took + max(self._every.seconds, took / MAX_SHARE)
