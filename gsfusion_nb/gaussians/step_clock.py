"""The clock of the optimiser's steps: when each row began, and the last step in which it took
part."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from ..errors import ArgumentError
from ..types import ALL_ROWS, MapRows


@dataclass
class StepCount:
    """Steps of an optimiser so far, shared by all rows of a map."""

    value: int = 0


class StepClock:
    """The number of steps, and two numbers of each row. For every row  0 <= birth <= last <= count.

    A row that was left out of a step has ``last < count``: it misses steps, until it catches up.
    Its age, the t of Adam's bias correction, is ``count - birth``.

    Args:
        steps: The number of steps.
        birth: Value of the count when each row began. [R]
        last: Value of the count after the last step in which each row took part. [R]
    """

    def __init__(
        self,
        steps: StepCount,
        birth: Int[Tensor, " R"],
        last: Int[Tensor, " R"],
    ):
        self._steps = steps
        self.birth = birth
        self.last = last

    @classmethod
    def of_new_rows(cls, n: int, device: torch.device) -> "StepClock":
        """A clock at 0 for ``n`` rows."""
        birth, last = torch.zeros(2, n, dtype=torch.int32, device=device)
        return cls(StepCount(), birth, last)

    @property
    def count(self) -> int:
        """Steps so far."""
        return self._steps.value

    @property
    def steps_missed(self) -> Int[Tensor, " R"]:
        """Steps that each row misses."""
        return self.count - self.last

    @property
    def age_at_last(self) -> Int[Tensor, " R"]:
        """Age of each row after the last step in which it took part."""
        return self.last - self.birth

    def begin(self, rows: MapRows) -> None:
        """These rows begin now: they are new, or their moments were forgotten. They have age 0 and
        miss nothing."""
        self.birth[rows] = self.count
        self.last[rows] = self.count

    def step(self, rows: MapRows = ALL_ROWS) -> None:
        """One step is taken, in which these rows take part."""
        self._steps.value += 1
        self.catch_up(rows)

    def catch_up(self, rows: MapRows = ALL_ROWS) -> None:
        """These rows have taken all the steps that they missed."""
        self.last[rows] = self.count

    def advance(self, count: int) -> None:
        """Set the number of steps where nobody steps row by row: no row then misses any.

        Raises:
            ValueError: the count would go back.
        """
        if count < self.count:
            raise ArgumentError(f"a clock of steps does not go back, from {self.count} to {count}")
        self._steps.value = count
        self.catch_up()

    def part(self, rows: MapRows) -> "StepClock":
        """A clock of its own for copies of some rows, which ``write_back`` brings home; for a
        slice, whose rows are no copies, one that shares the count and these rows."""
        if isinstance(rows, slice):
            return StepClock(self._steps, self.birth[rows], self.last[rows])
        return StepClock(StepCount(self.count), self.birth[rows], self.last[rows])

    def write_back(self, rows: Int[Tensor, " M"], part: "StepClock") -> None:
        """Take over the clock of a ``part``, in which the steps since were taken.

        Raises:
            ValueError: other rows were stepped since the part was made.
        """
        if part.count < self.count:
            raise ArgumentError(
                f"a part with {part.count} steps is older than its map, which has {self.count}"
            )
        self._steps.value = part.count
        self.birth.index_copy_(0, rows, part.birth)
        self.last.index_copy_(0, rows, part.last)

    def repair(self) -> None:
        """Make rows whose moments were forgotten begin there, as in checkpoints of versions that
        only set ``birth``."""
        self.birth.clamp_(max=self.count)
        self.last.copy_(self.last.clamp(max=self.count).maximum(self.birth))

    def check(self) -> None:
        """Raise ``ValueError`` unless  0 <= birth <= last <= count  for every row."""
        wrong = (self.birth < 0) | (self.birth > self.last) | (self.last > self.count)
        if bool(wrong.any()):
            row = int(wrong.nonzero()[0, 0])
            raise ArgumentError(
                f"expected 0 <= birth <= last <= count, got {int(self.birth[row])}, "
                f"{int(self.last[row])} and {self.count} in row {row}"
            )
