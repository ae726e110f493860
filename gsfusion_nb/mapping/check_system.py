"""Whether a class is a mapping system: what commands ask of one, asked before anything runs."""

import dataclasses
import inspect
from typing import Any

from ..checks import shown
from ..config import SystemConfig
from ..errors import ArgumentError, KindError
from .description import SystemDescription
from .mapper import Mapper

ASKED_PRESETS = ("replica", "room")
"""The presets that commands take where the user names none."""


def check_system(mapper: Any, origin: str) -> type[Mapper]:
    """The class itself, if it is a system.

    Args:
        mapper: The class.
        origin: Where it comes from, for the message.

    Raises:
        TypeError: it is no class derived from ``Mapper``, or a part of a system is missing or of
            another kind; the message says which.
        ValueError: its default settings, or those of a preset, cannot be made.
    """
    if not (isinstance(mapper, type) and issubclass(mapper, Mapper)):
        raise KindError(
            f"{origin}: expected a class derived from gsfusion_nb.mapping.Mapper, got "
            f"{shown(mapper)}"
        )
    name = mapper.__name__
    if inspect.isabstract(mapper):
        missing = ", ".join(sorted(mapper.__abstractmethods__))
        raise KindError(f"{origin}: the system {name} lacks {missing}")
    description = getattr(mapper, "description", None)
    if not isinstance(description, SystemDescription):
        raise KindError(
            f"{origin}: the system {name} needs a description, such as description = "
            f"SystemDescription(title={name!r}), got {shown(description)}"
        )
    config_type = getattr(mapper, "config_type", None)
    if not (
        isinstance(config_type, type)
        and issubclass(config_type, SystemConfig)
        and dataclasses.is_dataclass(config_type)
    ):
        raise KindError(
            f"{origin}: the system {name} needs config_type, a dataclass derived from "
            f"gsfusion_nb.config.SystemConfig, got {shown(config_type)}"
        )
    if "__dataclass_fields__" not in vars(config_type):
        raise KindError(
            f"{origin}: {config_type.__name__}, the settings of the system {name}, needs "
            "@dataclass(frozen=True, kw_only=True)"
        )
    _check_presets(mapper, origin)
    return mapper


def _check_presets(mapper: type[Mapper], origin: str) -> None:
    name = mapper.__name__
    for preset in ASKED_PRESETS:
        try:
            config = mapper.preset(preset)
        except Exception as e:  # code of somebody else
            raise ArgumentError(
                f"{origin}: the system {name} gives no settings for the preset {preset!r}: "
                f"{type(e).__name__}: {e}"
            ) from None
        if type(config) is not mapper.config_type:
            raise KindError(
                f"{origin}: the preset {preset!r} of the system {name} must give a "
                f"{mapper.config_type.__name__}, got {shown(config)}"
            )
