"""How much time and memory one exercise of one submission may take."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Of one exercise of one submission."""

    seconds: float = 30.0
    """Processor time for its function, all calls together, so that a busy machine changes no mark."""
    memory_mb: int = 1024
    """Beyond what Python, torch and this package take."""

    @property
    def cpu_s(self) -> int:
        """``seconds`` as the system limits them."""
        return max(1, math.ceil(self.seconds))

    @property
    def wall_s(self) -> float:
        """How long an answer is waited for, which ends a function that sleeps."""
        return 30.0 + 4.0 * self.seconds
