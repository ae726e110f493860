"""What takes part in a comparison: rules x scenes x seeds x budgets. All of it is checked before
anything runs."""

import contextlib
import hashlib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..checks import check_name
from ..config import SystemConfig, gsfusion
from ..data import OpenedSequence, open_sequence, sequence_fingerprint
from ..errors import ArgumentError, SequenceError
from ..mapping.systems import system_class
from ..progress import ProgressDisplay
from ..seeding import Option, SeedingRule, check_options, rule_name
from ..seeding.code_files import code_folder, is_code_file, read_code_file
from ..seeding.rule_code import find_rule
from .map_scene import Entry
from .outputs import Results, Table
from .run_all import ResultStore, run_all
from .run_result import RunResult
from .schedule import changed_settings
from .size_options import size_option, start_value
from .spec import Budget, RunSpec, label_of, system_fields


@dataclass(frozen=True)
class Entrant:
    """A rule with options and a label:
    ``Entrant("uniform", {"fraction": 0.1}, "uniform 10 %")``."""

    rule: str | SeedingRule
    """Name of a registered rule, "FILE.py:name", or the rule itself."""
    options: Mapping[str, Option] = field(default_factory=dict)
    """Keyword arguments for it."""
    label: str = ""
    """Name in the table; made from rule and options if empty."""
    size_option: str = ""
    """Option that is tuned to reach a number of Gaussians; the rule's own if empty. "thin" keeps a
    random share of the seeds."""
    size_range: tuple[float | int, float | int] | None = None
    """Smallest and largest value of ``size_option``."""

    @property
    def name(self) -> str:
        """Name in the table."""
        return self.label or label_of(rule_name(self.rule).rpartition(":")[2], self.options)

    def entry(self, *, sequence: OpenedSequence | None = None, **fields: Any) -> Entry:
        """A run of this rule.

        Args:
            sequence: The frames, if they are open already.
            fields: The other fields of ``RunSpec``.

        Raises:
            ValueError: the file of the rule cannot be read. FileNotFoundError: it does not exist,
                or a file that an option names. KeyError, TypeError: no such rule, or an option that
                it does not have.
        """
        rule = self.rule
        file = rule if isinstance(rule, str) and is_code_file(rule) else ""
        source = read_code_file(file)[0] if file else ""
        own_rule = find_rule(rule)
        check_options(own_rule, self.options)
        spec = RunSpec(
            rule=rule if isinstance(rule, str) else rule_name(rule),
            label=self.name,
            options=self.options,
            size_option=self.size_option,
            size_range=self.size_range,
            rule_source=source,
            rule_folder=str(code_folder(file)) if file else "",
            **fields,
        ).with_code(own_rule)
        return Entry(spec=spec, rule=None if isinstance(rule, str) else rule, sequence=sequence)


def check_run(spec: RunSpec, rule: SeedingRule) -> None:
    """Check all of a run but its data.

    Raises:
        KeyError: unknown system or preset. TypeError: an option that the rule does not have, or of
            a wrong type.
        ValueError: a setting that does not exist, an invalid value, or no option that can be tuned.
    """
    spec.config()
    check_options(rule, spec.options)
    if spec.size_option or spec.budget.gaussians is not None:
        start_value(spec, rule, size_option(spec, rule))


def entries_of(
    rules: "Iterable[str | SeedingRule | Entrant]",
    scenes: "Iterable[str | OpenedSequence]" = ("room",),
    *,
    seeds: Iterable[int] = (0, 1, 2),
    budgets: Iterable[Budget] = (Budget(),),
    config: SystemConfig | None = None,
    **shared: Any,
) -> list[Entry]:
    """Every rule on every scene with every seed at every budget.

    The seeds change fastest, then the rules: the first rows of a table are complete early.

    Args:
        rules: Names, "FILE.py:name", functions or classes of a notebook, or ``Entrant``, which also
            carries options and a label.
        scenes: Folders of recordings, "room", or open sequences.
        seeds: One run each.
        budgets: What each rule may spend.
        config: Settings of all runs, of any system; its rule, the options of the rule and its seed
            are not used.
        shared: Other fields of ``RunSpec``, for all runs: ``settings={"tsdf.voxel_size_m": 0.02}``
            in place of ``config``.

    Raises:
        KeyError: unknown rule, system or preset. TypeError: a rule with a wrong signature, an
            option that it does not have or of a wrong type, or both ``config`` and ``settings``.
        ValueError: no rule, two rules with the same label, a file that cannot be read, a setting
            that does not exist, an invalid value, or a rule without an option to tune where the
            budget asks for it. FileNotFoundError: no such file.
    """
    entrants = [rule if isinstance(rule, Entrant) else Entrant(rule) for rule in rules]
    names = [entrant.name for entrant in entrants]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates or not names:
        problem = (
            f"{', '.join(duplicates)} twice; give one of them a label" if duplicates else "no rule"
        )
        raise ArgumentError(f"a comparison needs rules with different labels, got {problem}")
    for entrant in entrants:
        find_rule(entrant.rule)
    own = _fields_of_config(config) if config is not None else {}
    places = [_fields_of_scene(scene) for scene in scenes]
    entries = [
        entrant.entry(budget=budget, seed=seed, **place, **own, **shared)
        for budget, place, entrant, seed in itertools.product(budgets, places, entrants, seeds)
    ]
    for entry in entries:
        check_run(entry.spec, entry.found_rule())
    return entries


def _fields_of_scene(scene: str | OpenedSequence) -> dict[str, Any]:
    if isinstance(scene, str):
        return {"scene": scene}
    return {
        "sequence": scene,
        "scene": scene.name,
        "data_hash": sequence_fingerprint(scene) + _extra_hash(scene),
    }


def _extra_hash(scene: OpenedSequence) -> str:
    """A hash of ``frame.extra`` of all frames that are mapped; empty where the first has none and
    nothing gives any."""
    digest = hashlib.blake2b(digest_size=16)
    has_files = False
    for i in range(len(scene.mapping)):
        with contextlib.suppress(SequenceError):
            frame = scene.mapping[i]
            for name, image in sorted(frame.extra.items()):
                has_files = True
                digest.update(f"{frame.index} {name} {image.dtype} {tuple(image.shape)}".encode())
                digest.update(image.cpu().contiguous().numpy().tobytes())
            if not has_files and scene.mapping.extra is None:
                return ""
    return digest.hexdigest() if has_files else ""


def _fields_of_config(config: SystemConfig) -> dict[str, Any]:
    """System, preset, and the settings that differ from it; a run has its own rule, options and
    seed."""
    mapper = system_class(config)
    settings = changed_settings(config, mapper.preset("room"))
    for name in ("seeding.rule", "seeding.options", "seed"):
        settings.pop(name, None)
    return {**system_fields(mapper), "preset": "room", "settings": settings}


def compare_rules(
    rules: "Iterable[str | SeedingRule | Entrant]",
    data: "str | OpenedSequence | Sequence[str | OpenedSequence]" = "room",
    config: SystemConfig | None = None,
    *,
    budget: Budget | None = None,
    seeds: int = 1,
    reference: str = "",
) -> Results:
    """Map ``data`` with each rule and score the views that were held out.

    No folder is written; results are kept in the cache, and a run that is known is not repeated.
    Ctrl-C (in a notebook: interrupt the kernel) ends it; the results of finished runs are kept.

    Args:
        rules: Names, functions or ``Entrant``, which also carries options; no two of the same
            label.
        data: Name or folder of a sequence, or an open sequence; some of its views must be held out.
            Or several.
        config: Settings of all runs, of any system; only the rule and its options are replaced. By
            default those of the room without global optimisation.
        budget: What every rule may spend. By default each rule has as many Gaussians as it makes,
            and as many gradient steps as follow from them; the table then says how much they
            differ.
        seeds: Number of runs of each rule on each sequence: seeds ``config.seed``, the next one,
            and so on.
        reference: Label of the rule that all others are tested against. It must not be chosen by
            the results. By default ``gsfusion`` where it takes part, else the first.

    Raises:
        KeyError, TypeError, ValueError: as for ``entries_of``. KeyError also if there is no such
            reference, ValueError if no view is held out. A rule that raises an error while mapping
            is listed as failed.
    """
    config = config or gsfusion("room", optim__global_iterations=0)
    scenes = [data] if isinstance(data, (str, OpenedSequence)) else list(data)
    sequences = [open_sequence(d, data=config.data) if isinstance(d, str) else d for d in scenes]
    if any(len(sequence.held_out) == 0 for sequence in sequences):
        raise ArgumentError(
            "compare_rules scores views that were not mapped; set data.hold_out_every to 2 or more"
        )
    entries = entries_of(
        rules,
        sequences,
        seeds=range(config.seed, config.seed + seeds),
        budgets=[budget or Budget(steps="own")],
        config=config,
    )
    specs = [entry.spec for entry in entries]
    if reference:
        check_name("rule", reference, dict.fromkeys(spec.label for spec in specs))
    results: dict[int, RunResult] = {}
    with ProgressDisplay("rules", total=len(entries), unit="run", leave=False) as display:
        try:
            for i, result in run_all(entries, ResultStore()):
                results[i] = result
                display.show(len(results))
        except KeyboardInterrupt:
            pass
    return Results(
        runs=[results[i] for i in sorted(results)],
        about=Table(specs=specs, reference=reference),
    )
