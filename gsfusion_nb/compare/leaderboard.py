"""Compare seeding rules in one call: runs on the same frames with the same settings fill a leaderboard."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..drawing.page import fill
from .pareto import ParetoPoints, pareto_figure, pareto_front

if TYPE_CHECKING:
    from matplotlib.figure import Figure
import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence

from ..config import SystemConfig
from ..config import gsfusion as gsfusion_preset
from ..data import OpenedSequence, open_sequence
from ..seeding import SeedingRule
from ..work import ProgressDisplay
from .entries import Entrant, entries_of
from .map_scene import Entry
from .one_run import run_steps
from .spec import Budget, RunResult
from .statistics import summarise


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


@dataclass(frozen=True, kw_only=True)
class CompareProgress:
    """Progress of ``compare_rules``."""

    rule: str
    position: int
    """Number of the rule, from 0."""
    n_rules: int
    frame: int
    """Frames mapped with this rule, in all its runs."""
    n_frames: int

    @property
    def share(self) -> float:
        """Share of the work done, 0..1."""
        return (self.position + self.frame / max(self.n_frames, 1)) / self.n_rules

    def __str__(self) -> str:
        return f"{self.rule} ({self.position + 1} of {self.n_rules}): frame {self.frame} of {self.n_frames}"


def compare_rules(
    rules: "Iterable[str | SeedingRule | Entrant]",
    data: "str | OpenedSequence | Sequence[str | OpenedSequence]" = "room",
    config: SystemConfig | None = None,
    *,
    budget: Budget | None = None,
    seeds: int = 1,
    on_progress: Callable[[CompareProgress], bool | None] | None = None,
) -> Leaderboard:
    """Map ``data`` with each rule and score the views that were held out.

    Nothing is written to disk, and neither the mapped views nor the mesh are scored; ``LiveTable`` does these.
    Ctrl-C (in a notebook: interrupt the kernel) ends it between two frames; the results of finished rules are kept.

    Args:
        rules: Names, functions or ``Entrant``, which also carries options; no two of the same label.
        data: Name or folder of a sequence, or an open sequence; some of its views must be held out. Or several of them:
            then a row has the means over all.
        config: Settings of all runs, of any system; only the rule and its options are replaced. By default those of
            the room without global optimisation.
        budget: What every rule may spend. By default each rule has as many Gaussians as it makes, and as many gradient
            steps as follow from them; the table then says how much they differ.
        seeds: Number of runs of each rule on each sequence: seeds ``config.seed``, the next one, and so on.
        on_progress: Called after each frame; returns True to stop. By default a progress bar is shown.

    Raises:
        KeyError, TypeError, ValueError: as for ``entries_of``. ValueError also if no view is held out. A rule that
            raises an error while mapping is listed in ``failed``.
    """
    config = config or gsfusion_preset("room", optim__global_iterations=0)
    scenes = [data] if isinstance(data, (str, OpenedSequence)) else list(data)
    sequences = [open_sequence(d, data=config.data) if isinstance(d, str) else d for d in scenes]
    if any(len(sequence.held_out) == 0 for sequence in sequences):
        raise ValueError("compare_rules scores views that were not mapped; set data.hold_out_every to 2 or more")
    entries = entries_of(
        rules, sequences, seeds=range(config.seed, config.seed + seeds), budgets=[budget or Budget(steps="own")],
        config=config,
    )  # fmt: skip
    about = [f"{len(scenes)} sequences"] * (len(scenes) > 1) + [f"{seeds} seeds"] * (seeds > 1)
    board = Leaderboard(sequence=", ".join(s.name for s in sequences), means_over=" and ".join(about))
    with ProgressDisplay("rules", total=100, leave=False, shown=on_progress is None) as display:
        try:
            for progress in _fill(board, entries):
                note = f"{progress.rule} {progress.frame}/{progress.n_frames}"
                display.show(round(100 * progress.share), note=note)
                if on_progress is not None and on_progress(progress):
                    break
        except KeyboardInterrupt:
            pass
    return board


def _fill(board: Leaderboard, entries: Sequence[Entry]) -> Iterator[CompareProgress]:
    """Run one rule after the other, one frame per step; finished rules are added to ``board``."""
    names = list(dict.fromkeys(entry.spec.label for entry in entries))
    for position, name in enumerate(names):
        own = [entry for entry in entries if entry.spec.label == name]
        n_frames = sum(len(entry.opened().mapping) for entry in own)
        progress = CompareProgress(rule=name, position=position, n_rules=len(names), frame=0, n_frames=n_frames)
        results: list[RunResult] = []
        for entry in own:
            steps = run_steps(entry, everything=False)
            while True:
                try:
                    report = next(steps)
                except StopIteration as ended:
                    results.append(ended.value)
                    break
                progress = dataclasses.replace(progress, frame=progress.frame + (report is not None))
                yield progress
            if results[-1].status == "failed":
                board.failed[name] = results[-1].reason
                break
        else:
            board.rows.append(mean_row(name, results))
        yield progress
    board.complete = True


def mean_row(name: str, results: Sequence[RunResult]) -> LeaderboardRow:
    """The row of a rule: means over its runs, which are all done."""

    def mean(metric: str) -> float:
        """NaN if it could not be computed (images too small for SSIM)."""
        values = [r.metrics.get(metric, math.nan) for r in results]
        return sum(values) / len(values)

    return LeaderboardRow(
        name=name,
        key=results[0].key,
        psnr_db=mean("psnr_held_out_db"),
        psnr_sd_db=summarise(r.metrics.get("psnr_held_out_db", math.nan) for r in results).sd,
        ssim=mean("ssim_held_out"),
        n_gaussians=round(mean("n_gaussians")),
        n_keyframes=round(mean("n_keyframes")),
        n_steps=round(mean("n_steps")),
        ms_per_frame=mean("ms_per_frame"),
        cpu_ms_per_frame=mean("cpu_ms_per_frame"),
        seeding_ms=mean("seeding_ms"),
    )
