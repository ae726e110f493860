"""``gsfusion-nb bench``: time and memory of the operations on this machine; results are kept if it
is interrupted."""

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path

from ...files import write_file
from ...progress import ProgressDisplay
from .growth import growth_rows
from .mapper import map_rows
from .options import SECTIONS, BenchOptions, BenchRow
from .raster import raster_rows
from .timing import describe, header, threads
from .volume import tsdf_rows

ROWS: dict[str, Callable[[BenchOptions], Iterator[BenchRow]]] = {
    "raster": raster_rows,
    "tsdf": tsdf_rows,
    "map": map_rows,
    "growth": growth_rows,
}
"""Section of the table -> what measures its rows, one after the other."""
_HEADINGS = ("case", "method", "wall ms", "CPU ms", "GPU ms", "MB", "runs", "note")


def main(options: BenchOptions) -> int:
    """Run, print the table and write the JSON file. Returns 0, or 130 after Ctrl-C with the
    measurements so far.

    Raises:
        KeyError, ValueError, OSError: invalid options; raised before anything is run.
    """
    options.check()
    rows: list[BenchRow] = []
    is_interrupted = False
    with threads(options.threads), ProgressDisplay("bench", unit="row", leave=False) as progress:
        machine = describe(options.threads)
        try:
            for section in options.sections:
                for row in ROWS[section](options):
                    rows.append(row)
                    progress.show(len(rows), note=f"{section}: {row.case}")
        except KeyboardInterrupt:
            is_interrupted = True
    print("\n".join(header(machine)))
    for section in options.sections:
        cells = [_cells(row) for row in rows if row.section == section]
        print(
            "\n".join(
                [
                    "",
                    f"**{section}**: {SECTIONS[section]}",
                    "",
                    *_table_lines([_HEADINGS, *cells]),
                ]
            )
        )
    print(
        "\nMedians of several runs. CPU ms: all threads together. GPU ms: between two events in "
        "its queue."
    )
    if options.json:
        document = {
            "machine": machine,
            "options": dataclasses.asdict(options),
            "interrupted": is_interrupted,
            "rows": [dataclasses.asdict(row) for row in rows],
        }
        write_file(
            Path(options.json).expanduser(),
            json.dumps(document, indent=1) + "\n",
        )
        print(f"All numbers: {options.json}")
    if is_interrupted:
        print("Interrupted.")
    return 130 if is_interrupted else 0


def _cells(row: BenchRow) -> tuple[str, ...]:
    t = row.timing
    times = (
        "" if not ms else f"{ms:.0f}" if ms >= 100 else f"{ms:.2f}"
        for ms in (t.wall_ms, t.cpu_ms, t.device_ms)
    )
    memory = "" if t.peak_mb is None else f"{t.peak_mb:.0f}"
    return (row.case, row.method, *times, memory, str(t.runs), row.note)


def _table_lines(rows: list[tuple[str, ...]]) -> list[str]:
    """Lines of a Markdown table, headings first, whose columns are also aligned in a terminal."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"| {' | '.join(cell.ljust(w) for cell, w in zip(row, widths, strict=True))} |"
        for row in rows
    ]
    return [lines[0], f"|{'|'.join('-' * (w + 2) for w in widths)}|", *lines[1:]]
