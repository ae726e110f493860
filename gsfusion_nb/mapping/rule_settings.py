"""The settings of a run with its seeding rule: options, and what the rule brings."""

import dataclasses
import logging
from typing import Any, TypeVar

from ..checks import shown
from ..config import SystemConfig, from_dict
from ..config.values import NOT_FOR_RULES, tree_of, with_own_settings
from ..errors import ArgumentError
from ..seeding import SeedingRule
from ..seeding.map_rule import is_map_rule, rule_name
from ..seeding.rule import registered, rule_options

log = logging.getLogger(__name__)

S = TypeVar("S", bound=SystemConfig)

ONLY_IF_THERE = ("keyframe_every",)
"""Settings that a rule may bring to systems that do not have them: RTG-SLAM's keyframes never
depend on the seeds."""
ALL = "all"


def settings_with_rule(config: S, rule: SeedingRule) -> S:
    """``config`` with everything that the rule decides, so that the stored settings are those of
    the run.

    Options: those in the settings are for the rule in the settings. Another rule gets them if it
    has all of them; if only the first rule has them, the other runs with its defaults. Options that
    neither has are returned unchanged; the mapper refuses them when it is made.

    Settings: what the user set counts more than what the rule brings (``MapRule.overrides``), and
    that more than defaults and fidelities. The user's are named in ``config.seeding.own_settings``:
    presets add what they set for a data set, ``gsfusion_nb.config.replace`` and the command line
    what they are asked to change.

    Raises:
        ValueError: the rule brings a setting that the system does not have, or a value that it
            refuses; or ``own_settings`` names a setting that the system does not have.
    """
    config = _with_options(config, rule)
    changes = _changes_by(rule, config)
    if not changes:
        return config
    for name, value in changes.items():
        log.info(
            "the seeding rule %r sets %s = %s, was %s",
            rule_name(rule),
            name,
            value,
            _value(config, name),
        )
    try:
        return from_dict(type(config), tree_of(changes, "."), start=config)
    except (TypeError, ValueError, KeyError) as e:
        raise ArgumentError(
            f"the seeding rule {rule_name(rule)!r} brings settings that are refused: {e}"
        ) from None


def settings_of_run(config: S, rule: SeedingRule) -> S:
    """``config`` of a run that continues with ``rule``, an edited or another one: the settings of
    the run stay."""
    return with_own_settings(config, sorted(_changes_by(rule, config)))


def _changes_by(rule: SeedingRule, config: SystemConfig) -> dict[str, Any]:
    """The settings that the rule changes, by dotted name, with their new values."""
    overrides = _overrides(config, rule)
    return {n: v for n, v in overrides.items() if _value(config, n) != v and not _is_own(config, n)}


def _with_options(config: S, rule: SeedingRule) -> S:
    name = rule_name(rule)
    seeding = config.seeding
    if name == seeding.rule:
        return config
    options = seeding.options
    own = registered().get(seeding.rule)
    if (
        own is not None
        and not options.keys() <= rule_options(rule).keys()
        and options.keys() <= rule_options(own).keys()
    ):
        log.info(
            "the options %s belong to the seeding rule %r; %r runs with its defaults",
            options,
            seeding.rule,
            name,
        )
        options = {}
    return dataclasses.replace(
        config, seeding=dataclasses.replace(seeding, rule=name, options=options)
    )


def _overrides(config: SystemConfig, rule: SeedingRule) -> dict[str, Any]:
    """The settings that a rule brings, by dotted name."""
    of_class = rule.overrides if is_map_rule(rule) else {}
    overrides = {name.replace("__", "."): value for name, value in of_class.items()}
    overrides = {
        name: value
        for name, value in overrides.items()
        if name not in ONLY_IF_THERE or hasattr(config, name)
    }
    # of the recording, not of mapped frames
    if isinstance(every := overrides.get("keyframe_every"), int) and every > 0:
        overrides["keyframe_every"] = max(1, round(every / config.source_stride))
    for name in overrides:
        if any(name == own or name.startswith(f"{own}.") for own in NOT_FOR_RULES):
            raise ArgumentError(
                f"the seeding rule {rule_name(rule)!r} brings the setting {shown(name)}, which "
                f"only the user can set; a rule cannot bring {', '.join(NOT_FOR_RULES)}"
            )
    return overrides


def _is_own(config: SystemConfig, name: str) -> bool:
    """Whether ``seeding.own_settings`` names a setting, its group, or all."""
    own = [entry.replace("__", ".").replace("-", "_") for entry in config.seeding.own_settings]
    for entry in own:
        if entry != ALL:
            _value(config, entry)
    return any(entry in (ALL, name) or name.startswith(f"{entry}.") for entry in own)


def _value(config: SystemConfig, name: str) -> Any:
    """A setting by its dotted name. Raises ``ValueError`` if there is none of that name."""
    value: Any = config
    for part in name.split("."):
        if not dataclasses.is_dataclass(value) or not hasattr(value, part):
            raise ArgumentError(
                f"{type(config).__name__} has no setting {shown(name)}, which the seeding rule or "
                "seeding.own_settings names"
            )
        value = getattr(value, part)
    return value
