"""The TOML file that describes a comparison. All of it is checked before anything runs; the message
of a mistake says where in the file it is."""

import contextlib
import itertools
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..checks import check_name, shown
from ..errors import ArgumentError, ForeseenError, SequenceError
from ..files import read_text
from ..seeding.code_files import code_folder, is_code_file, read_code_file
from ..seeding.named_code import (
    CodeNotNamedError,
    RuleNotNamedError,
    SystemNotNamedError,
    TrainingNotNamedError,
    is_named,
)
from .entries import check_run
from .map_scene import Entry
from .outputs import Table
from .paired_tests import TESTS
from .spec import Budget, RunSpec, label_of, system_fields
from .training_code import training_code

_TOP = {
    "seeds": (int, list),
    "reference": (str,),
    "tests": (str,),
    "system": (str,),
    "preset": (str,),
    "device": (str,),
    "fidelity": (str,),
    "loss": (str,),
    "optimiser": (str,),
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
    "loss": (str,),
    "optimiser": (str,),
    "settings": (dict,),
}
_SCENE = {
    "data": (str,),
    "label": (str,),
    "reader": (dict,),
    "extra": (dict,),
    "settings": (dict,),
    "preset": (str,),
}
_TRAINING = ("loss", "optimiser")
_BUDGET = {"steps": (str,), "gaussians": (int,), "tolerance": (int, float)}
Kinds = Mapping[str, tuple[type, ...]]


class TableError(ForeseenError, ValueError):
    """What is wrong in a file that describes a comparison, and where."""


@contextlib.contextmanager
def _at(path: Path, place: str) -> Iterator[None]:
    """A block whose errors are said with their place in the file."""
    try:
        yield
    except CodeNotNamedError:
        raise
    except (SequenceError, ValueError, TypeError, KeyError, OSError) as e:
        what = e.args[0] if isinstance(e, KeyError) and e.args else e
        raise TableError(f"{path}: {place}: {what}") from None


def read_table(
    path: str | Path,
    *,
    rule_files: Sequence[str | Path] = (),
    system_files: Sequence[str | Path] = (),
) -> Table:
    """Read and check the file of a comparison.

    Args:
        path: Of the file.
        rule_files, system_files: The files of rules and systems that it names and that may be
            executed; those of losses and optimisers are among the first.

    Raises:
        CodeNotNamedError: it asks for a rule or a system in a file that is not among them; nothing
            of it was executed.
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
        name: top[name] for name in ("preset", "device", "fidelity") if name in top
    }
    if "system" in top:
        with _at(path, "system"):
            shared |= _system(path, top["system"], system_files)
    with _at(path, "loss or optimiser"):
        shared["training"] = _training(path, top, rule_files)
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
        lambda values: _rule(path, values, shared, size_budget, rule_files),
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
        str(path.parent / text) for text in texts if isinstance(text, str) and is_code_file(text)
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


def _training(
    path: Path, values: Mapping[str, Any], code_files: Sequence[str | Path]
) -> dict[str, dict[str, str]]:
    """Loss and optimiser that a table names, as the field of a run. Raises
    ``TrainingNotNamedError`` if the caller did not name their files."""
    places = {kind: str(path.parent / values[kind]) for kind in _TRAINING if kind in values}
    for place in places.values():
        file = place.rpartition(":")[0]
        if file.endswith(".py") and not is_named(file, code_files):
            raise TrainingNotNamedError(
                path, [place], f"read_table({str(path)!r}, rule_files={[file]})"
            )
    return training_code(**places)


def _system(path: Path, text: str, system_files: Sequence[str | Path]) -> dict[str, str]:
    """The system of all runs, as fields of a run. Raises ``SystemNotNamedError`` if it is in a file
    that the caller did not name."""
    if not is_code_file(text):
        return system_fields(text)
    place = str(path.parent / text)
    file = place.rpartition(":")[0]
    if not is_named(file, system_files):
        how = f"read_table({str(path)!r}, system_files=[{file!r}])"
        raise SystemNotNamedError(path, [place], how)
    return system_fields(place)


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
    code_files: Sequence[str | Path],
) -> dict[str, Any]:
    """A rule as fields of a run, and ``tuned_on``, checked for a budget."""
    options = values.get("options", {})
    parts = {"label": label_of(values["rule"].rpartition(":")[2], options), **values}
    parts["settings"] = _flat_names(values.get("settings", {}))
    tuned_on = parts.pop("tuned_on", "")
    own = _training(path, parts, code_files)
    parts = {name: value for name, value in parts.items() if name not in _TRAINING}
    parts["training"] = {**shared["training"], **own}
    if is_code_file(parts["rule"]):
        place = str(path.parent / parts["rule"])
        parts["rule_source"], _ = read_code_file(place)
        parts["rule_folder"] = str(code_folder(place))
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
    extra = {"extra": values["extra"]} if "extra" in values else {}
    parts |= {
        "reader": values.get("reader", {}) | extra,
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
