"""The bench: list the cases and run them one after another; the results are kept if it is interrupted."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ... import optim, render, seeding, tsdf  # noqa: F401  (importing them declares their operations)
from ...files import write_file
from ...work import ProgressDisplay
from . import checkpoints, latency, machine, panels, scaling, table
from . import mapping as mapping_cases
from . import raster as raster_cases
from . import tsdf as tsdf_cases
from .frames import open_frames
from .options import BenchOptions
from .other_programs import OTHER_PROGRAMS, why_not
from .rows import Case, Row, with_speed
from .timing import threads

CASES: dict[str, Callable[[BenchOptions], Iterator[Case]]] = {
    "raster": raster_cases.cases,
    "tsdf": tsdf_cases.cases,
    "map": mapping_cases.cases,
    "panels": panels.cases,
    "latency": latency.cases,
    "checkpoints": checkpoints.cases,
}


@dataclass(kw_only=True)
class BenchResult:
    """All results."""

    options: BenchOptions
    machine: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    missing: dict[str, dict[str, str]] = field(default_factory=dict)
    """Section -> program that was not measured -> reason, and how to install it."""
    n_cases: int = 0
    n_done: int = 0
    interrupted: bool = False

    def text(self) -> str:
        """Header, table and legend; Markdown if the options request it."""
        head = machine.header(self.machine)
        legend = table.legend(self.options.threads)
        if self.options.markdown:
            parts = ["  \n".join(head), table.markdown(self.rows, self.missing), legend]
        else:
            parts = ["\n".join(map(_folded, head)), table.text(self.rows, self.missing), _folded(legend)]
        return "\n\n".join(part for part in parts if part)

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return {
            "machine": self.machine,
            "options": self.options.as_dict(),
            "interrupted": self.interrupted,
            "not_measured": self.missing,
            "rows": [table.plain(row) for row in self.rows],
        }


def run_bench(options: BenchOptions) -> BenchResult:
    """Run the cases of ``options``; after Ctrl-C the result contains the measurements so far.

    Raises:
        KeyError, ValueError, OSError: invalid options; raised before anything is run.
    """
    options.check()
    with threads(options.threads):
        result = BenchResult(options=options, machine=machine.describe(options.threads))
        if {"tsdf", "map", "latency", "checkpoints"} & set(options.sections):
            for size in options.sizes:
                open_frames(options, size)
        result.missing = not_measured(options)
        planned = [case for section in options.sections for case in CASES[section](options)]
        if options.scaling:
            planned += list(scaling.cases(options))
        result.n_cases = len(planned)
        with ProgressDisplay("bench", total=len(planned), unit="case", leave=False) as progress:
            try:
                for case in planned:
                    progress.show(result.n_done, note=f"{case.section}: {case.title}")
                    result.rows += case.run()
                    result.n_done += 1
                progress.show(result.n_done)
            except KeyboardInterrupt:
                result.interrupted = True
    result.rows = with_speed(result.rows, options.threads)
    return result


def not_measured(options: BenchOptions) -> dict[str, dict[str, str]]:
    """Programs and backends of the chosen sections that cannot run on this machine, with the reason."""
    from ... import backends

    missing: dict[str, dict[str, str]] = {}
    for name, program in OTHER_PROGRAMS.items():
        reason = why_not(name) if program.section in options.sections else None
        if reason:
            missing.setdefault(program.section, {})[program.name] = reason
    sections = {"render_forward": "raster", "fuse_frame_": "tsdf"}
    for operation, backend, state in backends.report():
        section = sections.get(operation)
        if section in options.sections and state != "ok":
            missing.setdefault(str(section), {})[backend] = state
    return missing


def main(options: BenchOptions) -> int:
    """Run, print the table and write the JSON file. Returns 0, or 130 after Ctrl-C."""
    result = run_bench(options)
    print(result.text())
    if options.json:
        write_file(Path(options.json).expanduser(), json.dumps(result.as_dict(), indent=1) + "\n")
        print(f"All numbers: {options.json}")
    if result.interrupted:
        print(f"Interrupted after {result.n_done} of {result.n_cases} cases.")
        return 130
    return 0


def _folded(sentence: str) -> str:
    import textwrap

    return textwrap.fill(sentence, width=100)
