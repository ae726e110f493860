"""``gsfusion-nb bench``: list the cases and run them one after another; the results are kept if it is interrupted."""

import dataclasses
import json
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ... import backends, optim, render, seeding, tsdf  # noqa: F401  (importing them declares their operations)
from ...files import write_file
from ...work import ProgressDisplay
from . import mapping
from . import raster as raster_cases
from . import tsdf as tsdf_cases
from .cases import SECTIONS, BenchCase, BenchOptions, BenchRow
from .timing import describe, header, threads

CASES: dict[str, Callable[[BenchOptions], Iterator[BenchCase]]] = {
    "raster": raster_cases.cases,
    "tsdf": tsdf_cases.cases,
    "map": mapping.map_cases,
}
_HEADINGS = ("case", "method", "wall ms", "CPU ms", "speed", "MB", "runs", "note")


@dataclass(kw_only=True)
class BenchResult:
    """All results."""

    options: BenchOptions
    machine: dict[str, Any]
    rows: list[BenchRow] = field(default_factory=list)
    missing: dict[str, dict[str, str]] = field(default_factory=dict)
    """Section -> backend that was not measured -> reason, and how to install it."""
    n_cases: int = 0
    n_done: int = 0

    def text(self) -> str:
        """Machine, a Markdown table for each section, and what the columns mean."""
        clock = "CPU" if self.options.threads == 1 else "wall"
        legend = (
            "Medians of several runs. CPU ms: all threads together. speed: how many times faster than the first row of "
            f"the case, by {clock} time, on a GPU by the time between two events in its queue. MB: growth of memory."
        )
        parts = ["\n".join(header(self.machine))]
        for section, about in SECTIONS.items():
            rows = [_cells(row) for row in self.rows if row.section == section]
            lines = [f"**{section}**: {about}", "", *_aligned([_HEADINGS, *rows])] if rows else []
            lines += [f"{section}: {name}: {why}" for name, why in self.missing.get(section, {}).items()]
            parts += ["\n".join(lines)] if lines else []
        return "\n\n".join([*parts, textwrap.fill(legend, width=100)])

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return {
            "machine": self.machine,
            "options": dataclasses.asdict(self.options),
            "interrupted": self.n_done < self.n_cases,
            "not_measured": self.missing,
            "rows": [dataclasses.asdict(row) for row in self.rows],
        }


def main(options: BenchOptions) -> int:
    """Run, print the table and write the JSON file. Returns 0, or 130 after Ctrl-C."""
    result = run_bench(options)
    print(result.text())
    if options.json:
        write_file(Path(options.json).expanduser(), json.dumps(result.as_dict(), indent=1) + "\n")
        print(f"All numbers: {options.json}")
    if result.n_done < result.n_cases:
        print(f"Interrupted after {result.n_done} of {result.n_cases} cases.")
        return 130
    return 0


def run_bench(options: BenchOptions) -> BenchResult:
    """Run the cases of ``options``; after Ctrl-C the result contains the measurements so far.

    Raises:
        KeyError, ValueError, OSError: invalid options; raised before anything is run.
    """
    options.check()
    with threads(options.threads):
        result = BenchResult(options=options, machine=describe(options.threads), missing=not_measured(options))
        planned = [case for section in options.sections for case in CASES[section](options)]
        result.n_cases = len(planned)
        with ProgressDisplay("bench", total=len(planned), unit="case", leave=False) as progress:
            try:
                for case in planned:
                    progress.show(result.n_done, note=f"{case.section}: {case.title}")
                    result.rows += case.run()
                    result.n_done += 1
                progress.show(result.n_done)
            except KeyboardInterrupt:
                pass
    result.rows = with_speed(result.rows, options.threads)
    return result


def with_speed(rows: list[BenchRow], threads: int) -> list[BenchRow]:
    """Fill in ``speed``: from CPU time with one thread, which other programs affect less; else from wall time.

    On a GPU the time between two events of its queue is used.
    """
    first: dict[tuple[str, str], float] = {}
    result = []
    for row in rows:
        t = row.timing
        took = t.cpu_ms if threads == 1 and t.cpu_ms > 0 else t.wall_ms
        took = took if t.device_ms is None else t.device_ms
        base = first.setdefault((row.section, row.case), took)
        result.append(dataclasses.replace(row, speed=base / took if took > 0 else None))
    return result


def not_measured(options: BenchOptions) -> dict[str, dict[str, str]]:
    """Backends of the chosen sections that cannot run on this machine, with the reason."""
    sections = {"render_forward": "raster", "fuse_frame_": "tsdf"}
    missing: dict[str, dict[str, str]] = {}
    for operation, backend, state in backends.report():
        if state != "ok" and sections.get(operation) in options.sections:
            missing.setdefault(sections[operation], {})[backend] = state
    return missing


def _cells(row: BenchRow) -> tuple[str, ...]:
    t = row.timing
    device = "" if t.device_ms is None else f"GPU {number(t.device_ms)} ms "
    return (
        row.case,
        row.method,
        number(t.wall_ms),
        number(t.cpu_ms) if t.cpu_ms > 0 else "",
        "" if row.speed is None else f"{number(row.speed)}x",
        "" if t.peak_mb is None else f"{t.peak_mb:.0f}",
        str(t.runs),
        (device + row.note).strip(),
    )


def _aligned(rows: list[tuple[str, ...]]) -> list[str]:
    """Lines of a Markdown table, headings first, whose columns are also aligned in a terminal."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    on_the_right = range(2, 7)
    lines = [
        "| " + " | ".join(c.rjust(w) if k in on_the_right else c.ljust(w) for k, (c, w) in enumerate(cells)) + " |"
        for cells in (zip(row, widths, strict=True) for row in rows)
    ]
    rule = "|" + "|".join("-" * (w + 1) + (":" if k in on_the_right else "-") for k, w in enumerate(widths)) + "|"
    return [lines[0], rule, *lines[1:]]


def number(x: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{x:.0f}" if x >= 100 else f"{x:.1f}" if x >= 10 else f"{x:.2f}"
