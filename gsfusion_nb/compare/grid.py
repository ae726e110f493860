"""Values of settings given on the command line as ``tsdf.voxel-size-m=0.01,0.02``, and all their combinations."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

from ..errors import SequenceError, shown
from ..foreign import parse_json
from ..seeding import check_options
from ..seeding.rule_code import is_rule_file, read_rule_file
from .map_scene import Entry
from .spec import RunSpec

RULE, OPTION = "seeding.rule", "rule."
"""The setting whose values are rules, and the beginning of the names of a rule's options."""
Axis = tuple[str, list[Any]]


def parse_axis(text: str) -> Axis:
    """Name and values of ``NAME=VALUE,VALUE,...``: numbers, true, false, or words.

    Raises:
        ValueError: no name, no value, or a value twice.
    """
    name, equals, values = text.partition("=")
    found = [_value(v.strip()) for v in values.split(",") if v.strip()]
    if not equals or not name or not found:
        raise ValueError(f"expected values of a setting as NAME=VALUE,VALUE, got {shown(text)}")
    if len({str(v) for v in found}) < len(found):
        raise ValueError(f"expected values that differ, got {shown(text)}")
    return name.strip().replace("-", "_"), found


def combinations(base: RunSpec, axes: Sequence[Axis]) -> list[RunSpec]:
    """``base`` with every combination of values, labelled with them: "voxel_size_m 0.01, threshold 0.1".

    Raises:
        ValueError, TypeError, KeyError: a setting, rule or option that does not exist, or a value that is refused; all
            values are checked.
    """
    names = [name for name, _ in axes]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"expected each setting once, got {', '.join(sorted(twice))} again")
    found = []
    for values in itertools.product(*(values for _, values in axes)):
        pairs = list(zip(names, values, strict=True))
        label = ", ".join(str(v) if n == RULE else f"{n.rpartition('.')[2]} {v}" for n, v in pairs)
        spec = with_values(base, pairs, label or base.label)
        spec.config()
        check_options(Entry(spec=spec).found_rule(), spec.options)
        found.append(spec)
    return found


def with_values(base: RunSpec, pairs: Iterable[tuple[str, Any]], label: str) -> RunSpec:
    """``base`` with other settings, options of its rule, or another rule.

    Raises:
        ValueError: the file of a rule cannot be read. FileNotFoundError: it does not exist.
    """
    values = base.to_json()
    values["label"] = label
    for name, value in pairs:
        if name == RULE:
            values["rule"] = value
            values["rule_source"] = read_rule_file(value)[0] if is_rule_file(value) else ""
        elif name.startswith(OPTION):
            values["options"] = {**values["options"], name.removeprefix(OPTION): value}
        else:
            values["settings"] = {**values["settings"], name: value}
    return RunSpec.from_json(values)


def _value(text: str) -> Any:
    try:
        return parse_json(text.lower() if text.lower() in ("true", "false") else text, text, "a value")
    except SequenceError:
        return text
