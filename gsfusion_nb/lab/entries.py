"""All combinations of rules, scenes, seeds and budgets, as runs of the lab."""

import itertools
from collections.abc import Iterable
from typing import Any

from ..seeding import SeedingRule
from ..seeding.rule_file import find_rule
from .entrant import Entrant
from .map_scene import Entry
from .spec import Budget


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
        rules: Names, "FILE.py:name", functions or classes of a notebook, or ``Entrant``, which also carries options and
            a label.
        scenes: Folders of recordings, or "room".
        seeds: One run each.
        budgets: What each rule may spend.
        shared: Other fields of ``RunSpec``, for all runs: ``settings={"tsdf.voxel_size_m": 0.02}``.

    Raises:
        KeyError: unknown rule. TypeError: a rule with a wrong signature. ValueError: two rules with the same label, or
            a file that cannot be read. FileNotFoundError: no such file.
    """
    entrants = [rule if isinstance(rule, Entrant) else Entrant(rule) for rule in rules]
    names = [entrant.name for entrant in entrants]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"a table needs rules with different labels, got {', '.join(twice)} twice")
    for entrant in entrants:
        find_rule(entrant.rule)
    return [
        entrant.entry(scene=scene, budget=budget, seed=seed, **shared)
        for budget, scene, entrant, seed in itertools.product(budgets, scenes, entrants, seeds)
    ]
