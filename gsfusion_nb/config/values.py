"""Changing, checking and saving settings: frozen dataclasses of plain values or of such
dataclasses."""

import dataclasses
import math
import typing
from collections.abc import Iterable, Mapping
from dataclasses import field
from typing import Any, ClassVar, TypeVar

from ..checks import check_number, check_positive, shown
from ..errors import ArgumentError

C = TypeVar("C")


NOT_FOR_RULES = ("data", "seed", "seeding.rule", "seeding.options", "seeding.own_settings")
"""Settings that a seeding rule cannot bring: they are used before the mapper is made, or choose the
rule itself."""


def replace(config: C, **overrides: Any) -> C:
    """A copy of ``config`` with some fields changed; nested ones take a double underscore:
    ``tsdf__voxel_size_m``.

    In the settings of a system these count as set by the user: a seeding rule does not change them.
    """
    changes = tree_of(overrides, "__")
    return with_own_settings(_merge(config, changes, ""), leaves(changes))


def with_values(config: C, **values: Any) -> C:
    """A copy of ``config`` with some fields changed, of a group those that a dictionary names. They
    do not count as set by the user, so that a seeding rule may change them."""
    return _merge(config, values, "")


def with_own_settings(config: C, names: Iterable[str]) -> C:
    """The settings of a system with more names in ``seeding.own_settings``; other settings are
    returned unchanged."""
    seeding: Any = getattr(config, "seeding", None)
    if not hasattr(seeding, "own_settings"):
        return config
    own = list(seeding.own_settings)
    for name in names:
        for_rules = not any(
            name == setting or name.startswith(f"{setting}.") for setting in NOT_FOR_RULES
        )
        if for_rules and name not in own:
            own.append(name)
    return with_values(config, seeding={"own_settings": own})


def tree_of(values: Mapping[str, Any], separator: str) -> dict[str, Any]:
    """Values by flat names, such as ``tsdf.voxel_size_m``, as dictionaries in dictionaries."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        node = tree
        *groups, leaf = name.split(separator)
        for group in groups:
            node = node.setdefault(group, {})
        node[leaf] = value
    return tree


def from_dict(
    cls: type[C],
    values: dict[str, Any],
    *,
    start: C | None = None,
) -> C:
    """Build ``cls`` from nested dictionaries, as ``to_dict`` or ``config.json`` give them; unknown
    keys are refused.

    What ``values`` leaves out comes from ``start``, or from the defaults.

    Raises:
        ValueError: a value that no setting has, or a seeding rule in a file: no mapper executes
            code because a file of settings says so.
    """
    seeding = values.get("seeding")
    rule = seeding.get("rule") if isinstance(seeding, dict) else None
    if isinstance(rule, str) and ".py" in rule:
        raise ArgumentError(
            f"seeding.rule must be the name of a rule, got the file {shown(rule)}; where you trust "
            "it, give it to run_mapping or to a mapper (seeding=...)"
        )
    return _merge(cls() if start is None else start, values, "")


def from_run(cls: type[C], values: dict[str, Any]) -> C:
    """The settings of a run, from its files: what they leave out is what runs did before that
    setting existed.

    That is not always the default: a setting that came later may have a default that changes maps
    (``within``).
    """
    return from_dict(cls, values, start=_values_of_old(cls()))


def _values_of_old(settings: C) -> C:
    """``settings`` with the values that runs had before the settings existed, where a field names
    one."""
    changes = {}
    for f in dataclasses.fields(settings):  # pyright: ignore[reportArgumentType]
        value = getattr(settings, f.name)
        if dataclasses.is_dataclass(value):
            changes[f.name] = _values_of_old(value)
        elif "before" in f.metadata:
            changes[f.name] = f.metadata["before"]
    return dataclasses.replace(settings, **changes)  # pyright: ignore[reportArgumentType]


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dictionaries of a config, ready for JSON."""
    return dataclasses.asdict(config)


def within(
    default: Any,
    low: float | int,
    high: float | int = math.inf,
    **more: Any,
) -> Any:
    """A field of settings whose numbers lie between ``low`` and ``high``, both allowed; ``more`` as
    for ``setting``."""
    return setting(default, range=(low, high), **more)


def positive(default: Any, **more: Any) -> Any:
    """A field of settings whose number is above 0; ``more`` as for ``setting``."""
    return setting(default, positive=True, **more)


def setting(default: Any, **metadata: Any) -> Any:
    """A field of settings.

    Args:
        default: Its default.
        metadata: ``before``: what a run did before the setting existed, where that is not the
            default (``from_run``).
    """
    return field(default=default, metadata=metadata)


class Settings:
    """A group of settings. Values outside of the ranges that its fields declare are refused when it
    is made."""

    group: ClassVar[str] = ""

    def __init_subclass__(cls, group: str = ""):
        cls.group = group

    def __post_init__(self):
        check_kinds(self.group, self)


def check_kinds(group: str, config: Any) -> None:
    """Raise ``ValueError`` unless words are among those a field lists, whole numbers whole,
    switches booleans, and numbers in their range."""
    for f in dataclasses.fields(config):
        name = f"{group}.{f.name}".removeprefix(".")
        value = getattr(config, f.name)
        words = typing.get_args(f.type) if typing.get_origin(f.type) is typing.Literal else ()
        if words and value not in words:
            raise ArgumentError(f"{name} must be one of {', '.join(words)}, got {shown(value)}")
        for kind, kind_text in ((int, "a whole number"), (bool, "True or False"), (str, "a text")):
            if f.type is kind and (
                not isinstance(value, kind) or isinstance(value, bool) != (kind is bool)
            ):
                raise ArgumentError(f"{name} must be {kind_text}, got {shown(value)}")
        if (
            isinstance(f.type, type)
            and dataclasses.is_dataclass(f.type)
            and not isinstance(value, f.type)
        ):
            raise ArgumentError(f"{name} must be a group of settings, got {shown(value)}")
        if typing.get_origin(f.type) is dict and not isinstance(value, dict):
            raise ArgumentError(f"{name} must hold values by name, got {shown(value)}")
        for number in () if value is None else value if isinstance(value, tuple) else (value,):
            if "range" in f.metadata:
                check_number(name, number, *f.metadata["range"])
            elif "positive" in f.metadata:
                check_positive(name, number)


def _merge(config: Any, values: dict[str, Any], path: str) -> Any:
    names = {f.name for f in dataclasses.fields(config)}
    unknown = sorted(set(values) - names)
    if unknown:
        raise ArgumentError(
            f"{path.rstrip('.') or 'config'}: unknown keys {unknown}; known: {sorted(names)}"
        )
    changes = {}
    for name, value in values.items():
        old = getattr(config, name)
        is_group = dataclasses.is_dataclass(old) and isinstance(value, dict)
        if is_group:
            changes[name] = _merge(old, value, f"{path}{name}.")
        else:
            changes[name] = tuple(value) if isinstance(old, tuple) else value  # JSON has no tuples
    return dataclasses.replace(config, **changes)


def leaves(
    values: Mapping[str, Any],
    path: str = "",
) -> dict[str, Any]:
    """Nested values by dotted name; the options of the seeding rule are one value."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        is_group = isinstance(value, dict) and name != "options"
        flat |= leaves(value, f"{path}{name}.") if is_group else {path + name: value}
    return flat
