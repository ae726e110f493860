"""The systems by name, each with its settings and its mapper."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from ..checks import check_name
from ..config import GSFusionConfig, RtgSlamConfig, gsfusion, rtg_slam
from ..seeding import SeedingRule
from .gsfusion import GSFusion
from .rtg_slam import RTGSLAM

Config = GSFusionConfig | RtgSlamConfig
Mapper = GSFusion | RTGSLAM


@dataclass(frozen=True)
class System:
    """One published system."""

    title: str
    config: type
    mapper: Any
    """Class of the mapper."""
    preset: Callable[..., Any]
    """Settings by the name of a preset."""


SYSTEMS = {
    "gsfusion": System("GSFusion", GSFusionConfig, GSFusion, gsfusion),
    "rtg_slam": System("RTG-SLAM", RtgSlamConfig, RTGSLAM, rtg_slam),
}


def get_system(name: str) -> System:
    """The system called ``name``. Raises ``KeyError`` with the known names."""
    check_name("system", name, SYSTEMS)
    return SYSTEMS[name]


def system_of(config: Config | Mapper) -> str:
    """Name of the system that settings, or a mapper, belong to."""
    return next(name for name, s in SYSTEMS.items() if isinstance(config, (s.config, s.mapper)))


def make_mapper(
    config: Config, *, seeding: "str | SeedingRule | None" = None, device: torch.device | str = "cpu"
) -> Mapper:
    """A mapper of the system that ``config`` belongs to."""
    return SYSTEMS[system_of(config)].mapper(config, seeding=seeding, device=device)
