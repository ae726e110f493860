"""The settings of a mapper with its seeding rule: the rule's name, its options, and the settings that it brings."""

import dataclasses
import logging
from typing import Any, TypeVar

from ..config import SystemConfig, replace
from ..errors import shown
from ..seeding import SeedingRule, is_map_rule, registered, rule_name, rule_options

log = logging.getLogger(__name__)

S = TypeVar("S", bound=SystemConfig)

NOT_FOR_RULES = ("data", "seed", "seeding.rule", "seeding.options", "seeding.own_settings")
"""Settings that a rule cannot bring: they are used before the mapper is made, or choose the rule itself."""
ONLY_IF_THERE = ("keyframe_every",)
"""Settings that a rule may bring to systems that do not have them: RTG-SLAM's keyframes never depend on the seeds."""
ALL = "all"


def usual_settings(system: Any) -> list[Any]:
    """The defaults of a system, and its presets "room" and "replica" in every fidelity."""
    fidelities = [{"fidelity": name} for name in system.fidelities] or [{}]
    return [system.config_type(), *(system.preset(name, **f) for name in ("room", "replica") for f in fidelities)]


def settings_with_rule(config: S, rule: SeedingRule, system: Any = None) -> S:
    """``config`` with everything that the rule decides, so that the stored settings are those of the run.

    Options: those in the settings are for the rule in the settings. Another rule gets them if it has all of them; if
    only the first rule has them, the other runs with its defaults. Options that neither has are returned unchanged; the
    mapper refuses them when it is made.

    Settings that the rule brings (``MapRule.overrides``) replace the usual values in ``config``: the defaults, and
    those of the presets "room" and "replica". Any other value, and every setting that ``config.seeding.own_settings``
    names, is the user's own and stays. Doing this a second time changes nothing.

    Args:
        config: Settings of a system.
        rule: The rule that will run.
        system: Class of the mapper, for its presets; without it only the defaults are usual.

    Raises:
        ValueError: the rule brings a setting that the system does not have, or a value that it refuses; or
            ``own_settings`` names a setting that the system does not have.
    """
    config = _with_options(config, rule)
    brought = _to_change(config, rule, system)
    if not brought:
        return config
    for name, value in brought.items():
        log.info("the seeding rule %r sets %s = %s, was %s", rule_name(rule), name, value, _value(config, name))
    try:
        return replace(config, **{name.replace(".", "__"): value for name, value in brought.items()})
    except (TypeError, ValueError, KeyError) as e:
        raise ValueError(f"the seeding rule {rule_name(rule)!r} brings settings that are refused: {e}") from None


def settings_of_run(config: S, rule: SeedingRule, system: Any = None) -> S:
    """``config`` of a run that continues with ``rule``: settings that the rule would change become ``own_settings``.

    With the rule that made the run nothing changes. With an edited or another rule the settings of the run stay.
    """
    names = sorted(_to_change(config, rule, system))
    if not names:
        return config
    own = (*config.seeding.own_settings, *names)
    return dataclasses.replace(config, seeding=dataclasses.replace(config.seeding, own_settings=own))


def _to_change(config: SystemConfig, rule: SeedingRule, system: Any) -> dict[str, Any]:
    """The settings that the rule changes, by dotted name, with their new values."""
    brought = _brought(config, rule)
    usual = ([type(config)()] if system is None else usual_settings(system)) if brought else []
    return {
        name: value
        for name, value in brought.items()
        if _value(config, name) != value
        and not _is_listed(config, name)
        and any(_value(config, name) == _value(known, name) for known in usual)
    }


def _with_options(config: S, rule: SeedingRule) -> S:
    name, seeding = rule_name(rule), config.seeding
    if name == seeding.rule:
        return config
    options, own = seeding.options, registered().get(seeding.rule)
    if (
        own is not None
        and not options.keys() <= rule_options(rule).keys()
        and options.keys() <= rule_options(own).keys()
    ):
        log.info("the options %s belong to the seeding rule %r; %r runs with its defaults", options, seeding.rule, name)
        options = {}
    return dataclasses.replace(config, seeding=dataclasses.replace(seeding, rule=name, options=options))


def _brought(config: SystemConfig, rule: SeedingRule) -> dict[str, Any]:
    """The settings that a rule brings, by dotted name."""
    overrides = rule.overrides if is_map_rule(rule) else {}
    brought = {name.replace("__", "."): value for name, value in overrides.items()}
    brought = {name: value for name, value in brought.items() if name not in ONLY_IF_THERE or hasattr(config, name)}
    if isinstance(every := brought.get("keyframe_every"), int) and every > 0:  # of the recording, not of mapped frames
        brought["keyframe_every"] = max(1, round(every / config.source_stride))
    for name in brought:
        who = f"the seeding rule {rule_name(rule)!r} brings the setting {shown(name)}"
        if any(name == taken or name.startswith(f"{taken}.") for taken in NOT_FOR_RULES):
            raise ValueError(f"{who}, which only the user can set; a rule cannot bring {', '.join(NOT_FOR_RULES)}")
        _check_setting(config, name, who)
    return brought


def _is_listed(config: SystemConfig, name: str) -> bool:
    """Whether ``seeding.own_settings`` names a setting, its group, or all."""
    found = False
    for entry in config.seeding.own_settings:
        own = entry.replace("__", ".").replace("-", "_")
        if own != ALL:
            _check_setting(config, own, f"seeding.own_settings names {shown(entry)}", or_group=True)
        found = found or own == ALL or name == own or name.startswith(f"{own}.")
    return found


def _check_setting(config: SystemConfig, name: str, who: str, *, or_group: bool = False) -> None:
    """Raise ``ValueError``, beginning with ``who``, unless ``name`` is a setting, or with ``or_group`` a group."""
    holder: Any = config
    for part in name.split("."):
        known = [f.name for f in dataclasses.fields(holder)] if dataclasses.is_dataclass(holder) else []
        if part not in known:
            raise ValueError(
                f"{who}, which {type(config).__name__} does not have; known here: {', '.join(sorted(known)) or 'none'}"
            )
        holder = getattr(holder, part)
    if dataclasses.is_dataclass(holder) and not or_group:
        raise ValueError(f"{who}, which is a group; expected a single setting, such as {name}.{_first(holder)}")


def _first(group: Any) -> str:
    return dataclasses.fields(group)[0].name


def _value(config: Any, name: str) -> Any:
    for part in name.split("."):
        config = getattr(config, part)
    return config
