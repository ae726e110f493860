"""Seeding rules by name: ``@seeding_rule`` registers a function or class; a mapper takes its name, or the rule itself.

A rule is a function ``(ctx: SeedContext, *, number=default, ...) -> Seeds``, or a class (``MapRule``). It proposes the
Gaussians that are created from one frame. It changes none of its inputs but ``ctx.memory``, and draws random numbers
only from ``ctx.generator``.
"""

import contextlib
import dataclasses
import inspect
import typing
import weakref
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from ..checks import check_name
from ..errors import shown
from ..types import Seeds
from .map_rule import MapRule, When, check_needs

SeedingRule = Callable[..., Seeds] | type[MapRule]
"""A function ``(ctx, *, option=default, ...) -> Seeds``, or a subclass of ``MapRule``."""
Option = bool | int | float | str | Path
"""A number, True or False, a text, or the path of a file or folder that the rule reads."""

_KNOWN_OPTIONS: weakref.WeakKeyDictionary[Any, dict[str, inspect.Parameter]] = weakref.WeakKeyDictionary()
"""Rule -> its options, since reading a signature takes longer than many a step of a rule."""
F = TypeVar("F", bound=SeedingRule)

_RULES: dict[str, SeedingRule] = {}


def seeding_rule(rule: F) -> F:
    """Register ``rule`` under its own name and return it unchanged; a rule of that name is replaced.

    Raises:
        TypeError: the signature is not ``(ctx, *, name=default, ...)`` with defaults that are numbers, True/False, a
            word of a ``Literal["...", ...]``, a text annotated ``str``, or a ``Path``; or the class is not as
            ``MapRule`` says.
    """
    if not callable(rule):
        raise TypeError(f"@seeding_rule decorates a function, got {type(rule).__name__}; write it without parentheses")
    if not rule_name(rule).isidentifier():
        raise TypeError(f"a seeding rule is registered by its name, and {rule_name(rule)!r} is not a name: use def")
    options_of(rule)
    _RULES[rule_name(rule)] = rule
    return rule


def get_rule(rule: str | SeedingRule) -> SeedingRule:
    """The rule registered under a name; a function or class is returned unchanged after its signature was checked.

    Raises:
        KeyError: no rule of that name; the message lists the registered ones. TypeError: bad signature.
    """
    if isinstance(rule, str):
        check_name("seeding rule", rule, _RULES)
        return _RULES[rule]
    if isinstance(rule, MapRule):
        raise TypeError(
            f"pass the class {type(rule).__name__} itself as the seeding rule, and its options in the settings: "
            "seeding__options={...}"
        )
    if not callable(rule):
        raise TypeError(f"a seeding rule is a name or a function, got {type(rule).__name__}")
    options_of(rule)
    return rule


def registered() -> dict[str, SeedingRule]:
    """Name -> function or class of every registered rule, in order of registration (a copy)."""
    return dict(_RULES)


@contextlib.contextmanager
def keep_registered() -> Iterator[dict[str, SeedingRule]]:
    """Context in which rules can be registered, which are forgotten at its end; gives the rules registered before."""
    before = dict(_RULES)
    try:
        yield before
    finally:
        _RULES.clear()
        _RULES.update(before)


def rule_options(rule: str | SeedingRule) -> dict[str, Option]:
    """Option name -> default; sliders and check boxes are made from it."""
    return {name: parameter.default for name, parameter in options_of(get_rule(rule)).items()}


def rule_choices(rule: str | SeedingRule) -> dict[str, tuple[str, ...]]:
    """Option name -> allowed words, for the options that are one of these; drop-down lists are made from it."""
    found = {name: typing.get_args(p.annotation) for name, p in options_of(get_rule(rule)).items()}
    return {name: words for name, words in found.items() if words and all(isinstance(word, str) for word in words)}


def option_values(rule: SeedingRule, given: Mapping[str, Any]) -> dict[str, Option]:
    """The options as the rule is called with them: those that are paths as ``Path``, which settings hold as text.

    Raises:
        TypeError: as ``check_options``.
    """
    check_options(rule, given)
    known = options_of(rule)
    return {
        name: Path(value).expanduser() if isinstance(known[name].default, Path) else value
        for name, value in given.items()
    }


def option_paths(rule: SeedingRule, given: Mapping[str, Any]) -> dict[str, Path]:
    """Option name -> path, for the options that are paths; an empty one is no file, and is left out."""
    values = rule_options(rule) | option_values(rule, given)
    return {name: value for name, value in values.items() if isinstance(value, Path) and value != Path()}


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
        if words := isinstance(default, str) and typing.get_args(known[name].annotation):
            fits, wanted = value in words, words
        elif isinstance(default, Path):
            fits, wanted = isinstance(value, str | Path), "the path of a file or folder"
        elif isinstance(default, str):
            fits, wanted = isinstance(value, str), "a text"
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
    if not isinstance(p.default, Option):
        raise TypeError(
            f"{wanted}; the default of option {p.name!r} must be a number, True/False, a text or a Path, got "
            f"{p.default!r}"
        )
    if isinstance(p.default, str) and p.annotation is not str and p.default not in typing.get_args(p.annotation):
        raise TypeError(
            f"{wanted}; option {p.name!r} is a text, so annotate it: {p.name}: str for any, Path for a file, or the "
            f'allowed words: {p.name}: Literal["{p.default}", ...] = "{p.default}"'
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
