"""Compare seeding rules in one call: runs on the same frames with the same settings fill a leaderboard."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from ..config import SystemConfig
from ..config import gsfusion as gsfusion_preset
from ..data import OpenedSequence, open_sequence
from ..progress import ProgressDisplay
from ..seeding import SeedingRule
from .entrant import Entrant
from .entries import entries_of
from .leaderboard import Leaderboard, LeaderboardRow
from .map_scene import Entry
from .one_run import run_steps
from .result import RunResult
from .spec import Budget
from .statistics import summarise


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
