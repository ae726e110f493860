"""Seeding rules compared in one call."""

from collections.abc import Iterable, Sequence

from ..config import SystemConfig
from ..config import gsfusion as gsfusion_preset
from ..data import OpenedSequence, open_sequence
from ..seeding import SeedingRule
from ..work import ProgressDisplay
from .entries import Entrant, entries_of
from .outputs import Results
from .run_all import ResultStore, run_all
from .spec import Budget, RunResult


def compare_rules(
    rules: "Iterable[str | SeedingRule | Entrant]",
    data: "str | OpenedSequence | Sequence[str | OpenedSequence]" = "room",
    config: SystemConfig | None = None,
    *,
    budget: Budget | None = None,
    seeds: int = 1,
) -> Results:
    """Map ``data`` with each rule and score the views that were held out.

    No folder is written; results are kept in the cache, and a run that is known is not repeated. Ctrl-C (in a
    notebook: interrupt the kernel) ends it; the results of finished runs are kept.

    Args:
        rules: Names, functions or ``Entrant``, which also carries options; no two of the same label.
        data: Name or folder of a sequence, or an open sequence; some of its views must be held out. Or several.
        config: Settings of all runs, of any system; only the rule and its options are replaced. By default those of
            the room without global optimisation.
        budget: What every rule may spend. By default each rule has as many Gaussians as it makes, and as many gradient
            steps as follow from them; the table then says how much they differ.
        seeds: Number of runs of each rule on each sequence: seeds ``config.seed``, the next one, and so on.

    Raises:
        KeyError, TypeError, ValueError: as for ``entries_of``. ValueError also if no view is held out. A rule that
            raises an error while mapping is listed as failed.
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
    with ProgressDisplay("rules", total=len(entries), unit="run", leave=False) as display:
        try:
            for i, result in run_all(entries, ResultStore()):
                found[i] = result
                display.show(len(found))
        except KeyboardInterrupt:
            pass
    return Results(runs=[found[i] for i in sorted(found)])
