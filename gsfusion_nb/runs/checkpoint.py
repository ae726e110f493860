"""Checkpoints of a run: when they are saved, and what they hold besides the maps."""

import json
import logging
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..files import DiskFullError
from ..mapping import Mapper, StepReport

log = logging.getLogger(__name__)

NOT_SAVED = "this checkpoint could not be saved: %s; the last one is kept, and the run continues"
MAX_SHARE = 0.03
"""Checkpoints at time intervals take at most this share of the run: after a slow one, the next is saved later."""
BLOCK = 256
"""Number of steps that are packed together."""


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
        return {"blocks": list(self.blocks), "rest": packed([vars(step) for step in steps[BLOCK * len(self.blocks) :]])}

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
        "numpy": [name, torch.from_numpy(np.asarray(keys).astype(np.int64)), position, has_gauss, gauss],
        "python": [version, torch.tensor(words, dtype=torch.int64), json.dumps(next_gauss)],
    }


def load_random_state(state: dict[str, Any]) -> None:
    """Set the generators to what ``random_state`` returned."""
    torch.set_rng_state(state["torch"].cpu())
    if state["torch_cuda"] and torch.cuda.is_available() and len(state["torch_cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([s.cpu() for s in state["torch_cuda"]])
    name, keys, *rest = state["numpy"]
    np.random.set_state((name, keys.cpu().numpy().astype(np.uint32), *rest))  # noqa: NPY002
    version, words, next_gauss = state["python"]
    random.setstate((version, tuple(words.tolist()), json.loads(next_gauss)))
