"""The seeding rule of a mapper: its options, memory, times and fingerprint."""

import contextlib
from collections.abc import Callable
from typing import Any

from ..checks import shown
from ..code_keys.key import code_key, differing, loaded_values, rule_fingerprint
from ..errors import SequenceError
from ..seeding import (
    EVERY_FRAME,
    MapRule,
    SeedingRule,
    When,
    check_memory,
    copy_memory,
)
from ..seeding.bound_rule import bound_rule
from ..seeding.map_rule import is_map_rule, rule_name
from ..seeding.rule import registered


class RuleInUse:
    """A rule with the options of one mapper, its fingerprint from when the mapper was made, and its
    memory.

    A function should depend on its context only; what it must remember belongs in ``ctx.memory``. A
    rule that stores something elsewhere can map, but its checkpoints cannot be resumed. The
    instances of a class (``MapRule``) are frozen, so its only state is its memory.

    Args:
        rule: The rule.
        options: Values of its options.

    Raises:
        TypeError: an option that the rule does not have, or a value of the wrong type. Also
            whatever a class raises in ``__post_init__`` for its options.
    """

    def __init__(self, rule: SeedingRule, options: dict[str, Any]):
        self.rule = rule
        self.bound = bound_rule(rule, options)
        """The rule with its options, as it is asked in each frame."""
        values: Any = self.bound.options
        self.map_rule: MapRule | None = rule(**values) if is_map_rule(rule) else None
        """The rule with its options, if it is a class."""
        self.when: When = self.map_rule.when if self.map_rule else EVERY_FRAME
        """In which frames it is asked for seeds."""
        self.memory: dict[str, Any] = {}
        """What it keeps from one frame to the next; always the same dict."""
        self.call_context: Callable[[], contextlib.AbstractContextManager[None]] = (
            contextlib.nullcontext
        )
        """Context around each call of the rule, for an observer."""
        key = code_key(rule)
        self._fingerprint = key.digest
        self._parts = dict(key.parts)
        self._values = loaded_values(rule)
        for cache in key.caches:  # of an earlier mapper; files may have changed since
            cache.cache_clear()

    def state_dict(self) -> dict[str, Any]:
        """Name and fingerprint of the rule, and its memory.

        Raises:
            TypeError: the memory holds something that a checkpoint cannot save.
        """
        check_memory(rule_name(self.rule), self.memory)
        return {
            "name": rule_name(self.rule),
            "fingerprint": self._fingerprint,
            "parts": dict(self._parts),
            "changed": self.map_rule is None and loaded_values(self.rule) != self._values,
            "memory": copy_memory(self.memory),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of the rule.

        Raises:
            SequenceError: the rule that made the checkpoint stored something that is not in it.
        """
        if state["changed"]:
            raise SequenceError(
                f"the seeding rule {shown(state['name'])} stores something from one frame to the "
                "next that is not in the checkpoint, so the run cannot continue to the same map; "
                "keep it in ctx.memory instead"
            )
        self.set_memory(state["memory"])

    def set_memory(self, memory: dict[str, Any]) -> None:
        """Replace the contents of the memory by a copy of ``memory``. Raises ``TypeError`` for an
        impossible one."""
        check_memory(rule_name(self.rule), memory)
        memory = copy_memory(memory)
        self.memory.clear()
        self.memory.update(memory)

    def difference(self, state: dict[str, Any]) -> str:
        """What differs from the rule of ``state`` in words: its name, or parts of its key; empty if
        nothing does."""
        if state["name"] != rule_name(self.rule):
            return "its name"
        if state["fingerprint"] == self._fingerprint:
            return ""
        return differing(state.get("parts", {}), self._parts) or "what cannot be hashed"


def check_registered(state: dict[str, Any]) -> None:
    """Raise ``SequenceError`` if the rule of a checkpoint is not the one that is registered here by
    its name."""
    name = state["name"]
    rule = registered().get(name)
    if rule is None or rule_fingerprint(rule) != state["fingerprint"]:
        what = "is not known here"
        if rule is not None:
            changes = differing(state.get("parts", {}), code_key(rule).parts)
            what = f"is not the one that is registered here by that name (it differs in {changes})"
        raise SequenceError(
            f"the seeding rule {shown(name)} of this run {what}; its source is in rule.py of the "
            "run's folder: define "
            "it and continue with it in Python: resume_mapping(folder, seeding=<the rule>)"
        )
