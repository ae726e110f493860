"""Settings by dotted name, ``tsdf.voxel_size_m``: reading, changing, and listing what differs."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from ..config import from_dict

C = TypeVar("C")


def with_settings(config: C, values: Mapping[str, Any]) -> C:
    """A copy of ``config`` with some settings changed.

    Args:
        config: Settings of a system.
        values: Dotted name -> value; a dash in a name counts as an underscore, and a whole number as a float where one
            is wanted.

    Raises:
        ValueError: no such setting, or an invalid value.
    """
    tree: dict[str, Any] = {}
    for name, value in values.items():
        *groups, leaf = name.replace("-", "_").split(".")
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[leaf] = value
    _whole_as_float(config, tree)
    return from_dict(type(config), tree, start=config)


def _whole_as_float(config: Any, tree: dict[str, Any]) -> None:
    for name, value in tree.items():
        old = getattr(config, name, None)
        if isinstance(value, dict) and dataclasses.is_dataclass(old):
            _whole_as_float(old, value)
        elif isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
            tree[name] = float(value)


def flat_settings(config: Any, path: str = "") -> dict[str, Any]:
    """Dotted name -> value of every setting; the options of the seeding rule are one value."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        name, value = f"{path}{field.name}", getattr(config, field.name)
        found |= flat_settings(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return found


def changed_settings(config: Any, base: Any) -> dict[str, Any]:
    """Dotted name -> value of the settings of ``config`` that differ from those of ``base``, of the same class."""
    before = flat_settings(base)
    return {name: value for name, value in flat_settings(config).items() if value != before[name]}
