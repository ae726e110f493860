"""Wall time of the stages of a frame."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from ..backends import also_observing


class StageClock:
    """Adds up wall time by stage name: ``with clock("tsdf"): ...``."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    @contextlib.contextmanager
    def operation(self, name: str, *, of: str) -> Iterator[None]:
        """Context in which the time of an operation counts as a stage of its own, not as part of
        stage ``of``."""
        seconds = 0.0

        def time_calls(called: str, f: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
            nonlocal seconds
            start = time.perf_counter()
            try:
                return f(*args, **kwargs)
            finally:
                seconds += time.perf_counter() - start if called == name else 0.0

        try:
            with also_observing(time_calls):
                yield
        finally:
            self.seconds[of] = self.seconds.get(of, 0.0) - seconds
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
