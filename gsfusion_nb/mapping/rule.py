"""The seeding rule of a mapper: its options, when it is asked, its memory, and the settings that it brings."""

import contextlib
import dataclasses
import logging
from collections.abc import Iterator
from typing import Any, TypeVar

from torch import Tensor

from ..config import SystemConfig, from_dict
from ..config.values import NOT_FOR_RULES, nested, with_own_settings
from ..errors import SequenceError, shown
from ..seeding import (
    EVERY_FRAME,
    DeclaredFiles,
    MapRule,
    SeedingRule,
    When,
    check_memory,
    copy_memory,
    describe_memory,
    is_map_rule,
    option_paths,
    option_values,
    read_code,
    registered,
    rule_fingerprint,
    rule_name,
    rule_options,
)


class RuleInUse:
    """A rule with the options of one mapper, its fingerprint from when the mapper was made, and its memory.

    A function should depend on its context only; what it must remember belongs in ``ctx.memory``. A callable object may
    instead have ``state_dict()`` and ``load_state_dict(state)``: what they exchange (tensors and plain values) is saved
    in checkpoints. A rule that stores something elsewhere can map, but its checkpoints cannot be resumed. The instances
    of a class (``MapRule``) are frozen, so its only state is its memory.

    Args:
        rule: The rule.
        options: Values of its options.

    Raises:
        TypeError: an option that the rule does not have, or a value of the wrong type. Also whatever a class raises in
            ``__post_init__`` for its options.
    """

    def __init__(self, rule: SeedingRule, options: dict[str, Any]):
        self.rule = rule
        values: Any = option_values(rule, options)
        self.map_rule: MapRule | None = rule(**values) if is_map_rule(rule) else None
        """The rule with its options, if it is a class."""
        self.when: When = self.map_rule.when if self.map_rule else EVERY_FRAME
        """In which frames it is asked for seeds."""
        self.memory: dict[str, Any] = {}
        """What it keeps from one frame to the next; always the same dict."""
        read = read_code(rule)
        self._fingerprint = read.hash.hexdigest()
        self._paths = [*option_paths(rule, options).values(), *read.paths]
        self._files: DeclaredFiles | None = None
        for kept in read.caches:  # of an earlier mapper; files may have changed since
            kept.cache_clear()

    def refuse_other_files(self) -> None:
        """From now on the rule may only open files that its options name, or a ``Path`` in its code."""
        self._files = DeclaredFiles(rule_name(self.rule), self._paths)

    def running(self) -> contextlib.AbstractContextManager[None]:
        """Context around a call of the rule.

        Raises:
            UndeclaredFileError: it opens a file that ``refuse_other_files`` forbids.
        """
        return contextlib.nullcontext() if self._files is None else self._files.only()

    @property
    def memory_note(self) -> str:
        """What the memory holds and the sizes, for the end of a line; empty without a memory."""
        return f", memory: {describe_memory(self.memory)}" if self.memory else ""

    @property
    def memory_bytes(self) -> int:
        """Size of the tensors in the memory, bytes."""
        return sum(tensor.nbytes for tensor in _tensors(self.memory))

    def state_dict(self) -> dict[str, Any]:
        """Name and fingerprint of the rule, and its state.

        Raises:
            TypeError: the memory holds something that a checkpoint cannot save.
        """
        save = getattr(self.rule, "state_dict", None)
        check_memory(rule_name(self.rule), self.memory)
        return {
            "name": rule_name(self.rule),
            "fingerprint": self._fingerprint,
            "changed": self.map_rule is None and rule_fingerprint(self.rule) != self._fingerprint,
            "kept": save() if callable(save) else None,
            "memory": copy_memory(self.memory),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of the rule.

        Raises:
            SequenceError: the rule that made the checkpoint stored something that is not in it.
        """
        if state["changed"]:
            raise SequenceError(
                f"the seeding rule {shown(state['name'])} stores something from one frame to the next that is not in "
                "the checkpoint, so the run cannot continue to the same map; keep it in ctx.memory instead"
            )
        load = getattr(self.rule, "load_state_dict", None)
        if state["kept"] is not None and callable(load):
            load(state["kept"])
        self.set_memory(state["memory"])

    def set_memory(self, memory: dict[str, Any]) -> None:
        """Replace the contents of the memory by a copy of ``memory``. Raises ``TypeError`` for an impossible one."""
        check_memory(rule_name(self.rule), memory)
        kept = copy_memory(memory)
        self.memory.clear()
        self.memory.update(kept)

    def differs(self, state: dict[str, Any]) -> bool:
        """Whether this is not the rule of ``state``, or it was edited since."""
        return state["name"] != rule_name(self.rule) or state["fingerprint"] != self._fingerprint


def _tensors(memory: Any) -> Iterator[Tensor]:
    if isinstance(memory, Tensor):
        yield memory
    elif isinstance(memory, (dict, list, tuple)):
        for value in memory.values() if isinstance(memory, dict) else memory:
            yield from _tensors(value)


def check_known(state: dict[str, Any]) -> None:
    """Raise ``SequenceError`` if the rule of a checkpoint is not the one that is registered here by its name."""
    name, known = state["name"], registered().get(state["name"])
    if known is None or rule_fingerprint(known) != state["fingerprint"]:
        what = "is not known here" if known is None else "is not the one that is registered here by that name"
        raise SequenceError(
            f"the seeding rule {shown(name)} of this run {what}; its source is in rule.py of the run's folder: define "
            "it and continue with it in Python: resume_mapping(folder, seeding=<the rule>)"
        )


log = logging.getLogger(__name__)

S = TypeVar("S", bound=SystemConfig)

ONLY_IF_THERE = ("keyframe_every",)
"""Settings that a rule may bring to systems that do not have them: RTG-SLAM's keyframes never depend on the seeds."""
ALL = "all"


def settings_with_rule(config: S, rule: SeedingRule) -> S:
    """``config`` with everything that the rule decides, so that the stored settings are those of the run.

    Options: those in the settings are for the rule in the settings. Another rule gets them if it has all of them; if
    only the first rule has them, the other runs with its defaults. Options that neither has are returned unchanged; the
    mapper refuses them when it is made.

    Settings: what the user set counts more than what the rule brings (``MapRule.overrides``), and that more than
    defaults and fidelities. The user's are named in ``config.seeding.own_settings``: presets add what they set for a
    data set, ``gsfusion_nb.config.replace`` and the command line what they are asked to change.

    Raises:
        ValueError: the rule brings a setting that the system does not have, or a value that it refuses; or
            ``own_settings`` names a setting that the system does not have.
    """
    config = _with_options(config, rule)
    changes = _changes_by(rule, config)
    if not changes:
        return config
    for name, value in changes.items():
        log.info("the seeding rule %r sets %s = %s, was %s", rule_name(rule), name, value, _value(config, name))
    try:
        return from_dict(type(config), nested(changes, "."), start=config)
    except (TypeError, ValueError, KeyError) as e:
        raise ValueError(f"the seeding rule {rule_name(rule)!r} brings settings that are refused: {e}") from None


def settings_of_run(config: S, rule: SeedingRule) -> S:
    """``config`` of a run that continues with ``rule``, an edited or another one: the settings of the run stay."""
    return with_own_settings(config, sorted(_changes_by(rule, config)))


def _changes_by(rule: SeedingRule, config: SystemConfig) -> dict[str, Any]:
    """The settings that the rule changes, by dotted name, with their new values."""
    brought = _brought(config, rule)
    return {n: v for n, v in brought.items() if _value(config, n) != v and not _is_own(config, n)}


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
        if any(name == taken or name.startswith(f"{taken}.") for taken in NOT_FOR_RULES):
            raise ValueError(
                f"the seeding rule {rule_name(rule)!r} brings the setting {shown(name)}, which only the user can set; "
                f"a rule cannot bring {', '.join(NOT_FOR_RULES)}"
            )
    return brought


def _is_own(config: SystemConfig, name: str) -> bool:
    """Whether ``seeding.own_settings`` names a setting, its group, or all."""
    own = [entry.replace("__", ".").replace("-", "_") for entry in config.seeding.own_settings]
    for known in own:
        if known != ALL:
            _value(config, known)
    return any(entry in (ALL, name) or name.startswith(f"{entry}.") for entry in own)


def _value(config: SystemConfig, name: str) -> Any:
    """A setting by its dotted name. Raises ``ValueError`` if there is none of that name."""
    value: Any = config
    for part in name.split("."):
        if not dataclasses.is_dataclass(value) or not hasattr(value, part):
            raise ValueError(
                f"{type(config).__name__} has no setting {shown(name)}, which the seeding rule or "
                "seeding.own_settings names"
            )
        value = getattr(value, part)
    return value
