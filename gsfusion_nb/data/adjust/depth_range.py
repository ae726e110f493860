"""Measured depth that lies outside of the range that is mapped."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ...config import SystemConfig

MOST_OUTSIDE = 0.1
"""Share of the measured depth that may be outside of the range that is mapped: of recordings of
rooms at most 0.01 is, of an iPhone close to a door 0.7, of a RealSense in an open-plan office
0.25."""
_SOME = 0.01
"""A side of the range is named if it leaves out this share."""
_MOST_VALUES = 200_000


@dataclass(frozen=True, kw_only=True)
class DepthRange:
    """The depth that is mapped, metres, and the settings that say so."""

    near_m: float
    far_m: float
    settings: tuple[str, str] = ("tsdf.near_m", "tsdf.far_m")
    """Names of the two."""

    @classmethod
    def of(cls, config: SystemConfig) -> "DepthRange":
        """The range of a system's settings: that of its TSDF, or that in which the depth of its
        data is read."""
        tsdf = getattr(config, "tsdf", None)
        if tsdf is not None:
            return cls(near_m=tsdf.near_m, far_m=tsdf.far_m)
        return cls(
            near_m=config.data.depth_min_m,
            far_m=config.data.depth_max_m or torch.inf,
            settings=("data.depth_min_m", "data.depth_max_m"),
        )

    @property
    def limits_reading(self) -> bool:
        """Whether frames are read without the depth that is not mapped."""
        return self.settings[0].startswith("data.")

    def outside(self, depths_m: Tensor) -> "DepthOutside":
        """What the range leaves out of measured depths, metres, of any shape; 0 or less: none."""
        measured_m = depths_m[depths_m > 0].flatten().double()
        measured_m = measured_m[:: max(1, len(measured_m) // _MOST_VALUES)]
        if not len(measured_m):
            return DepthOutside(range=self)
        first_m, last_m = torch.quantile(measured_m, measured_m.new_tensor([0.01, 0.99])).tolist()
        return DepthOutside(
            range=self,
            nearer=float((measured_m < self.near_m).double().mean()),
            farther=float((measured_m > self.far_m).double().mean()),
            first_m=first_m,
            last_m=last_m,
        )


@dataclass(frozen=True, kw_only=True)
class DepthOutside:
    """Shares of measured depth that are not mapped."""

    range: DepthRange
    nearer: float = 0.0
    farther: float = 0.0
    first_m: float = 0.0
    """The depth that 1 % of the pixels are nearer than, metres."""
    last_m: float = 0.0
    """The depth that 99 % of the pixels are nearer than, metres."""

    @property
    def is_much(self) -> bool:
        """Whether more is left out than of a usual recording."""
        return self.nearer + self.farther > MOST_OUTSIDE

    @property
    def sentence(self) -> str:
        """Which share is nearer or farther than which setting."""
        near, far = self.range.settings
        sides = (
            (self.nearer, f"nearer than {near} ({self.range.near_m:g} m)"),
            (self.farther, f"farther than {far} ({self.range.far_m:g} m)"),
        )
        first, *more = [(share, where) for share, where in sides if share >= _SOME]
        text = f"{first[0]:.0%} of the measured depth is {first[1]}"
        text += "".join(f" and {share:.0%} is {where}" for share, where in more)
        return f"{text}, where nothing is mapped"

    @property
    def flags(self) -> str:
        """Options of the command line with which it would be."""
        near, far = (f"--{name.replace('_', '-')}" for name in self.range.settings)
        flags = []
        if self.nearer >= _SOME:
            flags.append(f"{near} {0.9 * self.first_m:.2g}")
        if self.farther >= _SOME:
            flags.append(f"{far} {1.1 * self.last_m:.2g}")
        return " ".join(flags)
