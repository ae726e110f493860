"""All combinations of rules, scenes, seeds and budgets, as runs of the lab."""

import itertools
from collections.abc import Iterable
from typing import Any

from ..seeding import SeedingRule, get_rule, rule_fingerprint, rule_name
from .contest import Entrant
from .map_scene import Entry
from .spec import Budget, RunSpec


def entries_of(
    rules: "Iterable[str | SeedingRule | Entrant]",
    scenes: Iterable[str] = ("room",),
    *,
    seeds: Iterable[int] = (0, 1, 2),
    budgets: Iterable[Budget] = (Budget(),),
    **shared: Any,
) -> list[Entry]:
    """Every rule on every scene with every seed at every budget.

    The seeds change fastest, then the rules: the first rows of a table are complete early.

    Args:
        rules: Names, functions or classes of a notebook, or ``Entrant``, which also carries options and a label.
        scenes: Folders of recordings, or "room".
        seeds: One run each.
        budgets: What each rule may spend.
        shared: Other fields of ``RunSpec``, for all runs: ``settings={"tsdf.voxel_size_m": 0.02}``.

    Raises:
        KeyError: unknown rule. TypeError: a rule with a wrong signature. ValueError: two rules with the same label.
    """
    entrants = [rule if isinstance(rule, Entrant) else Entrant(rule) for rule in rules]
    names = [entrant.name for entrant in entrants]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"a table needs rules with different labels, got {', '.join(twice)} twice")
    for entrant in entrants:
        get_rule(entrant.rule)
    return [
        _entry(entrant, scene=scene, budget=budget, seed=seed, **shared)
        for budget, scene, entrant, seed in itertools.product(budgets, scenes, entrants, seeds)
    ]


def _entry(entrant: Entrant, **fields: Any) -> Entry:
    named = {"rule": rule_name(entrant.rule), "label": entrant.name, "options": dict(entrant.options)}
    if isinstance(entrant.rule, str):
        return Entry(spec=RunSpec(**named, **fields))
    return Entry(spec=RunSpec(**named, rule_hash=rule_fingerprint(entrant.rule), **fields), rule=entrant.rule)
