"""All combinations of rules, scenes, seeds and budgets, as runs of the lab."""

import itertools
from collections.abc import Iterable
from typing import Any

from ..config import SystemConfig
from ..data import OpenedSequence, sequence_fingerprint
from ..mapping import get_system, system_of
from ..seeding import SeedingRule
from ..seeding.rule_file import find_rule
from .check_run import check_run
from .entrant import Entrant
from .map_scene import Entry
from .setting_names import changed_settings
from .spec import Budget


def entries_of(
    rules: "Iterable[str | SeedingRule | Entrant]",
    scenes: "Iterable[str | OpenedSequence]" = ("room",),
    *,
    seeds: Iterable[int] = (0, 1, 2),
    budgets: Iterable[Budget] = (Budget(),),
    config: SystemConfig | None = None,
    **shared: Any,
) -> list[Entry]:
    """Every rule on every scene with every seed at every budget.

    The seeds change fastest, then the rules: the first rows of a table are complete early.

    Args:
        rules: Names, "FILE.py:name", functions or classes of a notebook, or ``Entrant``, which also carries options and
            a label.
        scenes: Folders of recordings, "room", or open sequences.
        seeds: One run each.
        budgets: What each rule may spend.
        config: Settings of all runs, of any system; its rule, the options of the rule and its seed are not used.
        shared: Other fields of ``RunSpec``, for all runs: ``settings={"tsdf.voxel_size_m": 0.02}`` in place of
            ``config``.

    Raises:
        KeyError: unknown rule, system or preset. TypeError: a rule with a wrong signature, an option that it does not
            have or of a wrong type, or both ``config`` and ``settings``.
        ValueError: no rule, two rules with the same label, a file that cannot be read, a setting that does not exist,
            an invalid value, or a rule without an option to tune where the budget asks for it. FileNotFoundError: no
            such file.
    """
    entrants = [rule if isinstance(rule, Entrant) else Entrant(rule) for rule in rules]
    names = [entrant.name for entrant in entrants]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or not names:
        found = f"{', '.join(twice)} twice; give one of them a label" if twice else "no rule"
        raise ValueError(f"a comparison needs rules with different labels, got {found}")
    for entrant in entrants:
        find_rule(entrant.rule)
    own = _fields_of_config(config) if config is not None else {}
    places = [_fields_of_scene(scene) for scene in scenes]
    entries = [
        entrant.entry(budget=budget, seed=seed, **place, **own, **shared)
        for budget, place, entrant, seed in itertools.product(budgets, places, entrants, seeds)
    ]
    for entry in entries:
        check_run(entry.spec, entry.found_rule())
    return entries


def _fields_of_scene(scene: str | OpenedSequence) -> dict[str, Any]:
    if isinstance(scene, str):
        return {"scene": scene}
    return {"sequence": scene, "scene": scene.name, "data_hash": sequence_fingerprint(scene)}


def _fields_of_config(config: SystemConfig) -> dict[str, Any]:
    """System, preset, and the settings that differ from it; a run has its own rule, options and seed."""
    system = system_of(config)
    settings = changed_settings(config, get_system(system).preset("room"))
    for name in ("seeding.rule", "seeding.options", "seed"):
        settings.pop(name, None)
    return {"system": system, "preset": "room", "settings": settings}
