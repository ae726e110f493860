"""Changing, saving and restoring settings: any frozen dataclass of plain values and other such dataclasses."""

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from ..errors import shown

C = TypeVar("C")


def replace(config: C, **overrides: Any) -> C:
    """A copy of ``config`` with some fields changed; nested ones take a double underscore: ``tsdf__voxel_size_m``."""
    return _merge(config, nested(overrides, "__"), "")


def nested(values: Mapping[str, Any], separator: str) -> dict[str, Any]:
    """Values by flat names, such as ``tsdf.voxel_size_m``, as dictionaries in dictionaries."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        node = tree
        *groups, leaf = name.split(separator)
        for group in groups:
            node = node.setdefault(group, {})
        node[leaf] = value
    return tree


def from_dict(cls: type[C], values: dict[str, Any], *, start: C | None = None) -> C:
    """Build ``cls`` from nested dictionaries, as ``to_dict`` or ``config.json`` give them; unknown keys are refused.

    What ``values`` leaves out comes from ``start``, or from the defaults.
    """
    return _merge(cls() if start is None else start, values, "")


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dictionaries of a config, ready for JSON."""
    return dataclasses.asdict(config)


def check_kinds(group: str, config: Any) -> None:
    """Raise ``ValueError`` unless words are among those a field lists, whole numbers whole, switches booleans."""
    for f in dataclasses.fields(config):
        name, value = f"{group}.{f.name}".removeprefix("."), getattr(config, f.name)
        words = typing.get_args(f.type) if typing.get_origin(f.type) is typing.Literal else ()
        if words and value not in words:
            raise ValueError(f"{name} must be one of {', '.join(words)}, got {shown(value)}")
        if f.type is int and (isinstance(value, bool) or not isinstance(value, int)):
            raise ValueError(f"{name} must be a whole number, got {shown(value)}")
        if f.type is bool and not isinstance(value, bool):
            raise ValueError(f"{name} must be True or False, got {shown(value)}")
        if f.type is str and not isinstance(value, str):
            raise ValueError(f"{name} must be a text, got {shown(value)}")
        if isinstance(f.type, type) and dataclasses.is_dataclass(f.type) and not isinstance(value, f.type):
            raise ValueError(f"{name} must be a group of settings, got {shown(value)}")
        if typing.get_origin(f.type) is dict and not isinstance(value, dict):
            raise ValueError(f"{name} must hold values by name, got {shown(value)}")


def _merge(config: Any, values: dict[str, Any], path: str) -> Any:
    known = {f.name for f in dataclasses.fields(config)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ValueError(f"{path.rstrip('.') or 'config'}: unknown keys {unknown}; known: {sorted(known)}")
    changed = {}
    for name, value in values.items():
        old = getattr(config, name)
        nested = dataclasses.is_dataclass(old) and isinstance(value, dict)
        if nested:
            changed[name] = _merge(old, value, f"{path}{name}.")
        else:
            changed[name] = tuple(value) if isinstance(old, tuple) else value  # JSON has no tuples
    return dataclasses.replace(config, **changed)
