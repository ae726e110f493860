"""Compare seeding rules in a notebook: runs on the same frames with the same settings, and one table."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from ..config import SystemConfig
from ..config import gsfusion as gsfusion_preset
from ..data import OpenedSequence, open_sequence, sequence_fingerprint
from ..mapping import StepReport, get_system, system_of
from ..progress import ProgressDisplay
from ..seeding import SeedingRule
from ..seeding.rule_file import find_rule
from .entrant import Entrant
from .leaderboard import Leaderboard, LeaderboardRow
from .map_scene import Entry
from .one_run import run_steps
from .result import RunResult
from .setting_names import changed_settings
from .spec import Budget
from .statistics import summarise


@dataclass(frozen=True, kw_only=True)
class ContestProgress:
    """Progress of a contest."""

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


class Contest:
    """Runs rules one after another; ``steps()`` can be interrupted between frames and continued.

    Args:
        rules: Names, functions or ``Entrant``; no two of the same name.
        data: Name or folder of a sequence, or an open sequence; some of its views must be held out. Or several of them:
            then a row has the means over all.
        config: Settings of every run, of either system; only the rule and its options are replaced.
        budget: What every rule may spend. By default each rule has as many Gaussians as it makes, and as many gradient
            steps as follow from them; the table then says how much they differ.
        seeds: Number of runs of each rule on each sequence: seeds ``config.seed``, the next one, and so on.

    Raises:
        KeyError: unknown rule. TypeError: a rule with a wrong signature. ValueError: no rule, two rules with the same
            name, or no held-out view.
    """

    def __init__(
        self,
        rules: "Iterable[str | SeedingRule | Entrant]",
        data: "str | OpenedSequence | Sequence[str | OpenedSequence]" = "room",
        config: SystemConfig | None = None,
        *,
        budget: Budget | None = None,
        seeds: int = 1,
    ):
        self.entrants = [rule if isinstance(rule, Entrant) else Entrant(rule) for rule in rules]
        names = [entrant.name for entrant in self.entrants]
        for entrant in self.entrants:
            find_rule(entrant.rule)
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice or not names:
            raise ValueError(f"compare_rules needs rules with different names, got {', '.join(twice) or 'none'}")
        self.config = config or gsfusion_preset("room", optim__global_iterations=0)
        self.budget = budget or Budget(steps="own")
        scenes = [data] if isinstance(data, (str, OpenedSequence)) else list(data)
        self.sequences = [open_sequence(d, data=self.config.data) if isinstance(d, str) else d for d in scenes]
        if any(len(sequence.held_out) == 0 for sequence in self.sequences):
            raise ValueError("compare_rules scores views that were not mapped; set data.hold_out_every to 2 or more")
        self.entries = [self._entries(entrant, seeds) for entrant in self.entrants]
        """The runs of each rule."""
        about = [f"{len(scenes)} sequences"] * (len(scenes) > 1) + [f"{seeds} seeds"] * (seeds > 1)
        self.board = Leaderboard(sequence=", ".join(s.name for s in self.sequences), means_over=" and ".join(about))
        self.results: list[RunResult] = []
        """The results of all runs so far, for ``write_outputs``."""
        self.curves: dict[str, list[float]] = {"Gaussians, this rule": [], "PSNR of the frame, dB": []}
        """Curves of the run that is going on, one value per frame."""

    @property
    def sequence(self) -> OpenedSequence:
        """The first sequence."""
        return self.sequences[0]

    @property
    def n_frames(self) -> int:
        """Number of frames that a rule maps, in all its runs."""
        return sum(len(entry.opened().mapping) for entry in self.entries[0])

    def steps(self) -> Iterator[ContestProgress]:
        """Run the remaining rules, one frame per step; finished rules are in ``board``. An interrupted rule starts
        again."""
        first = len(self.board.rows) + len(self.board.failed)
        for position in range(first, len(self.entrants)):
            yield from self._run(position)
        self.board.complete = True

    def _entries(self, entrant: Entrant, seeds: int) -> list[Entry]:
        """The runs of a rule: on every sequence with every seed."""
        system = system_of(self.config)
        settings = changed_settings(self.config, get_system(system).preset("room"))
        for name in ("seeding.rule", "seeding.options", "seed"):
            settings.pop(name, None)
        return [
            entrant.entry(
                sequence=sequence, scene=sequence.name, data_hash=sequence_fingerprint(sequence),
                seed=self.config.seed + seed, budget=self.budget, system=system, preset="room", settings=settings,
            )
            for sequence in self.sequences
            for seed in range(seeds)
        ]  # fmt: skip

    def _run(self, position: int) -> Iterator[ContestProgress]:
        name, frame, results = self.entrants[position].name, 0, []
        place = {"rule": name, "position": position, "n_rules": len(self.entrants), "n_frames": self.n_frames}
        for entry in self.entries[position]:
            for values in self.curves.values():
                values.clear()
            run = run_steps(entry, everything=False)
            while True:
                try:
                    report = next(run)
                except StopIteration as ended:
                    results.append(ended.value)
                    break
                frame += report is not None
                self._draw(report)
                yield ContestProgress(frame=frame, **place)
            if results[-1].status == "failed":
                self.board.failed[name] = results[-1].reason
                self.results += results
                return
        self.results += results
        self.board.rows.append(mean_row(name, results))
        yield ContestProgress(frame=frame, **place)

    def _draw(self, report: StepReport | None) -> None:
        if report is not None:
            for values, value in zip(self.curves.values(), (report.n_gaussians, report.psnr_after_db), strict=True):
                values.append(value)


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


def compare_rules(
    rules: "Iterable[str | SeedingRule | Entrant]",
    data: "str | OpenedSequence | Sequence[str | OpenedSequence]" = "room",
    config: SystemConfig | None = None,
    *,
    budget: Budget | None = None,
    seeds: int = 1,
    on_progress: Callable[[ContestProgress], bool | None] | None = None,
) -> Leaderboard:
    """Map ``data`` with each rule and score the views that were held out.

    Ctrl-C (in a notebook: interrupt the kernel) ends it between two frames; the results of finished rules are kept.

    Args:
        rules: Names, functions or ``Entrant``, which also carries options.
        data: Name or folder of a sequence, an open sequence, or several of them.
        config: Settings of all runs; by default those of the room without global optimisation.
        budget: What every rule may spend; by default whatever it does. See ``Contest``.
        seeds: Number of runs of each rule on each sequence.
        on_progress: Called after each frame; returns True to stop. By default a progress bar is shown.

    Raises:
        KeyError, TypeError, ValueError: as for ``Contest``. A rule that raises an error while mapping is listed in
            ``failed``.
    """
    contest = Contest(rules, data, config, budget=budget, seeds=seeds)
    with ProgressDisplay("contest", total=100, leave=False, shown=on_progress is None) as display:
        try:
            for progress in contest.steps():
                note = f"{progress.rule} {progress.frame}/{progress.n_frames}"
                display.show(round(100 * progress.share), note=note)
                if on_progress is not None and on_progress(progress):
                    break
        except KeyboardInterrupt:
            pass
    return contest.board
