"""The report of a check-up: findings, repair, alternatives tried, pictures; for a notebook, a terminal or a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...config import DataConfig
from ...drawing.page import fill, page_picture
from ...drawing.pictures import Picture
from ...files import write_file
from .explain import Alternative
from .findings import RANK, Finding, Verdict, flags_of
from .frame_to_frame import OverFrames
from .graphs import graphs

_MARKS: dict[Verdict, str] = {"ok": "ok", "unknown": "--", "doubtful": "??", "wrong": "NO"}


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckupReport:
    """Result of a check-up: print it, or show it in a notebook. ``report["depth scale"]`` is one finding."""

    name: str
    findings: Sequence[Finding]
    data: DataConfig
    """Range, depth limits and corrections that repair the recording: ``open_sequence(path, data=report.data)``."""
    length: int
    frames_read: int
    reader: Mapping[str, Any] = field(default_factory=dict)
    """Options of the reader that repair it: ``open_sequence(path, **report.reader)``."""
    rows: Sequence[Alternative] = ()
    """The interpretations and corrections that were tried, best first."""
    over: OverFrames | None = None
    """Measurements from frame to frame."""
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
        """The worst verdict of all findings."""
        return max(self.findings, key=lambda f: RANK[f.verdict]).verdict if self.findings else "ok"

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong or doubtful; some properties may be unknown."""
        return self.verdict in ("ok", "unknown")

    @property
    def trouble(self) -> list[Finding]:
        """The findings that are wrong or doubtful, the worst first."""
        found = [f for f in self.findings if f.verdict in ("wrong", "doubtful")]
        return sorted(found, key=lambda f: -RANK[f.verdict])

    @property
    def unknown(self) -> list[Finding]:
        """What these frames cannot show."""
        return [f for f in self.findings if f.verdict == "unknown"]

    @property
    def flags(self) -> str:
        """Options of ``gsfusion-nb map`` for all repairs together; empty if there are none."""
        reader = [f"--reader {name}={str(value).lower()}" for name, value in self.reader.items()]
        return " ".join([*reader, *([flags_of(self.data)] if flags_of(self.data) else [])])

    @property
    def summary(self) -> str:
        """The result in one sentence."""
        wrong, doubtful = (sum(f.verdict == v for f in self.findings) for v in ("wrong", "doubtful"))
        read = f"{self.frames_read} of {self.length} frames read"
        if self.unknown:
            read = f"{len(self.unknown)} cannot be known from it, {read}"
        if not wrong and not doubtful:
            return f"{self.name} is in order: {len(self.findings)} properties checked, {read}."
        return f"{self.name}: {wrong} wrong, {doubtful} doubtful of {len(self.findings)} properties checked, {read}."

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
        return fill("checkup_summary.html", report=self)

    def write(self, path: Path | str) -> Path:
        """Write everything as one HTML page that needs no other file. Returns its path."""
        shown = [page_picture(image, caption) for caption, image in self.pictures.items()]
        over = graphs(self.over, self.top_view)
        write_file(
            path, fill("checkup.html", title=f"Check-up of {self.name}", report=self, pictures=shown, graphs=over)
        )
        return Path(path)
