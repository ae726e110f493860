"""The report of a check-up: findings, the repair, what was tried, pictures; for a notebook, a terminal or a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ...config import DataConfig
from ...drawing.page import chart, figure, page_html
from ...drawing.pictures import Picture
from ...files import write_file
from .explain import Row
from .findings import RANK, Finding, Verdict, flags_of
from .over_frames import OverFrames

_MARKS: dict[Verdict, str] = {"ok": "ok", "doubtful": "??", "wrong": "NO"}
_WORDS = {"ok": "ok", "doubtful": "doubtful", "wrong": "wrong"}
_STYLE = """<style>.v{font-weight:650;white-space:nowrap}.v.ok{color:#2f8f5b}
.v.doubtful{color:#b7791f}.v.wrong{color:#c53a3a}
td.v{padding-right:16px}.findings td:nth-child(2){white-space:nowrap;padding-right:18px}
.pictures.pair{grid-template-columns:repeat(2,minmax(0,1fr))}
.findings code,.tried code{overflow-wrap:anywhere}</style>"""


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckupReport:
    """What a check-up found. ``report["depth scale"]`` is a finding; print it, or let a notebook show it."""

    name: str
    findings: Sequence[Finding]
    data: DataConfig
    """Range, depth limits and corrections that repair the recording: ``open_sequence(path, data=report.data)``."""
    length: int
    frames_read: int
    reader: Mapping[str, Any] = field(default_factory=dict)
    """Options of the reader that repair it: ``open_sequence(path, **report.reader)``."""
    rows: Sequence[Row] = ()
    """Ways to understand the recording that were tried, the best first."""
    over: OverFrames | None = None
    """From frame to frame."""
    pictures: Mapping[str, Picture] = field(default_factory=dict)
    """Caption -> picture."""
    top_view: str = ""
    """The path from above, SVG."""
    seconds: float = 0.0

    def __getitem__(self, name: str) -> Finding:
        found = {f.name: f for f in self.findings}
        if name not in found:
            raise KeyError(f"no finding {name!r}; known: {', '.join(found)}")
        return found[name]

    @property
    def verdict(self) -> Verdict:
        """The worst of the findings."""
        return max(self.findings, key=lambda f: RANK[f.verdict]).verdict if self.findings else "ok"

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong or doubtful."""
        return self.verdict == "ok"

    @property
    def trouble(self) -> list[Finding]:
        """The findings that are not ok, the worst first."""
        return sorted((f for f in self.findings if f.verdict != "ok"), key=lambda f: -RANK[f.verdict])

    @property
    def flags(self) -> str:
        """Options of ``gsfusion-nb map`` for all repairs together; empty where there are none."""
        reader = [f"--reader {name}={str(value).lower()}" for name, value in self.reader.items()]
        return " ".join([*reader, *([flags_of(self.data)] if flags_of(self.data) else [])])

    @property
    def summary(self) -> str:
        """One sentence."""
        wrong, doubtful = (sum(f.verdict == v for f in self.findings) for v in ("wrong", "doubtful"))
        read = f"{self.frames_read} of {self.length} frames read"
        if not wrong and not doubtful:
            return f"{self.name} is in order: {len(self.findings)} things looked at, {read}."
        return f"{self.name}: {wrong} wrong, {doubtful} doubtful of {len(self.findings)} things looked at, {read}."

    def __str__(self) -> str:
        width = max(len(f.name) for f in self.findings)
        lines = [self.summary]
        for f in self.findings:
            lines.append(f"  {_MARKS[f.verdict]}  {f.name:<{width}}  {f.sentence}")
            if f.repair:
                lines.append(f"      {'':<{width}}  -> {f.repair}")
        if self.flags:
            lines.append(f"All repairs together: {self.flags}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return (
            f"CheckupReport({self.name}: {self.verdict}, {len(self.trouble)} of {len(self.findings)} findings not ok)"
        )

    def _repr_html_(self) -> str:
        return notebook_html(self)

    def write(self, path: Path | str) -> Path:
        """Write everything as one HTML page that needs no other file; the path written."""
        write_file(path, page_of(self))
        return Path(path)


def page_of(report: CheckupReport) -> str:
    """The whole page."""
    fine = [f for f in report.findings if f.verdict == "ok"]
    parts = [
        _STYLE,
        f"<header><h1>Check-up of {escape(report.name)}</h1>"
        f'<p class="lead">{escape(report.summary)} {report.seconds:.1f} s.</p>{_repair(report)}</header>',
        f"<section><h2>Findings</h2>{_findings([*report.trouble, *fine])}</section>",
        _pictures(report),
        _tried(report.rows),
        _curves(report),
    ]
    return page_html(f"Check-up of {report.name}", "\n".join(p for p in parts if p))


def notebook_html(report: CheckupReport) -> str:
    """Summary, what is not in order, and the repair."""
    shown = report.trouble or report.findings
    rest = "" if shown is report.findings else f"<p>The other {len(report.findings) - len(shown)} are in order.</p>"
    return f"{_STYLE}<p><b>{escape(report.summary)}</b></p>{_repair(report)}{_findings(shown)}{rest}"


def _repair(report: CheckupReport) -> str:
    if not report.flags:
        return ""
    return (
        f'<div class="warn">All repairs together, for <code>gsfusion-nb map</code>: '
        f"<code>{escape(report.flags)}</code></div>"
    )


def _findings(findings: Sequence[Finding]) -> str:
    rows = "".join(map(_finding, findings))
    return f'<div class="card"><table class="findings">{rows}</table></div>'


def _finding(f: Finding) -> str:
    is_option = f.repair.startswith("--")
    repair = f"<code>{escape(f.repair)}</code>" if is_option else escape(f.repair)
    more = f'<span class="what">Repair: {repair}</span>' if f.repair else ""
    return (
        f'<tr><td class="v {f.verdict}">{_WORDS[f.verdict]}</td><td>{escape(f.name)}</td>'
        f"<td>{escape(f.sentence)}{more}</td></tr>"
    )


def _pictures(report: CheckupReport) -> str:
    if not report.pictures:
        return ""
    shown = "".join(f"<figure>{figure(image, name, name)}</figure>" for name, image in report.pictures.items())
    return (
        '<section><h2>Pictures</h2><p class="note">Left: the depth of one frame, moved into another by the poses, '
        "against the depth measured there; black agrees, light yellow is 10 cm off, stripes are not seen by both. "
        "Right: edges of the depth image; they should lie on the edges of things.</p>"
        f'<div class="card view"><div class="pictures pair">{shown}</div></div></section>'
    )


def _tried(rows: Sequence[Row]) -> str:
    lines = "".join(
        f'<tr><td>{escape(r.what)}</td><td><code>{escape(r.flags)}</code></td><td class="num">{r.agreeing:.0%}</td>'
        f'<td class="num">{100 * r.median_m:,.2f} cm</td></tr>'
        for r in rows
    )
    if not lines:
        return ""
    head = '<tr><th>Tried</th><th>Options</th><th class="num">agreeing</th><th class="num">median difference</th></tr>'
    return (
        '<section><h2>What was tried</h2><p class="note">Points of one depth image, moved into another: the share that '
        "falls within 3 % of the depth measured there, and the median difference where the images overlap.</p>"
        f'<div class="card"><table class="tried">{head}{lines}</table></div></section>'
    )


def _curves(report: CheckupReport) -> str:
    over = report.over
    if over is None:
        return ""
    x = over.number
    charts = [
        ("Depth difference to the next frame", {"median": 100 * over.error}, "% of depth"),
        ("Rotation to the next frame", {"turn": over.turned_deg}, "degrees"),
        ("Step to the next frame", {"step": 100 * over.moved_m}, "cm"),
        ("Pixels without depth", {"missing": 100 * over.missing}, "%"),
        ("Brightness of the same points, next / this frame", {"gain": over.gain_stops}, "stops"),
        ("Sharpness beside the neighbours'", {"sharpness": over.sharpness}, "of their median"),
    ]
    cards = "".join(
        chart(title, x, series, x_label="frame", y_label=unit)
        for title, series, unit in charts
        if np.isfinite(next(iter(series.values()))).any()
    )
    top = f'<div class="card chart"><h3>Path from above</h3>{report.top_view}</div>' if report.top_view else ""
    return f'<section><h2>Over the frames</h2><div class="grid two">{top}{cards}</div></section>'
