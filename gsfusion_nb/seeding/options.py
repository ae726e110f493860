"""The options of a seeding rule: the numbers and words after the context, each with a default."""

import dataclasses
import inspect
import typing
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..checks import shown
from ..errors import KindError
from .map_rule import MapRule, Option, SeedingRule, When, check_needs, rule_name

_KNOWN_OPTIONS: weakref.WeakKeyDictionary[Any, dict[str, inspect.Parameter]] = (
    weakref.WeakKeyDictionary()
)
"""Rule -> its options, since reading a signature takes longer than many a step of a rule."""


def option_values(rule: SeedingRule, values: Mapping[str, Any]) -> dict[str, Option]:
    """The options as the rule is called with them: those that are paths as ``Path``, which settings
    hold as text.

    Raises:
        TypeError: as ``check_options``.
    """
    check_options(rule, values)
    parameters = options_of(rule)
    return {
        name: Path(value).expanduser() if isinstance(parameters[name].default, Path) else value
        for name, value in values.items()
    }


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
    """Raise ``TypeError`` for an option that the rule does not have, or a value of another type
    than its default's."""
    parameters = options_of(rule)
    unknown = sorted(set(options) - set(parameters))
    if unknown:
        raise KindError(
            f"seeding rule {rule_name(rule)!r} has no options {shown(unknown)}; known: "
            f"{sorted(parameters)}"
        )
    for name, value in options.items():
        default = parameters[name].default
        if words := isinstance(default, str) and typing.get_args(parameters[name].annotation):
            fits = value in words
            kind = words
        elif isinstance(default, Path):
            fits = isinstance(value, str | Path)
            kind = "the path of a file or folder"
        elif isinstance(default, str):
            fits = isinstance(value, str)
            kind = "a text"
        elif isinstance(default, bool):
            fits = isinstance(value, bool)
            kind = "True or False"
        else:
            fits = isinstance(value, int | float) and not isinstance(value, bool)
            kind = "a number"
        if not fits:
            raise KindError(
                f"seeding rule {rule_name(rule)!r}: option {name!r} must be {kind}, got "
                f"{shown(value)}"
            )


def _read_options(rule: SeedingRule) -> dict[str, inspect.Parameter]:
    name = rule_name(rule)
    if isinstance(rule, type):
        rule_form = (
            "a seeding rule that is a class is written  @dataclass(frozen=True, "
            f"kw_only=True) class {name}(MapRule)"
        )
        _check_class(rule, rule_form)
        parameters = list(_signature(rule).parameters.values())
    else:
        rule_form = f"a seeding rule is written  def {name}(ctx, *, number=default, ...) -> Seeds"
        parameters = list(_signature(rule).parameters.values())
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        if not parameters or parameters.pop(0).kind not in positional:
            raise KindError(
                f"{rule_form}; this one does not take the context as its first argument"
            )
    for parameter in parameters:
        _check_option(parameter, rule_form)
    return {p.name: p for p in parameters}


def _check_option(p: inspect.Parameter, rule_form: str) -> None:
    if p.kind is not inspect.Parameter.KEYWORD_ONLY:
        raise KindError(
            f"{rule_form}; {str(p)!r} must be keyword-only: put it after a bare *, with a default"
        )
    if p.default is inspect.Parameter.empty:
        raise KindError(
            f"{rule_form}; option {p.name!r} has no default, which sliders and check_rule need"
        )
    if not isinstance(p.default, Option):
        raise KindError(
            f"{rule_form}; the default of option {p.name!r} must be a number, True/False, a text "
            f"or a Path, got {p.default!r}"
        )
    if (
        isinstance(p.default, str)
        and p.annotation is not str
        and p.default not in typing.get_args(p.annotation)
    ):
        raise KindError(
            f"{rule_form}; option {p.name!r} is a text, so annotate it: {p.name}: str for any, "
            "Path for a file, or the "
            f'allowed words: {p.name}: Literal["{p.default}", ...] = "{p.default}"'
        )


def _check_class(rule: type, rule_form: str) -> None:
    """Raise ``TypeError`` unless the class can be used as a rule."""
    if not issubclass(rule, MapRule):
        raise KindError(f"{rule_form}; this one does not derive from gsfusion_nb.seeding.MapRule")
    if "__dataclass_fields__" not in vars(rule):
        raise KindError(
            f"{rule_form}; this one is not a dataclass: put @dataclass(...) directly above the "
            "class"
        )
    if not all(f.kw_only for f in dataclasses.fields(rule)):
        raise KindError(f"{rule_form}; this one was made without kw_only=True")
    if inspect.isabstract(rule):
        raise KindError(
            f"{rule_form}; this one lacks {', '.join(sorted(rule.__abstractmethods__))}(self, ctx, "
            "memory)"
        )
    if len(inspect.signature(rule.seeds).parameters) != 3:
        raise KindError(f"{rule_form}; its method must be  def seeds(self, ctx, memory) -> Seeds")
    kinds = {
        "when": (When, "EVERY_FRAME, KEYFRAMES, every(n) or submaps(n)"),
        "needs": (frozenset, "a frozenset of words"),
        "overrides": (Mapping, "values by name"),
    }
    for attribute, (kind, meaning) in kinds.items():
        if not isinstance(value := getattr(rule, attribute), kind):
            raise KindError(f"{rule_form}; its {attribute} must be {meaning}, got {shown(value)}")
    check_needs(rule.needs, f"{rule_form}; its needs")


def _signature(rule: SeedingRule) -> inspect.Signature:
    try:
        return inspect.signature(rule, eval_str=True)
    except (
        NameError,
        AttributeError,
        SyntaxError,
    ):  # an annotation written as text that cannot be evaluated here
        return inspect.signature(rule)
