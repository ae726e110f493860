"""Settings by dotted name, and the fixed schedule of gradient steps that makes rules comparable."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from ..config import SystemConfig, from_dict, to_dict
from ..config.values import leaves, tree_of, with_own_settings

C = TypeVar("C")


def with_settings(config: C, values: Mapping[str, Any]) -> C:
    """A copy of ``config`` with some settings changed.

    Args:
        config: Settings of a system.
        values: Dotted name -> value; a dash in a name counts as an underscore, and a whole number
            as a float where one is wanted.

    Raises:
        ValueError: no such setting, or an invalid value.
    """
    tree = tree_of(
        {name.replace("-", "_"): value for name, value in values.items()},
        ".",
    )
    _whole_as_float(config, tree)
    return with_own_settings(from_dict(type(config), tree, start=config), leaves(tree))


def _whole_as_float(config: Any, tree: dict[str, Any]) -> None:
    for name, value in tree.items():
        old = getattr(config, name, None)
        if isinstance(value, dict) and dataclasses.is_dataclass(old):
            _whole_as_float(old, value)
        elif isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
            tree[name] = float(value)


def flat_settings(config: Any) -> dict[str, Any]:
    """Dotted name -> value of every setting; the options of the seeding rule are one value."""
    return leaves(to_dict(config))


def changed_settings(config: Any, base: Any) -> dict[str, Any]:
    """Dotted name -> value of the settings of ``config`` that differ from those of ``base``, of the
    same class."""
    base_settings = flat_settings(base)
    return {
        name: value for name, value in flat_settings(config).items() if value != base_settings[name]
    }


EQUAL_KEYFRAME_EVERY = 4
"""Every n-th mapped frame is a keyframe where the settings do not say otherwise; MonoGS takes as
many on Replica."""
SCHEDULE = frozenset(
    {
        "keyframe_every",
        "keyframe_min_seeds",
        "keep_all_frames",
        "optim.keyframe_iterations",
        "optim.frame_iterations",
        "optim.random_keyframe_iterations",
        "optim.global_iterations",
        "window.iterations",
        "window.every_frames",
        "window.frames",
        "keyframes.iterations",
        "keyframes.latest",
        "keyframes.random",
        "keyframes.instead_of_window",
        "final.passes",
    }
)
"""Settings of any system that decide how many gradient steps are taken when. No rule may bring its
own."""
_PER_FRAME = (
    "optim.keyframe_iterations",
    "optim.frame_iterations",
    "optim.random_keyframe_iterations",
)


def fixed_schedule(config: SystemConfig) -> SystemConfig:
    """``config`` with keyframes that do not depend on seeds, and a schedule that no rule replaces
    by its own.

    RTG-SLAM's keyframes follow from the poses already.
    """
    settings = flat_settings(config)
    own = sorted(SCHEDULE & set(settings) - set(config.seeding.own_settings))
    changes: dict[str, Any] = {"seeding.own_settings": [*config.seeding.own_settings, *own]}
    if settings.get("keyframe_every") == 0:
        changes["keyframe_every"] = EQUAL_KEYFRAME_EVERY
    return with_settings(config, changes)


def dotted(name: str) -> str:
    """``optim__lr_xyz`` as ``optim.lr_xyz``."""
    return name.replace("__", ".")


def without_steps(config: SystemConfig) -> SystemConfig:
    """``config`` without any gradient step: only seeding and fusion."""
    names = {f.name for f in dataclasses.fields(config)}
    none: dict[str, Any] = (
        dict.fromkeys((*_PER_FRAME, "optim.global_iterations"), 0) if "optim" in names else {}
    )
    return with_settings(config, none)
