"""The file that describes a comparison: rules x scenes x seeds x budgets. All of it is checked before anything runs."""

import contextlib
import itertools
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ..checks import check_name, shown
from ..files import SequenceError, read_text
from ..seeding.rule_code import is_rule_file, read_rule_file
from .entries import check_run
from .map_scene import Entry
from .outputs import Table
from .spec import Budget, RunSpec, identity_of, label_of

_TOP = {"seeds": (int, list), "reference": (str,), "system": (str,), "preset": (str,), "device": (str,),
        "settings": (dict,), "rules": (list,), "scenes": (list,), "budgets": (list,)}  # fmt: skip
_RULE = {"rule": (str,), "label": (str,), "options": (dict,), "size_option": (str,), "size_range": (list,),
         "tuned_on": (str,), "settings": (dict,)}  # fmt: skip
_SCENE = {"data": (str,), "label": (str,), "reader": (dict,), "settings": (dict,), "preset": (str,)}
_BUDGET = {"steps": (str,), "gaussians": (int,), "tolerance": (int, float)}
Kinds = Mapping[str, tuple[type, ...]]


class TableError(ValueError):
    """What is wrong in a file that describes a comparison, and where."""


@contextlib.contextmanager
def _at(path: Path, place: str) -> Iterator[None]:
    """A block whose errors are said with their place in the file."""
    try:
        yield
    except (SequenceError, ValueError, TypeError, KeyError, OSError) as e:
        what = e.args[0] if isinstance(e, KeyError) and e.args else e
        raise TableError(f"{path}: {place}: {what}") from None


def read_table(path: str | Path) -> Table:
    """Read and check the file of a comparison.

    Raises:
        TableError: a mistake, with its place in the file. FileNotFoundError: no such file.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; gsfusion-nb lab --new {path} writes an example")
    text = read_text(path, "the file of a comparison")
    with _at(path, "TOML"):
        top = _checked(tomllib.loads(text), _TOP)
    shared: dict[str, Any] = {name: top[name] for name in ("system", "preset", "device") if name in top}
    shared["settings"] = _dotted(top.get("settings", {}))
    with _at(path, "settings"):
        RunSpec(rule="uniform", **shared).config()
    given = top.get("seeds", 1)
    seeds = list(range(given)) if isinstance(given, int) else given
    if not seeds or any(not isinstance(s, int) or isinstance(s, bool) or s < 0 for s in seeds):
        raise TableError(f"{path}: seeds: expected a number of seeds, or a list of whole numbers, got {shown(given)}")
    budgets = _made(path, top, "budgets", _BUDGET, "", lambda values: Budget(**values)) or [Budget()]
    tuned = next((budget for budget in budgets if budget.gaussians is not None), budgets[0])
    rules = _made(path, top, "rules", _RULE, "rule", lambda values: _rule(path, values, shared, tuned), "label")
    scenes = _made(path, top, "scenes", _SCENE, "data", lambda values: _scene(path, values, shared), "scene")
    reference = top.get("reference", "")
    if reference:
        with _at(path, "reference"):
            check_name("rule", reference, [rule["label"] for rule in rules])
    tuned_on = {rule["label"]: words for rule in rules if (words := rule.pop("tuned_on", ""))}
    specs = [
        RunSpec(**_merged(shared, scene, rule), budget=budget, seed=seed)
        for scene, budget, rule, seed in itertools.product(scenes, budgets, rules, seeds)
    ]
    return Table(specs=specs, text=text, reference=reference, tuned_on=tuned_on)


def _made(
    path: Path,
    top: Mapping[str, Any],
    name: str,
    known: Kinds,
    required: str,
    make: Callable[[dict[str, Any]], Any],
    label: str = "",
) -> list[Any]:
    """What ``make`` gives for the checked values of each table [[name]]; no two have the same ``label``, if one is
    named."""
    found, tables = [], top.get(name, [])
    if required and not tables:
        raise TableError(f"{path}: expected at least one table [[{name}]] with {required} = ..., got none")
    for i, values in enumerate(tables):
        with _at(path, f"{name}[{i}]"):
            if not isinstance(values, dict) or (required and required not in values):
                raise ValueError(f"expected a table with the key {required or 'steps'}, got {shown(values)}")
            made = make(_checked(values, known))
            if label and any(other[label] == made[label] for other in found):
                raise ValueError(f"expected labels that differ, got {shown(made[label])} twice")
            found.append(made)
    return found


def _checked(values: dict[str, Any], known: Kinds) -> dict[str, Any]:
    for name, value in values.items():
        check_name("key", name, known)
        if isinstance(value, bool) or not isinstance(value, known[name]):
            kinds = " or ".join(kind.__name__ for kind in known[name])
            raise ValueError(f"{name}: expected {kinds}, got {shown(value)}")
    return values


def _merged(shared: Mapping[str, Any], *others: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a run; settings are joined, the later ones count."""
    parts: dict[str, Any] = {**shared}
    for other in others:
        parts |= {**other, "settings": parts["settings"] | other["settings"]}
    return parts


def _rule(path: Path, values: dict[str, Any], shared: Mapping[str, Any], budget: Budget) -> dict[str, Any]:
    """A rule as fields of a run, and ``tuned_on``, checked for a budget."""
    options = values.get("options", {})
    parts = {"label": label_of(values["rule"].rpartition(":")[2], options), **values}
    parts["settings"] = _dotted(values.get("settings", {}))
    tuned_on = parts.pop("tuned_on", "")
    if is_rule_file(parts["rule"]):
        parts["rule_source"], _ = read_rule_file(str(path.parent / parts["rule"]))
    if "size_range" in parts:
        parts["size_range"] = tuple(parts["size_range"])
    spec = RunSpec(**_merged(shared, parts), budget=budget)
    rule = Entry(spec=spec).found_rule()
    check_run(spec, rule)
    return parts | identity_of(rule, options) | {"tuned_on": tuned_on}


def _scene(path: Path, values: dict[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """A scene as fields of a run."""
    data = values["data"]
    if data != "room" and not Path(data).expanduser().is_absolute():
        beside = path.parent / data
        data = str(beside if beside.is_dir() else Path(data).resolve())
    parts: dict[str, Any] = {"preset": values["preset"]} if "preset" in values else {}
    parts |= {"data": data, "scene": values.get("label", Path(values["data"]).name)}
    parts |= {"reader": values.get("reader", {}), "settings": _dotted(values.get("settings", {}))}
    if len(Entry(spec=RunSpec(rule="uniform", **_merged(shared, parts))).opened().held_out) == 0:
        raise ValueError("no view is held out for the scores: set data.hold_out_every to 2 or more")
    return parts


def _dotted(values: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Settings by dotted name, also where the file nests them."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        full = f"{path}{name}".replace("-", "_")
        found |= _dotted(value, f"{full}.") if isinstance(value, dict) and full != "seeding.options" else {full: value}
    return found


EXAMPLE = Path(__file__).with_name("example.toml").read_text(encoding="utf-8")
"""A commented example of the file that describes a comparison."""
