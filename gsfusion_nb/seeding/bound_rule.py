"""A seeding rule with its options, found and checked once, so that a frame only has to call it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from ..types import Seeds
from .context import SeedContext
from .map_rule import MapRule, Option, SeedingRule, is_map_rule, rule_name
from .options import option_values
from .rule import get_rule
from .rule_code import is_built_in


@dataclass(frozen=True, kw_only=True, eq=False)
class BoundRule:
    """A rule that is ready to be called."""

    name: str
    options: dict[str, Option]
    """Those that are not its defaults; paths as ``Path``."""
    call: Callable[[SeedContext], Seeds]
    """The rule with its options."""
    is_watched: bool
    """Whether it is looked at that the rule changes nothing that it may only read
    (``unchanged_inputs``); the rules of this package are not watched."""


def bound_rule(rule: str | SeedingRule, options: Mapping[str, Option]) -> BoundRule:
    """A rule with values of its options, in place of its defaults.

    Raises:
        KeyError: no such rule. TypeError: an unknown option, or a value of the wrong type.
    """
    function = get_rule(rule)
    values: Any = option_values(function, options)
    if is_map_rule(function):
        call = partial(_call_class, function, values)
    else:
        call = partial(cast(Callable[..., Seeds], function), **values)
    return BoundRule(
        name=rule_name(function),
        options=values,
        call=call,
        is_watched=not is_built_in(function),
    )


def _call_class(rule: type[MapRule], values: Any, ctx: SeedContext) -> Seeds:
    """An instance for each call, so that all that a rule remembers is its memory."""
    return rule(**values).seeds(ctx, ctx.memory)
