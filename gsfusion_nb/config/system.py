"""Settings that every mapping system has."""

from dataclasses import dataclass, field
from typing import Literal

from ..checks import check_name
from .parts import DataConfig, SeedingConfig
from .tracking import TrackingConfig
from .values import check_kinds


@dataclass(frozen=True, kw_only=True)
class SystemConfig:
    """What the settings of any system hold; each system adds its own."""

    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    data: DataConfig = field(default_factory=DataConfig)
    sh_degree: int = 3
    """Degree of the spherical harmonics that store a Gaussian's colour, 0 to 3. 0: one colour from all sides, least
    memory and time. 3: colour may change with the viewing direction (gloss, reflections)."""
    keyframes_on: Literal["device", "cpu"] = "device"
    """Where the images of the keyframes are kept: "device" (with the map) or "cpu", which saves memory of the GPU."""
    seed: int = 0
    """Seed of all random numbers. The same seed on the same machine gives the same map."""

    @property
    def source_stride(self) -> int:
        """Frames of the recording from one mapped frame to the next."""
        return self.seeding.source_stride or self.data.stride

    def __post_init__(self):
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")
        check_name("keyframes_on", self.keyframes_on, ("device", "cpu"))
        check_kinds("", self)
