"""Wall time of the stages of a frame, without that of compiling kernels."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from ..backends import observing
from ..compile_clock import working_time


class StageClock:
    """Adds up wall time by stage name: ``with clock("tsdf"): ...``."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = working_time()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + working_time() - start

    @contextlib.contextmanager
    def operation(self, name: str, *, of: str) -> Iterator[None]:
        """Context in which the time of an operation counts as a stage of its own, not as part of
        stage ``of``."""
        seconds = 0.0

        def time_calls(called: str, f: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
            nonlocal seconds
            start = working_time()
            try:
                return f(*args, **kwargs)
            finally:
                seconds += working_time() - start if called == name else 0.0

        try:
            with observing(time_calls, alone=False):
                yield
        finally:
            self.seconds[of] = self.seconds.get(of, 0.0) - seconds
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
