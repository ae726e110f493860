"""Rows of a comparison whose maps are equal bit for bit: what differs between them had no
effect."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .run_result import RunResult


@dataclass(frozen=True, kw_only=True)
class EqualMaps:
    """Rules, or variants, that made the same map; ``str`` says it in words."""

    budget: str
    labels: tuple[str, ...]
    """In the order of the results."""
    places: tuple[tuple[str, int], ...]
    """Scene and seed of each run in which their maps are equal."""

    def __str__(self) -> str:
        seeds: dict[str, list[int]] = {}
        for scene, seed in self.places:
            seeds.setdefault(scene, []).append(seed)
        where = "; ".join(
            f"{scene} (seed {', '.join(map(str, of))})" for scene, of in seeds.items()
        )
        names = f"{', '.join(self.labels[:-1])} and {self.labels[-1]}"
        return f"{names} made the same map on {where}: what differs between them had no effect"


def equal_maps(results: "Iterable[RunResult]") -> list[EqualMaps]:
    """All rows with equal maps at one budget, on one scene and with one seed, joined over scenes
    and seeds.

    A run without ``map_hash`` is not known to be equal to any (``unknown_maps``).
    """
    same: dict[tuple[str, str, int, str], list[str]] = {}
    for result in results:
        spec = result.spec
        if result.status == "done" and result.map_hash:
            same.setdefault(
                (str(spec.budget), spec.scene, spec.seed, result.map_hash),
                [],
            ).append(spec.label)
    places: dict[tuple[str, tuple[str, ...]], list[tuple[str, int]]] = {}
    for (budget, scene, seed, _), runs_of_map in same.items():
        labels = tuple(dict.fromkeys(runs_of_map))
        if len(labels) > 1:
            places.setdefault((budget, labels), []).append((scene, seed))
    return [
        EqualMaps(budget=budget, labels=labels, places=tuple(runs_of_map))
        for (budget, labels), runs_of_map in places.items()
    ]


def unknown_maps(results: "Iterable[RunResult]") -> list[str]:
    """A sentence if some completed runs have no hash of their map."""
    unknown = list(
        dict.fromkeys(r.spec.label for r in results if r.status == "done" and not r.map_hash)
    )
    return (
        [f"whether the maps of {', '.join(unknown)} equal others is not known: no hash of them"]
        if unknown
        else []
    )
