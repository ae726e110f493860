"""The leaderboard of seeding rules: one row per rule, as a table and as a Pareto plot."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..drawing.html import fill
from .pareto import ParetoPoints, pareto_figure, pareto_front

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class LeaderboardRow:
    """Result of one rule."""

    name: str
    psnr_db: float
    """Mean over the held-out views."""
    psnr_sd_db: float = math.nan
    """Standard deviation over the runs of the rule; NaN for one run."""
    ssim: float
    """Mean over the held-out views."""
    n_gaussians: int
    n_keyframes: int
    n_steps: int = 0
    """Gradient steps; 0 if they were not counted."""
    ms_per_frame: float
    """Wall time of a mapping step, mean over all frames except the first, which loads and compiles."""
    cpu_ms_per_frame: float
    """CPU time of the same steps, over all threads; other programs affect it less than the wall time."""
    key: str = ""
    """``run_key`` of data, settings, rule, seed and program: equal keys mean equal runs."""
    seeding_ms: float
    """Wall time of the rule and its quadtree, mean over all frames except the first."""


@dataclass(kw_only=True)
class Leaderboard:
    """A table, best picture first. A notebook displays it; ``figure()`` is the Pareto plot."""

    rows: list[LeaderboardRow] = field(default_factory=list)
    sequence: str = ""
    """Name of the sequence."""
    means_over: str = ""
    """Over what the rows are means, such as "3 seeds"; empty for single runs."""
    complete: bool = False
    """False if it was stopped before all rules had run."""
    failed: dict[str, str] = field(default_factory=dict)
    """Rule -> reason why it could not be run."""

    @property
    def sorted(self) -> list[LeaderboardRow]:
        """Rows by held-out PSNR, best first."""
        return sorted(self.rows, key=lambda row: -row.psnr_db)

    @property
    def front(self) -> list[str]:
        """Names of the rules on the Pareto front of PSNR and number of Gaussians."""
        n, psnr = self._columns()
        return [row.name for row, best in zip(self.rows, pareto_front(n, psnr), strict=True) if best]

    def __getitem__(self, name: str) -> LeaderboardRow:
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(f"no rule {name!r} on the leaderboard; there are: {', '.join(r.name for r in self.rows)}")

    def __len__(self) -> int:
        return len(self.rows)

    def figure(self) -> "Figure":
        """Held-out PSNR over the number of Gaussians; area of a point: ms per frame; line: the Pareto front."""
        n, psnr = self._columns()
        ms = np.array([r.ms_per_frame for r in self.rows])
        sd = np.array([r.psnr_sd_db for r in self.rows])
        names = [row.name for row in self.rows]
        return pareto_figure(ParetoPoints(names=names, cost=n, quality=psnr, quality_sd=sd, ms=ms))

    def as_markdown(self) -> str:
        """The table for a report."""
        lines = [f"| {' | '.join(_HEADINGS)} |", "|---|" + "---:|" * (len(_HEADINGS) - 1)]
        front = set(self.front)
        lines += [f"| {' | '.join(_cells(row, row.name in front))} |" for row in self.sorted]
        return "\n".join(lines)

    def __repr__(self) -> str:
        front, rows = set(self.front), [list(_HEADINGS)]
        rows += [_cells(row, row.name in front) for row in self.sorted]
        widths = [max(len(row[k]) for row in rows) for k in range(len(_HEADINGS))]
        lines = ["  ".join(c.rjust(w) if k else c.ljust(w) for k, (c, w) in enumerate(zip(r, widths, strict=True)))
                 for r in rows]  # fmt: skip
        return "\n".join([*lines, *self._notes()])

    def _repr_html_(self) -> str:
        front = set(self.front)
        rows = [(_cells(row, row.name in front), row.name in front) for row in self.sorted]
        return fill("leaderboard.html", headings=_HEADINGS, rows=rows, notes=self._notes())

    def _columns(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([r.n_gaussians for r in self.rows]), np.array([r.psnr_db for r in self.rows])

    def _notes(self) -> list[str]:
        notes = (
            ["● on the Pareto front: no other rule has both fewer Gaussians and a better picture"] if self.rows else []
        )
        notes += [f"means over {self.means_over}; ±: standard deviation over the runs"] if self.means_over else []
        notes += _differences(self.rows)
        notes += [f"{name} did not run: {reason}" for name, reason in self.failed.items()]
        return notes if self.complete else [*notes, "stopped before every rule had run"]


_HEADINGS = ("rule", "PSNR held out, dB", "SSIM", "Gaussians", "keyframes", "ms/frame", "of it seeding", "CPU ms/frame")


def _differences(rows: list[LeaderboardRow]) -> list[str]:
    """A sentence if the rules differ in what they spent, since quality depends on it too."""
    found = []
    for what, counts in (
        ("Gaussians", [r.n_gaussians for r in rows]), ("gradient steps", [r.n_steps for r in rows])
    ):  # fmt: skip
        if counts and max(counts) > 1.1 * min(counts):
            found.append(f"{min(counts):,} to {max(counts):,} {what}")
    if not found:
        return []
    return [f"not equal between the rules: {' and '.join(found)}; a Budget makes them equal"]


def _cells(row: LeaderboardRow, on_front: bool) -> list[str]:
    return [
        f"{'● ' if on_front else ''}{row.name}", _with_spread(row), f"{row.ssim:.3f}", f"{row.n_gaussians:,}",
        f"{row.n_keyframes}", f"{row.ms_per_frame:.0f}", f"{row.seeding_ms:.1f}", f"{row.cpu_ms_per_frame:.0f}",
    ]  # fmt: skip


def _with_spread(row: LeaderboardRow) -> str:
    return f"{row.psnr_db:.2f}" + ("" if math.isnan(row.psnr_sd_db) else f" ± {row.psnr_sd_db:.2f}")
