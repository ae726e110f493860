"""The mapping systems by name. A new system is added to ``SYSTEMS``."""

from typing import Any

import torch

from ..checks import check_name
from ..config import SystemConfig
from ..errors import KindError
from ..optim import UpdateFunction
from ..seeding import SeedingRule
from .gps_slam import GPSSLAM
from .gsfusion import GSFusion
from .mapper import Mapper
from .rtg_slam import RTGSLAM
from .training import LossFunction, given_functions

SYSTEMS: dict[str, type[Mapper]] = {
    "gsfusion": GSFusion,
    "rtg_slam": RTGSLAM,
    "gps_slam": GPSSLAM,
}


def get_system(name: str) -> type[Mapper]:
    """Class of the mapper called ``name``. Raises ``KeyError`` with the known names."""
    check_name("system", name, SYSTEMS)
    return SYSTEMS[name]


def system_of(config: SystemConfig) -> str:
    """Name of the system that settings belong to.

    Raises:
        TypeError: they are not the settings of a system.
    """
    for name, mapper in SYSTEMS.items():
        if type(config) is mapper.config_type:
            return name
    raise KindError(
        f"expected the settings of a system ({', '.join(SYSTEMS)}), got {type(config).__name__}"
    )


def make_mapper(
    config: SystemConfig,
    *,
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    loss: LossFunction | None = None,
    optimiser: UpdateFunction | None = None,
) -> Any:
    """A new mapper of the system that ``config`` belongs to; arguments as for ``Mapper``."""
    given = given_functions(loss, optimiser)
    return SYSTEMS[system_of(config)](config, seeding=seeding, device=device, **given)
