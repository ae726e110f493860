"""Seeding rules compared in one call; and the results of runs as a notebook shows them."""

import dataclasses
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..config import SystemConfig
from ..config import gsfusion as gsfusion_preset
from ..data import OpenedSequence, open_sequence
from ..drawing.curves import figure_picture
from ..drawing.page import fill
from ..drawing.pictures import data_uri
from ..mapping import StepReport
from ..seeding import SeedingRule
from ..work import ProgressDisplay
from .entries import Entrant, entries_of
from .executors import InProcess, Task
from .outputs import all_tables, write_outputs
from .pareto import figure_of, pareto_front
from .run_all import ResultStore, run_all
from .spec import Budget, RunResult
from .statistics import FIRST_METRIC, Group, group_runs
from .tables import ResultTable, as_markdown, failures

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Results:
    """Results of runs: tables, the best first, and the Pareto plot. A notebook displays them."""

    runs: Sequence[RunResult]
    """In any order; those that failed, too."""
    complete: bool = True
    """False if it was stopped before all runs were done."""

    @property
    def groups(self) -> list[Group]:
        """The runs of each rule, scene and budget, with means: ``group.summary("n_gaussians").mean``."""
        return group_runs(self.runs)

    @property
    def front(self) -> list[str]:
        """Labels on the Pareto front of held-out PSNR and number of Gaussians, on any scene and budget."""
        found: dict[str, None] = {}
        for place in dict.fromkeys((g.scene, g.budget) for g in self.groups):
            here = [g for g in self.groups if (g.scene, g.budget) == place and g.runs]
            cost, quality = (np.array([g.summary(m).mean for g in here]) for m in ("n_gaussians", FIRST_METRIC))
            found |= {g.label: None for g, best in zip(here, pareto_front(cost, quality), strict=True) if best}
        return list(found)

    @property
    def failed(self) -> dict[str, str]:
        """Label -> why its first failed run failed."""
        return {r.spec.label: r.reason for r in reversed(self.runs) if r.status == "failed"}

    def __getitem__(self, label: str) -> Group:
        """All completed runs of a rule.

        Raises:
            KeyError: no run of this label.
        """
        own = [group for group in self.groups if group.label == label]
        if not own:
            raise KeyError(f"no rule {label!r}; there are: {', '.join(dict.fromkeys(g.label for g in self.groups))}")
        runs = tuple(run for group in own for run in group.runs)
        return dataclasses.replace(own[0], runs=runs)

    def tables(self) -> list[ResultTable]:
        """For each budget the rules with the scenes as columns, and a table of each scene."""
        return all_tables(self.runs)

    def figure(self) -> "Figure":
        """Held-out PSNR over each cost."""
        return figure_of(self.runs)

    def write(self, folder: str | Path) -> list[Path]:
        """Write what ``gsfusion-nb lab`` writes: ``outputs.write_outputs``. Returns the files."""
        return write_outputs(Path(folder), self.runs)

    def __repr__(self) -> str:
        lines = [f"{name} did not run: {reason}" for name, reason in self.failed.items()]
        lines += [] if self.complete else ["stopped before every rule had run"]
        return "\n\n".join([*map(as_markdown, self.tables()), *lines])

    def _repr_html_(self) -> str:
        picture = data_uri(figure_picture(self.figure()), "png")
        return fill("live_table.html", tables=self.tables(), failures=failures(self.runs), picture=picture)


@dataclass(frozen=True, kw_only=True)
class CompareProgress:
    """Progress of ``compare_rules``."""

    rule: str
    run: int
    """Number of the run, from 0."""
    n_runs: int
    frame: int
    """Frames mapped in this run."""
    n_frames: int

    @property
    def share(self) -> float:
        """Share of the work done, 0..1."""
        return (self.run + min(self.frame / max(self.n_frames, 1), 1.0)) / self.n_runs

    def __str__(self) -> str:
        return f"{self.rule} (run {self.run + 1} of {self.n_runs}): frame {self.frame} of {self.n_frames}"


class _StopError(BaseException):
    """Ends a run between two frames; no ``except Exception`` holds it back."""


def compare_rules(
    rules: "Iterable[str | SeedingRule | Entrant]",
    data: "str | OpenedSequence | Sequence[str | OpenedSequence]" = "room",
    config: SystemConfig | None = None,
    *,
    budget: Budget | None = None,
    seeds: int = 1,
    on_progress: Callable[[CompareProgress], bool | None] | None = None,
) -> Results:
    """Map ``data`` with each rule and score the views that were held out.

    No folder is written; results are kept in the shared cache, and a run that is known is not repeated. Ctrl-C (in a
    notebook: interrupt the kernel) ends it between two frames; the results of finished runs are kept.

    Args:
        rules: Names, functions or ``Entrant``, which also carries options; no two of the same label.
        data: Name or folder of a sequence, or an open sequence; some of its views must be held out. Or several.
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
    found: dict[int, RunResult] = {}
    n_frames = max(len(sequence.mapping) for sequence in sequences)
    progress = CompareProgress(rule="", run=0, n_runs=len(entries), frame=0, n_frames=n_frames)
    with (
        ProgressDisplay("rules", total=100, leave=False, shown=on_progress is None) as display,
        tempfile.TemporaryDirectory(prefix="gsfusion-compare-") as folder,
    ):

        def on_step(task: Task, report: StepReport | None) -> None:
            nonlocal progress
            is_new = (task.spec.label, len(found)) != (progress.rule, progress.run)
            frame = 0 if is_new else progress.frame + (report is not None)
            progress = dataclasses.replace(progress, rule=task.spec.label, run=len(found), frame=frame)
            display.show(round(100 * progress.share), note=f"{progress.rule} {progress.frame}/{progress.n_frames}")
            if report is not None and on_progress is not None and on_progress(progress):
                raise _StopError

        try:
            for i, result in run_all(entries, ResultStore(folder), InProcess(on_step)):
                found[i] = result
        except (KeyboardInterrupt, _StopError):
            pass
    return Results(runs=[found[i] for i in sorted(found)], complete=len(found) == len(entries))
