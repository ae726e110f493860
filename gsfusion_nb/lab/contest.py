"""Compare seeding rules: one run per rule on the same frames with the same settings, and one table."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from ..config import SystemConfig, to_dict
from ..config import gsfusion as gsfusion_preset
from ..config import replace as replaced
from ..data import OpenedSequence, open_sequence, sequence_fingerprint
from ..evaluation import ImageScores, NotComputed, score_views
from ..mapping import make_mapper
from ..progress import ProgressDisplay
from ..runs import MappingRun
from ..seeding import SeedingRule, get_rule, rule_fingerprint, rule_name
from .leaderboard import Leaderboard, LeaderboardRow
from .run_key import run_key
from .spec import label_of

Option = bool | int | float | str


@dataclass(frozen=True)
class Entrant:
    """A rule with options and a label: ``Entrant("uniform", {"fraction": 0.1}, "uniform 10 %")``."""

    rule: str | SeedingRule
    """Name of a registered rule, or the function."""
    options: Mapping[str, Option] = field(default_factory=dict)
    """Keyword arguments for it."""
    label: str = ""
    """Name in the table; made from rule and options if empty."""

    @property
    def name(self) -> str:
        """Name in the table."""
        return self.label or label_of(rule_name(self.rule), self.options)


@dataclass(frozen=True, kw_only=True)
class ContestProgress:
    """Progress of a contest."""

    rule: str
    position: int
    """Number of the rule, from 0."""
    n_rules: int
    frame: int
    """Frames mapped with this rule."""
    n_frames: int

    @property
    def share(self) -> float:
        """Share of the work done, 0..1."""
        return (self.position + self.frame / max(self.n_frames, 1)) / self.n_rules

    def __str__(self) -> str:
        return f"{self.rule} ({self.position + 1} of {self.n_rules}): frame {self.frame} of {self.n_frames}"


class Contest:
    """Runs rules one after another on one sequence; ``steps()`` can be interrupted between frames and continued.

    Args:
        rules: Names, functions or ``Entrant``; no two of the same name.
        data: Name or folder of a sequence, or an open sequence; some of its views must be held out.
        config: Settings of every run, of either system; only the rule and its options are replaced.

    Raises:
        KeyError: unknown rule. TypeError: a rule with a wrong signature. ValueError: no rule, two rules with the same
            name, or no held-out view.
    """

    def __init__(
        self,
        rules: "Iterable[str | SeedingRule | Entrant]",
        data: str | OpenedSequence = "room",
        config: SystemConfig | None = None,
    ):
        self.entrants = [rule if isinstance(rule, Entrant) else Entrant(rule) for rule in rules]
        names = [entrant.name for entrant in self.entrants]
        for entrant in self.entrants:
            get_rule(entrant.rule)
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice or not names:
            raise ValueError(f"compare_rules needs rules with different names, got {', '.join(twice) or 'none'}")
        self.config = config or gsfusion_preset("room", optim__global_iterations=0)
        self.sequence = open_sequence(data, data=self.config.data) if isinstance(data, str) else data
        if len(self.sequence.held_out) == 0:
            raise ValueError("compare_rules scores views that were not mapped; set data.hold_out_every to 2 or more")
        self.board = Leaderboard(sequence=self.sequence.name)
        self.curves: dict[str, list[float]] = {"Gaussians, this rule": [], "PSNR of the frame, dB": []}
        """Curves of the rule that is running, one value per frame."""
        self._warm = False
        self._data = sequence_fingerprint(self.sequence)

    def steps(self) -> Iterator[ContestProgress]:
        """Run the remaining rules, one frame per step; finished rules are in ``board``. An interrupted rule starts
        again."""
        self._warm_up()
        first = len(self.board.rows) + len(self.board.failed)
        for position in range(first, len(self.entrants)):
            yield from self._run(position)
        self.board.complete = True

    def _warm_up(self) -> None:
        """Load and compile what every run needs, so that it is not timed in the first run."""
        if not self._warm:
            self._warm = True
            scratch = MappingRun(self.sequence, make_mapper(self.config)).online()
            for _ in zip(range(2), scratch):  # noqa: B905
                pass

    def _run(self, position: int) -> Iterator[ContestProgress]:
        entrant = self.entrants[position]
        name = rule_name(entrant.rule)
        config = replaced(self.config, seeding__rule=name, seeding__options=dict(entrant.options))
        n, cpu_s = len(self.sequence.mapping), []
        place = {"rule": entrant.name, "position": position, "n_rules": len(self.entrants), "n_frames": n}
        for values in self.curves.values():
            values.clear()
        try:
            run = MappingRun(self.sequence, make_mapper(config, seeding=entrant.rule))
            frames = run.online()
            while True:
                began = time.process_time()
                report = next(frames, None)
                if report is None:
                    break
                cpu_s.append(time.process_time() - began)
                for values, value in zip(self.curves.values(), (report.n_gaussians, report.psnr_after_db), strict=True):
                    values.append(value)
                yield ContestProgress(frame=len(run.steps), **place)
            for _ in run.optimise():
                yield ContestProgress(frame=n, **place)
            scores = score_views(run.mapper.render, self.sequence.held_out)
        except (TypeError, ValueError, KeyError, IndexError, RuntimeError) as e:  # a user's rule may raise anything
            self.board.failed[entrant.name] = f"{type(e).__name__}: {e}"
            return
        self.board.rows.append(_row(entrant.name, run, cpu_s, scores, self._key(run)))
        yield ContestProgress(frame=n, **place)

    def _key(self, run: MappingRun) -> str:
        config, rule = to_dict(run.mapper.config), run.mapper.rule
        return run_key(data=self._data, system=run.system, config=config, rule=rule_fingerprint(rule))


def _row(name: str, run: MappingRun, cpu_s: list[float], scores: ImageScores, key: str) -> LeaderboardRow:
    later = run.steps[1:] or run.steps
    seeding_s = [s.seconds["seeding"] + s.seconds.get("quadtree", 0.0) for s in later]
    return LeaderboardRow(
        name=name,
        key=key,
        psnr_db=_number(scores.psnr),
        ssim=_number(scores.ssim),
        n_gaussians=len(run.mapper.gaussians),
        n_keyframes=len(run.mapper.keyframes),
        ms_per_frame=1e3 * sum(s.total_seconds for s in later) / len(later),
        cpu_ms_per_frame=1e3 * sum(cpu_s[-len(later) :]) / len(later),
        seeding_ms=1e3 * sum(seeding_s) / len(later),
    )


def _number(score: float | NotComputed) -> float:
    """NaN if a score could not be computed (images too small for SSIM)."""
    return math.nan if isinstance(score, NotComputed) else score


def compare_rules(
    rules: "Iterable[str | SeedingRule | Entrant]",
    data: str | OpenedSequence = "room",
    config: SystemConfig | None = None,
    *,
    on_progress: Callable[[ContestProgress], bool | None] | None = None,
) -> Leaderboard:
    """Map ``data`` once with each rule and score the views that were held out.

    Ctrl-C (in a notebook: interrupt the kernel) ends it between two frames; the results of finished rules are kept.

    Args:
        rules: Names, functions or ``Entrant``, which also carries options.
        data: Name or folder of a sequence, or an open sequence.
        config: Settings of all runs; by default those of the room without global optimisation.
        on_progress: Called after each frame; returns True to stop. By default a progress bar is shown.

    Raises:
        KeyError, TypeError, ValueError: as for ``Contest``. A rule that raises an error while mapping is listed in
            ``failed``.
    """
    contest = Contest(rules, data, config)
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
