"""The findings of a check-up, one per property, and the report of them: for a notebook, a terminal
or a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ...config import DataConfig, RepairConfig
from ...drawing.page import PageGraph, fill, page_picture
from ...drawing.pictures import Picture
from ...errors import UnknownNameError
from ...files import write_file

Verdict = Literal["ok", "unknown", "doubtful", "wrong"]
RANK: dict[Verdict, int] = {"ok": 0, "unknown": 1, "doubtful": 2, "wrong": 3}
"""What cannot be known from the recording is no trouble, but it is not in order either: it is
"unknown"."""
_MARKS: dict[Verdict, str] = {"ok": "ok", "unknown": "--", "doubtful": "??", "wrong": "NO"}


@dataclass(frozen=True)
class Finding:
    """One property that was examined."""

    name: str
    """What was examined, for example "depth scale"."""
    verdict: Verdict
    sentence: str
    """What was found, with the numbers that matter."""
    repair: str = ""
    """Options of ``gsfusion-nb map``, or what to do; empty if nothing needs to be done."""


def flags_of(data: DataConfig) -> str:
    """The options of ``gsfusion-nb map`` for this range, these depth limits and these
    corrections."""
    default = DataConfig()
    names = ("start", "stop", "depth_min_m", "depth_max_m")
    values = {
        name: getattr(data, name) for name in names if getattr(data, name) != getattr(default, name)
    }
    words = [f"--data.{name.replace('_', '-')} {value:.6g}" for name, value in values.items()]
    return " ".join([*words, *([data.repair.flags] if data.repair != RepairConfig() else [])])


def reader_flags(reader: Mapping[str, Any]) -> str:
    """The options of ``gsfusion-nb map`` for these options of the reader."""
    return " ".join(f"--reader {name}={str(value).lower()}" for name, value in reader.items())


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckupReport:
    """Result of a check-up: print it, or show it in a notebook. ``report["depth scale"]`` is one
    finding."""

    name: str
    findings: Sequence[Finding]
    data: DataConfig
    """Range, depth limits and corrections that repair the recording:
    ``open_sequence(path, data=report.data)``."""
    length: int
    frames_read: int
    reader: Mapping[str, Any] = field(default_factory=dict)
    """Options of the reader, given or found to repair it:
    ``open_sequence(path, **report.reader)``."""
    together: str = ""
    """What all repairs together gain, in words."""
    pictures: Mapping[str, Picture] = field(default_factory=dict)
    """Caption -> picture."""
    graphs: Sequence[PageGraph] = ()
    """The path from above, and what was measured over the frames."""
    seconds: float = 0.0

    def __getitem__(self, name: str) -> Finding:
        by_name = {f.name: f for f in self.findings}
        if name not in by_name:
            raise UnknownNameError(f"no finding {name!r}; known: {', '.join(by_name)}")
        return by_name[name]

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all findings."""
        return max(self.findings, key=lambda f: RANK[f.verdict]).verdict if self.findings else "ok"

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong or doubtful; some properties may be unknown."""
        return not self.trouble

    @property
    def trouble(self) -> list[Finding]:
        """The findings that are wrong or doubtful, the worst first."""
        return [
            f for verdict in ("wrong", "doubtful") for f in self.findings if f.verdict == verdict
        ]

    @property
    def unknown(self) -> list[Finding]:
        """What these frames cannot show."""
        return [f for f in self.findings if f.verdict == "unknown"]

    @property
    def flags(self) -> str:
        """Options of ``gsfusion-nb map`` for all repairs together; empty if there are none."""
        return " ".join(
            words for words in (reader_flags(self.reader), flags_of(self.data)) if words
        )

    @property
    def summary(self) -> str:
        """The result in one sentence."""
        wrong, doubtful = (
            sum(f.verdict == v for f in self.findings) for v in ("wrong", "doubtful")
        )
        read = f"{self.frames_read} of {self.length} frames read"
        if self.unknown:
            read = f"{len(self.unknown)} cannot be known from it, {read}"
        if not wrong and not doubtful:
            return f"{self.name} is in order: {len(self.findings)} properties checked, {read}."
        return (
            f"{self.name}: {wrong} wrong, {doubtful} doubtful of {len(self.findings)} "
            f"properties checked, {read}."
        )

    def __str__(self) -> str:
        width = max(len(f.name) for f in self.findings)
        lines = [self.summary]
        for f in self.findings:
            lines.append(f"  {_MARKS[f.verdict]}  {f.name:<{width}}  {f.sentence}")
            if f.repair:
                lines.append(f"      {'':<{width}}  -> {f.repair}")
        if self.flags:
            lines.append(f"All repairs together: {self.flags}")
        lines += [f"With all of them {self.together}."] * bool(self.together)
        return "\n".join(lines)

    def __repr__(self) -> str:
        return (
            f"CheckupReport({self.name}: {self.verdict}, {len(self.trouble)} of "
            f"{len(self.findings)} findings not ok)"
        )

    def _repr_html_(self) -> str:
        return fill("checkup_summary.html", report=self)

    def write(self, path: Path | str) -> Path:
        """Write everything as one HTML page that needs no other file. Returns its path."""
        page_pictures = [page_picture(image, caption) for caption, image in self.pictures.items()]
        write_file(
            path,
            fill(
                "checkup.html",
                title=f"Check-up of {self.name}",
                report=self,
                pictures=page_pictures,
            ),
        )
        return Path(path)
