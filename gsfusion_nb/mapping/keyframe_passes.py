"""Passes over the keyframes after the scan, which can stop and continue at any keyframe."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_whole
from .step_report import GlobalStep


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
        self, passes: int, n_keyframes: int, generator: torch.Generator, optimise: Callable[[int], Float[Tensor, ""]]
    ) -> Iterator[GlobalStep]:
        """Visit every keyframe ``passes`` times; ``optimise(i)`` takes one step on the i-th and returns its loss.

        A pass that was interrupted is finished first and counts as one of them.
        """
        begun = len(self.queue) > 0
        n_steps, step = (passes - begun) * n_keyframes + len(self.queue), 0
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

    def load_state_dict(self, state: dict[str, Any], n_keyframes: int) -> None:
        """Restore what ``state_dict`` saved. Raises ``ValueError`` for keyframes beyond ``n_keyframes``."""
        check_whole("passes done", state["done"], 0)
        for i in state["queue"]:
            check_whole("keyframe in the queue", i, 0, n_keyframes - 1)
        self.done, self.queue = state["done"], list(state["queue"])
