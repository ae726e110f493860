"""Cases of the bench, and the table rows with their results."""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from .timing import Timing


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table."""

    section: str
    """raster, tsdf, map, panels, latency, checkpoints or scaling."""
    case: str
    """The work. Rows of a section with the same case are compared with each other."""
    method: str
    """The program or backend."""
    timing: Timing | None = None
    """None if it could not be run; ``note`` gives the reason."""
    speed: float | None = None
    """How many times faster than the first row of the case."""
    note: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    """Further numbers, for the JSON file."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One measurement, not yet made."""

    section: str
    title: str
    run: Callable[[], Iterable[Row]]


def with_speed(rows: list[Row], threads: int) -> list[Row]:
    """Fill in ``speed``: from CPU time with one thread, which other programs affect less; else from wall time.

    On a GPU the time between two events of its queue is used.
    """
    first: dict[tuple[str, str], float] = {}
    result = []
    for row in rows:
        if row.timing is None:
            result.append(row)
            continue
        t = row.timing
        took = t.cpu_ms if threads == 1 and t.cpu_ms > 0 else t.wall_ms
        took = took if t.device_ms is None else t.device_ms
        base = first.setdefault((row.section, row.case), took)
        result.append(dataclasses.replace(row, speed=base / took if took > 0 else None))
    return result
