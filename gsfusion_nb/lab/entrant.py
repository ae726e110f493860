"""A rule that takes part in a comparison: its options, its label, and how its size is tuned."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..data import OpenedSequence
from ..seeding import SeedingRule, is_built_in, rule_fingerprint, rule_name
from ..seeding.rule_file import is_rule_file, read_rule_file
from .map_scene import Entry
from .spec import Option, RunSpec, label_of


@dataclass(frozen=True)
class Entrant:
    """A rule with options and a label: ``Entrant("uniform", {"fraction": 0.1}, "uniform 10 %")``."""

    rule: str | SeedingRule
    """Name of a registered rule, "FILE.py:name", or the rule itself."""
    options: Mapping[str, Option] = field(default_factory=dict)
    """Keyword arguments for it."""
    label: str = ""
    """Name in the table; made from rule and options if empty."""
    size_option: str = ""
    """Option that is tuned to reach a number of Gaussians; the rule's own if empty. "thin" keeps a random share of the
    seeds."""
    size_range: tuple[float | int, float | int] | None = None
    """Smallest and largest value of ``size_option``."""

    @property
    def name(self) -> str:
        """Name in the table."""
        return self.label or label_of(rule_name(self.rule).rpartition(":")[2], self.options)

    def entry(self, *, sequence: OpenedSequence | None = None, **fields: Any) -> Entry:
        """A run of this rule.

        Args:
            sequence: The frames, if they are open already.
            fields: The other fields of ``RunSpec``.

        Raises:
            ValueError: the file of the rule cannot be read. FileNotFoundError: it does not exist.
        """
        rule = self.rule
        source = read_rule_file(rule)[0] if isinstance(rule, str) and is_rule_file(rule) else ""
        fingerprint = "" if isinstance(rule, str) or is_built_in(rule) else rule_fingerprint(rule)
        spec = RunSpec(
            rule=rule if isinstance(rule, str) else rule_name(rule), label=self.name, options=self.options,
            size_option=self.size_option, size_range=self.size_range,
            rule_source=source, rule_hash=fingerprint, **fields,
        )  # fmt: skip
        return Entry(spec=spec, rule=None if isinstance(rule, str) else rule, sequence=sequence)
