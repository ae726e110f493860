"""Seeding rules by name: ``@seeding_rule`` registers a function or class; a mapper takes its name,
or the rule itself.

A rule is a function ``(ctx: SeedContext, *, number=default, ...) -> Seeds``, or a class
(``MapRule``)."""

import contextlib
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from ..checks import check_name, shown
from ..errors import ArgumentError, KindError
from ..extensions import Extension, extensions
from .map_rule import MapRule, Option, SeedingRule, rule_name
from .options import option_values, options_of

F = TypeVar("F", bound=SeedingRule)

_RULES: dict[str, SeedingRule] = {}

_TRAINING = "published_training"


def seeding_rule(rule: F) -> F:
    """Register ``rule`` under its own name and return it unchanged; a rule of that name is
    replaced.

    Raises:
        TypeError: the signature is not ``(ctx, *, name=default, ...)`` with defaults that are
            numbers, True/False, a word of a ``Literal["...", ...]``, a text annotated ``str``, or a
            ``Path``; or the class is not as ``MapRule`` says.
    """
    if not callable(rule):
        raise KindError(
            f"@seeding_rule decorates a function, got {type(rule).__name__}; write it without "
            "parentheses"
        )
    if not rule_name(rule).isidentifier():
        raise KindError(
            f"a seeding rule is registered by its name, and {rule_name(rule)!r} is not a name: use "
            "def"
        )
    options_of(rule)
    _RULES[rule_name(rule)] = rule
    return rule


def trained_otherwise(training: str) -> Callable[[F], F]:
    """Say of a rule how its publication trains the Gaussians, where that is not how a comparison of
    rules trains them.

    Tables of the lab mark its row, because a number of it is one of the rule and not of the
    published system. Put it above ``@seeding_rule``.

    Args:
        training: A few words without a full stop: "centres fixed, 100 steps a frame".
    """

    def mark(rule: F) -> F:
        setattr(rule, _TRAINING, training)
        return rule

    return mark


def published_training(rule: SeedingRule) -> str:
    """How the publication of a rule trains the Gaussians, if that was said by
    ``trained_otherwise``; else empty. What a class derives from does not count."""
    return str(getattr(rule, "__dict__", {}).get(_TRAINING, ""))


def get_rule(rule: str | SeedingRule) -> SeedingRule:
    """The rule registered under a name, or that an installed package adds by it; a function or
    class is returned unchanged after its signature was checked.

    Raises:
        KeyError: no rule of that name; the message lists the known ones. TypeError: bad signature.
        ValueError: the package that adds it cannot be loaded, or adds something else.
    """
    if isinstance(rule, str):
        if rule not in _RULES:
            installed = extensions("rules", built_in=_RULES)
            check_name("seeding rule", rule, [*_RULES, *installed])
            _RULES[rule] = _rule_of(installed[rule])
        return _RULES[rule]
    if isinstance(rule, MapRule):
        raise KindError(
            f"pass the class {type(rule).__name__} itself as the seeding rule, and its options in "
            "the settings: seeding__options={...}"
        )
    if not callable(rule):
        raise KindError(f"a seeding rule is a name or a function, got {type(rule).__name__}")
    options_of(rule)
    return rule


def _rule_of(extension: Extension) -> SeedingRule:
    """The rule that an installed package adds. Others that its module registers are not
    registered."""
    with keep_registered():
        loaded = extension.load()
    rule = cast(SeedingRule, loaded)
    if not callable(loaded) or rule_name(rule) != extension.name:
        raise ArgumentError(
            f"expected a seeding rule called {extension.name!r}, got {shown(loaded)}: "
            f"{extension.in_words}"
        )
    options_of(rule)
    return rule


def registered() -> dict[str, SeedingRule]:
    """Name -> function or class of every registered rule, in order of registration (a copy)."""
    return dict(_RULES)


@contextlib.contextmanager
def keep_registered() -> Iterator[dict[str, SeedingRule]]:
    """Context in which rules can be registered, which are forgotten at its end; gives the rules
    registered before."""
    old_rules = dict(_RULES)
    try:
        yield old_rules
    finally:
        _RULES.clear()
        _RULES.update(old_rules)


def rule_options(rule: str | SeedingRule) -> dict[str, Option]:
    """Option name -> default; sliders and check boxes are made from it."""
    return {name: parameter.default for name, parameter in options_of(get_rule(rule)).items()}


def rule_choices(rule: str | SeedingRule) -> dict[str, tuple[str, ...]]:
    """Option name -> allowed words, for the options that are one of these; drop-down lists are made
    from it."""
    words_of = {
        name: typing.get_args(p.annotation) for name, p in options_of(get_rule(rule)).items()
    }
    return {
        name: words
        for name, words in words_of.items()
        if words and all(isinstance(word, str) for word in words)
    }


def option_paths(rule: SeedingRule, options: Mapping[str, Any]) -> dict[str, Path]:
    """Option name -> path, for the options that are paths; an empty one is no file, and is left
    out."""
    values = rule_options(rule) | option_values(rule, options)
    return {
        name: value for name, value in values.items() if isinstance(value, Path) and value != Path()
    }
