"""What is checked of a run before anything runs: its settings, the options of its rule, and what is tuned."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ..errors import shown
from ..seeding import SeedingRule, check_options
from .size_options import size_option, start_value
from .spec import RunSpec


def check_run(spec: RunSpec, rule: SeedingRule) -> None:
    """Check all of a run but its data.

    Raises:
        KeyError: unknown system or preset. TypeError: an option that the rule does not have, or of a wrong type.
        ValueError: a setting that does not exist, an invalid value, or no option that can be tuned.
    """
    spec.config()
    if spec.size_range is not None:
        check_size_range(spec.size_range)
    for check in RULE_CHECKS.values():
        check(spec, rule)


def check_size_range(given: Sequence[Any]) -> None:
    """Raise ``ValueError`` unless these are two numbers above 0, the smaller one first."""
    numbers = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in given)
    if not (numbers and len(given) == 2 and 0 < given[0] < given[1]):
        raise ValueError(f"expected [smallest, largest], both above 0, got {shown(list(given))}")


def _check_options(spec: RunSpec, rule: SeedingRule) -> None:
    check_options(rule, spec.options)


def _check_size_option(spec: RunSpec, rule: SeedingRule) -> None:
    if spec.size_option or spec.budget.gaussians is not None:
        start_value(spec, rule, size_option(spec, rule))


RULE_CHECKS: Mapping[str, Callable[[RunSpec, SeedingRule], None]] = {
    "options": _check_options,
    "size_option": _check_size_option,
}
"""Key of a rule in the file of a comparison -> its check; each takes settings that are valid."""
