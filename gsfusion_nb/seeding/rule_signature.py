"""How a seeding rule is written, function or class: its options, and sentences about what is wrong with it."""

import dataclasses
import inspect
import typing
import weakref
from collections.abc import Callable, Mapping
from typing import Any, TypeGuard

from ..errors import shown
from ..types import Seeds
from .map_rule import MapRule, When
from .step_stats import check_needs

SeedingRule = Callable[..., Seeds] | type[MapRule]
"""A function ``(ctx, *, option=default, ...) -> Seeds``, or a subclass of ``MapRule``."""
Option = bool | int | float | str

_KNOWN_OPTIONS: weakref.WeakKeyDictionary[Any, dict[str, inspect.Parameter]] = weakref.WeakKeyDictionary()
"""Rule -> its options, since reading a signature takes longer than many a step of a rule."""


def rule_name(rule: str | SeedingRule) -> str:
    """Name of a rule in messages and reports."""
    return rule if isinstance(rule, str) else getattr(rule, "__name__", type(rule).__name__)


def is_map_rule(rule: SeedingRule) -> TypeGuard[type[MapRule]]:
    """Whether the rule is a class."""
    return isinstance(rule, type) and issubclass(rule, MapRule)


def options_of(rule: SeedingRule) -> dict[str, inspect.Parameter]:
    """The options of a rule by name.

    Raises:
        TypeError: the rule is not written as ``seeding_rule`` asks.
    """
    try:
        options = _KNOWN_OPTIONS.get(rule)
    except TypeError:  # an object that cannot be a key
        return _read_options(rule)
    if options is None:
        options = _KNOWN_OPTIONS[rule] = _read_options(rule)
    return options


def check_options(rule: SeedingRule, options: Mapping[str, Any]) -> None:
    """Raise ``TypeError`` for an option that the rule does not have, or a value of another type than its default's."""
    known = options_of(rule)
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise TypeError(f"seeding rule {rule_name(rule)!r} has no options {shown(unknown)}; known: {sorted(known)}")
    for name, value in options.items():
        default = known[name].default
        if isinstance(default, str):
            fits, wanted = value in typing.get_args(known[name].annotation), typing.get_args(known[name].annotation)
        elif isinstance(default, bool):
            fits, wanted = isinstance(value, bool), "True or False"
        else:
            fits, wanted = isinstance(value, int | float) and not isinstance(value, bool), "a number"
        if not fits:
            raise TypeError(f"seeding rule {rule_name(rule)!r}: option {name!r} must be {wanted}, got {shown(value)}")


def _read_options(rule: SeedingRule) -> dict[str, inspect.Parameter]:
    name = rule_name(rule)
    if isinstance(rule, type):
        wanted = (
            f"a seeding rule that is a class is written  @dataclass(frozen=True, kw_only=True) class {name}(MapRule)"
        )
        _check_class(rule, wanted)
        parameters = list(_signature(rule).parameters.values())
    else:
        wanted = f"a seeding rule is written  def {name}(ctx, *, number=default, ...) -> Seeds"
        parameters = list(_signature(rule).parameters.values())
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        if not parameters or parameters.pop(0).kind not in positional:
            raise TypeError(f"{wanted}; this one does not take the context as its first argument")
    for parameter in parameters:
        _check_option(parameter, wanted)
    return {p.name: p for p in parameters}


def _check_option(p: inspect.Parameter, wanted: str) -> None:
    if p.kind is not inspect.Parameter.KEYWORD_ONLY:
        raise TypeError(f"{wanted}; {str(p)!r} must be keyword-only: put it after a bare *, with a default")
    if p.default is inspect.Parameter.empty:
        raise TypeError(f"{wanted}; option {p.name!r} has no default, which sliders and check_rule need")
    if not isinstance(p.default, bool | int | float | str):
        raise TypeError(
            f"{wanted}; the default of option {p.name!r} must be a number, True/False or a word, got {p.default!r}"
        )
    if isinstance(p.default, str) and p.default not in typing.get_args(p.annotation):
        raise TypeError(
            f"{wanted}; option {p.name!r} is a word, so annotate the allowed words: "
            f'{p.name}: Literal["{p.default}", ...] = "{p.default}"'
        )


def _check_class(rule: type, wanted: str) -> None:
    """Raise ``TypeError`` unless the class can be used as a rule."""
    if not issubclass(rule, MapRule):
        raise TypeError(f"{wanted}; this one does not derive from gsfusion_nb.seeding.MapRule")
    if "__dataclass_fields__" not in vars(rule):
        raise TypeError(f"{wanted}; this one is not a dataclass: put @dataclass(...) directly above the class")
    if not all(f.kw_only for f in dataclasses.fields(rule)):
        raise TypeError(f"{wanted}; this one was made without kw_only=True")
    if inspect.isabstract(rule):
        raise TypeError(f"{wanted}; this one lacks {', '.join(sorted(rule.__abstractmethods__))}(self, ctx, memory)")
    if len(inspect.signature(rule.seeds).parameters) != 3:
        raise TypeError(f"{wanted}; its method must be  def seeds(self, ctx, memory) -> Seeds")
    kinds = {"when": (When, "EVERY_FRAME, KEYFRAMES, every(n) or submaps(n)"),
             "needs": (frozenset, "a frozenset of words"), "overrides": (Mapping, "values by name")}  # fmt: skip
    for attribute, (kind, meaning) in kinds.items():
        if not isinstance(value := getattr(rule, attribute), kind):
            raise TypeError(f"{wanted}; its {attribute} must be {meaning}, got {shown(value)}")
    check_needs(rule.needs, f"{wanted}; its needs")


def _signature(rule: SeedingRule) -> inspect.Signature:
    try:
        return inspect.signature(rule, eval_str=True)
    except (NameError, AttributeError, SyntaxError):  # an annotation written as text that cannot be evaluated here
        return inspect.signature(rule)
