"""Which scenes of a comparison are independent: scenes that share frames of a recording are one
unit."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .run_result import RunResult


def scene_units(results: "Iterable[RunResult]") -> dict[str, str]:
    """Scene -> its unit, in the order in which the scenes were first seen.

    Scenes with equal data, or with a frame in common (``RunResult.frames``), are one unit, also
    through a third scene. Its name is made of theirs: "kitchen + kitchen again". A scene of which
    no frames are known is a unit of its own.
    """
    marks: dict[str, set[str]] = {}
    for result in results:
        own = marks.setdefault(result.spec.scene, set())
        own.update(result.frames, [result.data_hash] if result.data_hash else [])
    units: list[tuple[list[str], set[str]]] = []
    for scene, own in marks.items():
        overlaps = [unit for unit in units if unit[1] & own]
        units = [unit for unit in units if unit not in overlaps]
        scenes = [name for unit in overlaps for name in unit[0]]
        units.append(([*scenes, scene], own.union(*(unit[1] for unit in overlaps))))
    of_scene = {scene: " + ".join(scenes) for scenes, _ in units for scene in scenes}
    return {scene: of_scene[scene] for scene in marks}


def shared_frames(units: Mapping[str, str]) -> list[str]:
    """A sentence for each unit of several scenes."""
    scenes: dict[str, list[str]] = {}
    for scene, unit in units.items():
        scenes.setdefault(unit, []).append(scene)
    return [
        f"{', '.join(names[:-1])} and {names[-1]} share frames, so they count as one scene in "
        "means and tests"
        for names in scenes.values()
        if len(names) > 1
    ]
