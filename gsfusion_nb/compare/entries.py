"""What takes part in a comparison: rules x scenes x seeds x budgets, given in Python or in a TOML
file. All of it is checked before anything runs."""

import contextlib
import hashlib
import itertools
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..checks import check_name, shown
from ..config import SystemConfig, gsfusion
from ..data import OpenedSequence, open_sequence, sequence_fingerprint
from ..errors import ArgumentError, ForeseenError, SequenceError
from ..files import read_text
from ..mapping import get_system, system_of
from ..seeding import Option, SeedingRule, check_options, rule_name
from ..seeding.named_rules import RuleNotNamedError, is_named
from ..seeding.rule_code import find_rule, is_rule_file, read_rule_file, rule_folder
from ..work import ProgressDisplay
from .map_scene import Entry
from .outputs import Results, Table
from .paired_tests import TESTS
from .run_all import ResultStore, run_all
from .schedule import changed_settings
from .spec import Budget, RunResult, RunSpec, label_of
from .tune import size_option, start_value


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
        file = rule if isinstance(rule, str) and is_rule_file(rule) else ""
        source = read_rule_file(file)[0] if file else ""
        own_rule = find_rule(rule)
        check_options(own_rule, self.options)
        spec = RunSpec(
            rule=rule if isinstance(rule, str) else rule_name(rule),
            label=self.name,
            options=self.options,
            size_option=self.size_option,
            size_range=self.size_range,
            rule_source=source,
            rule_folder=str(rule_folder(file)) if file else "",
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
    system = system_of(config)
    settings = changed_settings(config, get_system(system).preset("room"))
    for name in ("seeding.rule", "seeding.options", "seed"):
        settings.pop(name, None)
    return {"system": system, "preset": "room", "settings": settings}


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


_TOP = {
    "seeds": (int, list),
    "reference": (str,),
    "tests": (str,),
    "system": (str,),
    "preset": (str,),
    "device": (str,),
    "settings": (dict,),
    "rules": (list,),
    "scenes": (list,),
    "budgets": (list,),
}
_RULE = {
    "rule": (str,),
    "label": (str,),
    "options": (dict,),
    "size_option": (str,),
    "size_range": (list,),
    "tuned_on": (str,),
    "settings": (dict,),
}
_SCENE = {"data": (str,), "label": (str,), "reader": (dict,), "settings": (dict,), "preset": (str,)}
_BUDGET = {"steps": (str,), "gaussians": (int,), "tolerance": (int, float)}
Kinds = Mapping[str, tuple[type, ...]]


class TableError(ForeseenError, ValueError):
    """What is wrong in a file that describes a comparison, and where."""


@contextlib.contextmanager
def _at(path: Path, place: str) -> Iterator[None]:
    """A block whose errors are said with their place in the file."""
    try:
        yield
    except RuleNotNamedError:
        raise
    except (SequenceError, ValueError, TypeError, KeyError, OSError) as e:
        what = e.args[0] if isinstance(e, KeyError) and e.args else e
        raise TableError(f"{path}: {place}: {what}") from None


def read_table(
    path: str | Path,
    *,
    rule_files: Sequence[str | Path] = (),
) -> Table:
    """Read and check the file of a comparison.

    Args:
        path: Of the file.
        rule_files: The files of rules that it names and that may be executed.

    Raises:
        RuleNotNamedError: it asks for a rule in a file that is not among ``rule_files``; nothing
            was executed.
        TableError: a mistake, with its place in the file. FileNotFoundError: no such file.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; gsfusion-nb lab --new {path} writes an example"
        )
    text = read_text(path, "the file of a comparison")
    with _at(path, "TOML"):
        top = _valid_values(tomllib.loads(text), _TOP)
    _refuse_unnamed(path, top.get("rules", []), rule_files)
    shared: dict[str, Any] = {
        name: top[name] for name in ("system", "preset", "device") if name in top
    }
    shared["settings"] = _flat_names(top.get("settings", {}))
    with _at(path, "settings"):
        RunSpec(rule="uniform", **shared).config()
    seed_setting = top.get("seeds", 1)
    seeds = list(range(seed_setting)) if isinstance(seed_setting, int) else seed_setting
    if not seeds or any(not isinstance(s, int) or isinstance(s, bool) or s < 0 for s in seeds):
        raise TableError(
            f"{path}: seeds: expected a number of seeds, or a list of whole numbers, got "
            f"{shown(seed_setting)}"
        )
    budgets = _items_of(
        path,
        top,
        "budgets",
        _BUDGET,
        "",
        lambda values: Budget(**values),
    ) or [Budget()]
    size_budget = next((budget for budget in budgets if budget.gaussians is not None), budgets[0])
    rules = _items_of(
        path,
        top,
        "rules",
        _RULE,
        "rule",
        lambda values: _rule(path, values, shared, size_budget),
        "label",
    )
    scenes = _items_of(
        path, top, "scenes", _SCENE, "data", lambda values: _scene(path, values, shared), "scene"
    )
    reference = top.get("reference", "")
    if reference:
        with _at(path, "reference"):
            check_name("rule", reference, [rule["label"] for rule in rules])
    with _at(path, "tests"):
        check_name("test", tests := top.get("tests", "reference"), TESTS)
    tuned_on = {rule["label"]: words for rule in rules if (words := rule.pop("tuned_on", ""))}
    specs = [
        RunSpec(**_merge(shared, scene, rule), budget=budget, seed=seed)
        for scene, budget, rule, seed in itertools.product(scenes, budgets, rules, seeds)
    ]
    return Table(specs=specs, text=text, reference=reference, tests=tests, tuned_on=tuned_on)


def _refuse_unnamed(
    path: Path,
    rules: list[Any],
    rule_files: Sequence[str | Path],
) -> None:
    """Raise ``RuleNotNamedError`` with all rules in files that the caller did not name."""
    texts = [values.get("rule") for values in rules if isinstance(values, dict)]
    rules_in_files = [
        str(path.parent / text) for text in texts if isinstance(text, str) and is_rule_file(text)
    ]
    if missing := [
        rule
        for rule in dict.fromkeys(rules_in_files)
        if not is_named(rule.rpartition(":")[0], rule_files)
    ]:
        files = [rule.rpartition(":")[0] for rule in missing]
        raise RuleNotNamedError(
            path, missing, f"read_table({str(path)!r}, rule_files={list(dict.fromkeys(files))})"
        )


def _items_of(
    path: Path,
    top: Mapping[str, Any],
    name: str,
    kinds: Kinds,
    required: str,
    make: Callable[[dict[str, Any]], Any],
    label: str = "",
) -> list[Any]:
    """What ``make`` gives for the checked values of each table [[name]]; no two have the same
    ``label``, if one is named."""
    items = []
    tables = top.get(name, [])
    if required and not tables:
        raise TableError(
            f"{path}: expected at least one table [[{name}]] with {required} = ..., got none"
        )
    for i, values in enumerate(tables):
        with _at(path, f"{name}[{i}]"):
            if not isinstance(values, dict) or (required and required not in values):
                raise ArgumentError(
                    f"expected a table with the key {required or 'steps'}, got {shown(values)}"
                )
            item = make(_valid_values(values, kinds))
            if label and any(other[label] == item[label] for other in items):
                raise ArgumentError(f"expected labels that differ, got {shown(item[label])} twice")
            items.append(item)
    return items


def _valid_values(values: dict[str, Any], allowed_kinds: Kinds) -> dict[str, Any]:
    for name, value in values.items():
        check_name("key", name, allowed_kinds)
        if isinstance(value, bool) or not isinstance(value, allowed_kinds[name]):
            kinds = " or ".join(kind.__name__ for kind in allowed_kinds[name])
            raise ArgumentError(f"{name}: expected {kinds}, got {shown(value)}")
    return values


def _merge(
    shared: Mapping[str, Any],
    *others: Mapping[str, Any],
) -> dict[str, Any]:
    """Fields of a run; settings are joined, the later ones count."""
    parts: dict[str, Any] = {**shared}
    for other in others:
        parts |= {**other, "settings": parts["settings"] | other["settings"]}
    return parts


def _rule(
    path: Path,
    values: dict[str, Any],
    shared: Mapping[str, Any],
    budget: Budget,
) -> dict[str, Any]:
    """A rule as fields of a run, and ``tuned_on``, checked for a budget."""
    options = values.get("options", {})
    parts = {"label": label_of(values["rule"].rpartition(":")[2], options), **values}
    parts["settings"] = _flat_names(values.get("settings", {}))
    tuned_on = parts.pop("tuned_on", "")
    if is_rule_file(parts["rule"]):
        place = str(path.parent / parts["rule"])
        parts["rule_source"], _ = read_rule_file(place)
        parts["rule_folder"] = str(rule_folder(place))
    if "size_range" in parts:
        parts["size_range"] = tuple(parts["size_range"])
    spec = RunSpec(**_merge(shared, parts), budget=budget)
    rule = spec.found_rule()
    check_run(spec, rule)
    spec_with_code = spec.with_code(rule)
    return parts | {
        "code": spec_with_code.code,
        "not_kept": spec_with_code.not_kept,
        "tuned_on": tuned_on,
    }


def _scene(
    path: Path,
    values: dict[str, Any],
    shared: Mapping[str, Any],
) -> dict[str, Any]:
    """A scene as fields of a run."""
    data = values["data"]
    if data != "room" and not Path(data).expanduser().is_absolute():
        neighbour = path.parent / data
        data = str(neighbour if neighbour.is_dir() else Path(data).resolve())
    parts: dict[str, Any] = {"preset": values["preset"]} if "preset" in values else {}
    parts |= {"data": data, "scene": values.get("label", Path(values["data"]).name)}
    parts |= {
        "reader": values.get("reader", {}),
        "settings": _flat_names(values.get("settings", {})),
    }
    if len(Entry(spec=RunSpec(rule="uniform", **_merge(shared, parts))).opened().held_out) == 0:
        raise ArgumentError(
            "no view is held out for the scores: set data.hold_out_every to 2 or more"
        )
    return parts


def _flat_names(
    values: Mapping[str, Any],
    path: str = "",
) -> dict[str, Any]:
    """Settings by dotted name, also where the file nests them."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        full = f"{path}{name}".replace("-", "_")
        flat |= (
            _flat_names(value, f"{full}.")
            if isinstance(value, dict) and full != "seeding.options"
            else {full: value}
        )
    return flat


EXAMPLE = Path(__file__).with_name("example.toml").read_text(encoding="utf-8")
"""A commented example of the file that describes a comparison."""
