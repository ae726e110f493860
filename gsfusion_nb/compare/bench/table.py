"""The rows as a table: text for a terminal of 100 columns, Markdown, or plain values for JSON."""

import dataclasses
from typing import Any

from .rows import Row

HEADINGS = {
    "raster": "raster: Gaussian rasteriser; note: PSNR to the picture of torch, smallest cosine of a gradient",
    "tsdf": "tsdf: integration with colour (depth: without), truncation 4 voxels; raycasts; note: frames/s",
    "map": "map: GSFusion, Replica settings, means over the frames; note: frames/s, number of Gaussians",
    "panels": "panels: from moving a control to the new picture; method: what is shown or moved",
    "latency": "latency: waiting times besides mapping",
    "checkpoints": "checkpoints: saving a run; note: share of the 30 s between two checkpoints, by CPU time; size",
    "scaling": "scaling: growth of time, line through (ln x, ln time)",
}

_WIDTHS = (28, 21, 8, 7, 7, 6, 5)
_COLUMNS = ("case", "method", "wall ms", "CPU ms", "speed", "MB", "runs", "note")

LEGEND = (
    "Medians of several runs. CPU ms: all threads together. speed: how many times faster than the first row of the "
    "case, by {clock} time, on a GPU by the time between two events in its queue. MB: growth of memory."
)


def legend(threads: int) -> str:
    """Explanation of the columns."""
    return LEGEND.format(clock="CPU" if threads == 1 else "wall")


def text(rows: list[Row], missing: dict[str, dict[str, str]]) -> str:
    """A table of at most 100 columns, one block per section."""
    lines: list[str] = []
    for section in _sections(rows, missing):
        lines += ["", HEADINGS[section]]
        lines += [f"  {name}: {reason}" for name, reason in missing.get(section, {}).items()]
        mine = [row for row in rows if row.section == section]
        if section == "scaling":
            lines += [f"  {row.case:<34} {row.method:<10} {row.note}" for row in mine]
            continue
        if mine:
            lines.append(_line(_COLUMNS))
        case = None
        for row in mine:
            cells = _cells(row)
            part = row.case.partition(" / ")[2]
            shown = f"  {part}" if part else row.case if row.case != case else ""
            lines.append(
                _line((shown, *cells[1:])) if row.timing else f"  {shown:<{_WIDTHS[0] - 2}} {cells[1]}: {row.note}"
            )
            case = row.case
    return "\n".join(lines[1:])


def markdown(rows: list[Row], missing: dict[str, dict[str, str]]) -> str:
    """The same as Markdown tables for GitHub."""
    lines: list[str] = []
    for section in _sections(rows, missing):
        lines += ["", f"**{HEADINGS[section].split(':')[0]}**:{HEADINGS[section].split(':', 1)[1]}", ""]
        mine = [row for row in rows if row.section == section]
        if section == "scaling":
            lines += ["| axis | method | growth |", "|---|---|---|"]
            lines += [f"| {row.case} | {row.method} | {row.note} |" for row in mine]
        elif mine:
            lines += [f"| {' | '.join(_COLUMNS)} |", "|---|---|---:|---:|---:|---:|---:|---|"]
            lines += [f"| {' | '.join(cell.strip() for cell in _cells(row))} |" for row in mine]
        lines += ["", *(f"{name}: {reason}" for name, reason in missing.get(section, {}).items())]
    return "\n".join(lines[1:]).replace("\n\n\n", "\n\n").strip()


def plain(row: Row) -> dict[str, Any]:
    """A row as values for JSON."""
    return dataclasses.asdict(row)


def _sections(rows: list[Row], missing: dict[str, dict[str, str]]) -> list[str]:
    present = {row.section for row in rows} | {section for section, names in missing.items() if names}
    return [section for section in HEADINGS if section in present]


def _cells(row: Row) -> tuple[str, ...]:
    if row.timing is None:
        return (row.case, row.method, "-", "-", "-", "-", "-", row.note)
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


def _line(cells: tuple[str, ...]) -> str:
    case, method, *numbers, note = cells
    left = f"  {case:<{_WIDTHS[0] - 2}} {method:<{_WIDTHS[1]}}"
    return (left + "".join(f"{n:>{w}}" for n, w in zip(numbers, _WIDTHS[2:], strict=True)) + f"  {note}").rstrip()


def number(x: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{x:.0f}" if x >= 100 else f"{x:.1f}" if x >= 10 else f"{x:.2f}"
