"""The optimisation over the keyframes after the scan, one step at a time, each all of it or
nothing."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..interrupts import DelayedInterrupt
from .lost_rows import remove_lost
from .step_report import GlobalStep
from .usual_torch import usual_torch


class KeyframePasses:
    """Each pass visits all keyframes once, in a new random order."""

    def __init__(self):
        self.done = 0
        """Number of finished passes."""
        self.queue: list[int] = []
        """Keyframes that the current pass has not visited yet."""

    @property
    def begun(self) -> bool:
        """Whether at least one keyframe was visited."""
        return self.done > 0 or len(self.queue) > 0

    def run(
        self,
        passes: int,
        n_keyframes: int,
        generator: torch.Generator,
        optimise: Callable[[int], Float[Tensor, ""]],
    ) -> Iterator[GlobalStep]:
        """Visit every keyframe ``passes`` times; ``optimise(i)`` takes one step on the i-th and
        returns its loss.

        A pass that was interrupted is finished first and counts as one of them.
        """
        begun = len(self.queue) > 0
        n_steps = (passes - begun) * n_keyframes + len(self.queue)
        step = 0
        for pass_index in range(passes if n_keyframes else 0):
            if not self.queue:
                self.queue = torch.randperm(n_keyframes, generator=generator).tolist()
            while self.queue:
                loss = optimise(self.queue.pop(0))
                step += 1
                self.done += not self.queue
                yield GlobalStep(pass_index=pass_index, step=step, n_steps=n_steps, loss_value=loss)

    def state_dict(self) -> dict[str, Any]:
        """The state of the passes."""
        return {"done": self.done, "queue": list(self.queue)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.done = state["done"]
        self.queue = list(state["queue"])


class AfterScan:
    """The passes of a mapper over its keyframes; ``Mapper.global_optimise``.

    Args:
        mapper: The ``Mapper``.
    """

    def __init__(self, mapper: Any):
        self._mapper = mapper
        self._n_frames_ready = -1
        """Number of frames after which the trajectory was last made ready for the passes."""

    def steps(self, passes: int) -> Iterator[GlobalStep]:
        """Each of the steps of ``passes`` passes."""
        steps = self._steps(passes)
        while (step := self._whole_step(steps)) is not None:
            yield step

    def _steps(self, passes: int) -> Iterator[GlobalStep]:
        mapper = self._mapper
        n_keyframes = len(mapper.keyframes)
        yield from mapper.passes.run(passes, n_keyframes, mapper.random.passes, self._watched_step)
        mapper.parts.take_missed_steps()

    def _whole_step(self, steps: Iterator[GlobalStep]) -> GlobalStep | None:
        """The next step, all of it or nothing; None: there are no more. Ctrl-C takes effect after
        it."""
        mapper = self._mapper
        with DelayedInterrupt(), usual_torch():
            if not mapper.passes.begun and self._n_frames_ready != mapper.n_frames:
                self._make_ready()
            with mapper.transaction.step_after_scan():
                step = next(steps, None)
            mapper.transaction.keep()
            return step

    def _make_ready(self) -> None:
        mapper = self._mapper
        mapper.lost.begin_frame()
        mapper.parts.take_missed_steps()
        mapper.localiser.finish()
        self._n_frames_ready = mapper.n_frames

    def _watched_step(self, i: int) -> Float[Tensor, ""]:
        mapper = self._mapper
        mapper.parts.forget()
        with mapper.watch(None):
            loss = mapper._global_step(i)
            if not mapper.passes.queue:
                remove_lost(mapper)
            return loss
