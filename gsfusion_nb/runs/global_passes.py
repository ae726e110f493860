"""The optimisation of a run over its keyframes after the scan: its steps, their losses and time."""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from ..compile_clock import working_time
from ..interrupts import DelayedInterrupt
from ..mapping import FrameUndone, GlobalStep, Mapper
from .run_clock import RunClock
from .run_warnings import RunWarnings


class GlobalPasses:
    """The passes of one run, which can be interrupted between any two steps and saved.

    Args:
        mapper: The mapper of the run.
        clock: Of the run.
        warnings: Of the run.
    """

    def __init__(self, mapper: Mapper, clock: RunClock, warnings: RunWarnings):
        self.losses: list[float] = []
        """Mean loss of each finished pass."""
        self.seconds = 0.0
        """Time of all steps, without that of compiling."""
        self.is_finished = False
        self._mapper = mapper
        self._clock = clock
        self._warnings = warnings
        self._step_losses: list[Tensor] = []
        """Loss of each step of the pass that is not finished."""

    def steps(self) -> Iterator[GlobalStep]:
        """Take the remaining steps, continuing an interrupted pass.

        It ends early if a step was undone because ``mapper.guard.stop_wanted`` asks for it.
        """
        mapper = self._mapper
        steps = mapper.global_optimise(mapper.n_passes - mapper.passes.done)
        n_lost = mapper.lost.total
        has_warned = False
        try:
            while (step := self._next_step(steps)) is not None:
                if mapper.lost.total > n_lost and not mapper.passes.queue and not has_warned:
                    name = f"pass {mapper.passes.done} over the keyframes"
                    self._warnings.warn(mapper.lost.in_words(name))
                    has_warned = True
                yield step
        except FrameUndone:  # the run is asked to stop
            return

    def _next_step(self, steps: Iterator[GlobalStep]) -> GlobalStep | None:
        """Take a step and count it, or note that there are no more; Ctrl-C takes effect after
        both."""
        start = working_time()
        with DelayedInterrupt(), self._clock("passes"):
            step = next(steps, None)
            if step is None:
                self.is_finished = True
                return None
            self._step_losses.append(step.loss_value)
            if not self._mapper.passes.queue:
                self.losses.append(float(torch.stack(self._step_losses).mean()))
                self._step_losses = []
            self.seconds += working_time() - start
            return step

    def state_dict(self) -> dict[str, Any]:
        """Losses and time so far, as tensors and plain values."""
        losses = self._step_losses
        return {
            "global_losses": list(self.losses),
            "pass_losses": torch.stack(losses) if losses else torch.zeros(0),
            "seconds_global": self.seconds,
            "is_optimised": self.is_finished,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.losses = list(state["global_losses"])
        self._step_losses = list(state["pass_losses"].to(self._mapper.device))
        self.seconds = state["seconds_global"]
        self.is_finished = state["is_optimised"]
