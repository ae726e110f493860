"""Working time: how long a learner works on each chapter and exercise, kept in the learner's own course file.

A notebook's actions are: a cell starts, a cell ends, a prediction is made. The time since the last action in any
notebook belongs to the chapter in which something is done now, and also to the exercises that the running cell names
(``def psnr(`` or ``check.psnr``) and that are not solved yet. So the time of an exercise is what passed before its
cells ran: reading the task, thinking and typing. It ends when the checker accepts a function.

Nobody sees whether a learner thinks or drinks tea. So gaps of up to five minutes are added up; longer ones, up to an
hour, are listed one by one, and whoever reads the file decides how long a gap may be before it is a pause
(``working_s``). Longer ones, a night or a closed computer, are forgotten.

The section ``times`` of the course file::

    {"clock": {"last": 1790000000.0},                        # time of the last action
     "chapter 0": {"seconds": 3120.4, "gaps_s": [412]},
     "psnr": {"seconds": 640.5, "gaps_s": []}}

Nothing else is noted, and nothing leaves the file. ``GSNB_COURSE_TIMES=off`` or ``gsfusion-nb course --clock off``
stops the clock. A notebook that is executed to be stored, or quickly, has no learner and no clock.
"""

import os
import re
import sys
import time
from collections.abc import Collection, Iterable
from typing import Any

from .progress import Entries, changing, forgiving, read_section

SECTION = "times"
CLOCK = "clock"
SHORT_S = 300.0
"""Gaps of up to this length are added up at once."""
LONGEST_S = 3600.0
"""Longer gaps are not noted."""
PAUSE_S = 600.0
"""A gap longer than this is a pause, unless the reader of the file says otherwise. Between two cells that run a learner
writes a function, of which the kernel sees nothing; so it must not be short."""
MERGED_S = 2.0
"""Actions that follow each other faster are noted together: running all cells writes the file a few times."""

_NAMED = re.compile(r"\bdef (\w+)\(|\bcheck\.(\w+)\b(?!\.working\b)")

_SAID = (
    "The course notes how long you work on each chapter and exercise, in your own course file only. "
    "gsfusion-nb course  shows the times;  gsfusion-nb course --clock off  stops it.\n"
)

_chapter: int | None = None
"""The chapter of this notebook, once it is known."""
_exercises: frozenset[str] = frozenset()
"""Names of the exercises of the course."""
_noted = -MERGED_S
"""When this process last noted a time."""
_cell = ""
"""Source of the cell that runs."""


def now() -> float:
    """Seconds since 1970; it goes on while the computer sleeps, so a closed computer is a pause."""
    return time.time()


def is_on() -> bool:
    """Whether times are noted.

    Raises:
        CourseFileError: the file is damaged, or a newer version of the program wrote it.
    """
    no_learner = os.environ.get("GSNB_VIEW") == "static" or os.environ.get("GSNB_SMOKE", "0") not in ("", "0")
    if no_learner or os.environ.get("GSNB_COURSE_TIMES", "").lower() in ("off", "0", "no"):
        return False
    return not switched_off()


def switched_off() -> bool:
    """Whether the learner stopped the clock (``gsfusion-nb course --clock off``). Raises as ``is_on``."""
    return bool(read_section(SECTION).get(CLOCK, {}).get("off", False))


def switch(state: str) -> None:
    """Start the clock (``on``), stop it (``off``), or forget all times (``forget``). Raises as ``note``."""
    with changing(SECTION) as times:
        if state == "forget":
            kept = {key: value for key, value in times.get(CLOCK, {}).items() if key == "off"}
            times.clear()
            times[CLOCK] = kept
        else:
            times.setdefault(CLOCK, {})["off"] = state == "off"
            times[CLOCK].pop("last", None)


def start(chapter: int, exercises: Collection[str]) -> None:
    """This notebook is that chapter; from now on each of its cells is an action. Called again, it changes nothing.

    Args:
        chapter: Its number.
        exercises: Names of all exercises of the course.
    """
    global _chapter, _exercises
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if _chapter is not None or shell is None:
        return
    _chapter, _exercises = chapter, frozenset(exercises)
    shell.events.register("pre_run_cell", _cell_starts)
    shell.events.register("post_run_cell", _cell_ends)
    with forgiving():
        if is_on() and not read_section(SECTION):
            sys.stdout.write(_SAID)
    acted()


def acted(source: str = "") -> None:
    """Something was done in this notebook: note the time since the last action. Never stops a notebook.

    Args:
        source: Of the cell that starts or ends.
    """
    global _noted
    at = now()
    if _chapter is None or 0 <= at - _noted < MERGED_S:
        return
    with forgiving():
        if not is_on():
            return
        names = [f"chapter {_chapter}", *_unsolved(named_in(source))]
        with changing(SECTION) as times:
            add(times, at, names)
        _noted = at


def add(times: Entries, at: float, names: Iterable[str]) -> None:
    """Add the time from the last action to ``at`` to the entries ``names``, unless it is too long."""
    clock = times.setdefault(CLOCK, {})
    last: Any = clock.get("last")
    clock["last"] = round(at, 1)
    gap = at - last if _is_number(last) else 0.0
    if not 0 < gap <= LONGEST_S:
        return
    for name in names:
        entry = times.setdefault(name, {})
        if gap <= SHORT_S:
            before = entry.get("seconds", 0.0)
            entry["seconds"] = round((before if _is_number(before) else 0.0) + gap, 1)
        else:
            gaps = entry.get("gaps_s")
            entry["gaps_s"] = [*(gaps if isinstance(gaps, list) else []), round(gap)]


def working_s(entry: dict[str, Any], pause_s: float = PAUSE_S) -> float:
    """Seconds of work in an entry, where a gap longer than ``pause_s`` (300 to 3600) counts as a pause.

    Values that are no numbers, in a file that was edited, do not count.
    """
    gaps = entry.get("gaps_s")
    long = [g for g in gaps if _is_number(g) and SHORT_S <= g <= pause_s] if isinstance(gaps, list) else []
    seconds = entry.get("seconds", 0.0)
    return (seconds if _is_number(seconds) and seconds > 0 else 0.0) + sum(long)


def named_in(source: str) -> list[str]:
    """Names of the exercises that a cell defines or asks a checker about."""
    found = (first or second for first, second in _NAMED.findall(source))
    return list(dict.fromkeys(found))


def _unsolved(names: list[str]) -> list[str]:
    noted = read_section("exercises") if names else {}
    return [name for name in names if name in _exercises and "passed" not in noted.get(name, {})]


def _cell_starts(info: Any) -> None:
    global _cell
    _cell = str(getattr(info, "raw_cell", "") or "")
    acted(_cell)


def _cell_ends(result: Any) -> None:
    acted(_cell)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
