"""Presets of a system: what a fidelity and a data set change in the defaults of its dataclass.

The defaults are the fidelity "measured". Every other fidelity is a function that names what paper
or released code do otherwise, and a table says what each data set needs.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ..checks import check_name
from .values import leaves, replace, to_dict

Changes = Mapping[str, Any]
"""Settings by name: a group of them as a dictionary."""

NAMES = ("replica", "scannetpp", "tum", "azure", "room", "online")
"""The presets that every system has."""
ROOM_IMAGES: Changes = {"data": {"width": 320, "height": 240}}
"""Of the built-in scene."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Presets:
    """The presets of a system.

    Args:
        fidelities: Fidelity -> its settings for a preset, the default first.
        data_sets: Preset -> what it sets in every fidelity. It counts as set by the user
            (``replace``).
    """

    fidelities: Mapping[str, Callable[[str], Any]]
    data_sets: Mapping[str, Changes]

    @classmethod
    def of(cls, config: type[Any], **data_sets: Changes) -> "Presets":
        """Presets of a system of one's own, whose defaults are those of its settings. They have all
        names that commands ask for.

        Example: ``preset = Presets.of(MyConfig, tum={"steps": 30})``.

        Args:
            config: Class of the settings.
            data_sets: Preset -> what it changes in the defaults, a group of settings as a
                dictionary. By default only "room" changes any: the size of the built-in scene's
                images.
        """
        changes = {name: {} for name in NAMES} | {"room": ROOM_IMAGES} | data_sets
        return cls(fidelities={"": lambda _: config()}, data_sets=changes)

    def __call__(
        self, preset: str = "replica", fidelity: str | None = None, **overrides: Any
    ) -> Any:
        """``make`` with the first fidelity, if none is named, and with ``overrides`` as for
        ``replace``."""
        first = next(iter(self.fidelities))
        return self.make(preset, first if fidelity is None else fidelity, overrides)

    def make(self, preset: str, fidelity: str, overrides: Changes) -> Any:
        """The settings of a preset and a fidelity, with fields changed as for ``replace``.

        Raises:
            KeyError: unknown preset or fidelity. ValueError: unknown field.
        """
        check_name("preset", preset, self.data_sets)
        check_name("fidelity", fidelity, self.fidelities)
        config = replace(self.fidelities[fidelity](preset), **self.data_sets[preset])
        return replace(config, **overrides)

    @functools.cached_property
    def _variants(self) -> dict[str, list[dict[str, Any]]]:
        """Fidelity -> values by dotted name for each preset."""
        return {
            fidelity: [_results(self.make(preset, fidelity, {})) for preset in self.data_sets]
            for fidelity in self.fidelities
        }

    def fidelity_of(self, config: Any) -> str:
        """The fidelity that ``config`` follows, with its exceptions: "paper", or "code, but
        optim.ssim_weight 0.0".

        Only the settings in which the fidelities differ count. Of equally close ones it is the
        first.
        """
        deciding = {
            key
            for same_data in zip(*self._variants.values(), strict=True)
            for key in same_data[0]
            if any(values[key] != same_data[0][key] for values in same_data)
        }
        mine = {key: value for key, value in sorted(_results(config).items()) if key in deciding}
        candidates = [
            (name, [f"{key} {value}" for key, value in mine.items() if value != values[key]])
            for name, variants in self._variants.items()
            for values in variants
        ]
        closest, exceptions = min(candidates, key=lambda candidate: len(candidate[1]))
        return f"{closest}, but {', '.join(exceptions)}" if exceptions else closest


def _results(config: Any) -> dict[str, Any]:
    """The settings that results depend on, by dotted name: not which of them the user set."""
    values = leaves(to_dict(config))
    del values["seeding.own_settings"]
    return values
