"""Settings that both systems share: the volumetric map, seeding, the data."""

from dataclasses import dataclass, field
from typing import Literal

from ..checks import check_number, check_positive
from .repair import RepairConfig


@dataclass(frozen=True, kw_only=True)
class TsdfConfig:
    """The volumetric map."""

    voxel_size_m: float = 0.01
    """Edge of one voxel, metres."""
    truncation_voxels: float = 8.0
    """Half width of the band around the surface, voxels."""
    max_weight: float = 100.0
    """Cap on a voxel's observation count (w_max of GSFusion Eq. 8)."""
    near_m: float = 0.4
    """Depth below this is ignored, metres."""
    far_m: float = 6.0
    """Depth beyond this allocates nothing, metres."""
    sdf: Literal["z", "ray"] = "ray"
    """Distance to the measured surface along z (GSFusion Eq. 6) or along the viewing ray (as the released code)."""
    outlier_guard: bool = True
    """Refuse to allocate blocks for isolated depth pixels, whose neighbours are all far from them in depth."""

    def __post_init__(self):
        for name in ("voxel_size_m", "truncation_voxels", "max_weight", "far_m"):
            check_positive(f"tsdf.{name}", getattr(self, name))
        check_number("tsdf.voxel_size_m", self.voxel_size_m, 0.001, 1.0)
        check_number("tsdf.truncation_voxels", self.truncation_voxels, 1, 64)
        check_number("tsdf.far_m", self.far_m, 0, 1000)
        check_number("tsdf.near_m", self.near_m)
        if not 0 <= self.near_m < self.far_m:
            raise ValueError(f"tsdf.near_m must be >= 0 and below far_m, got near {self.near_m} and far {self.far_m}")

    @property
    def truncation_m(self) -> float:
        """Half width of the band, metres."""
        return self.truncation_voxels * self.voxel_size_m


@dataclass(frozen=True, kw_only=True)
class SeedingConfig:
    """Where new Gaussians are born."""

    rule: str = "gsfusion"
    """Name of a registered seeding rule."""
    quadtree_threshold: float = 0.1
    """A cell whose contrast is above this is split."""
    quadtree_min_cell_px: int = 1
    """A cell is split only if half its width and half its height stay above this, pixels."""
    quadtree_contrast: Literal["released", "std"] = "released"
    """"released": luma-weighted variance times image pixels / 9e7, as the released code; "std": luma-weighted standard
    deviation in 0..1, the same at every resolution."""
    one_per_voxel: bool = False
    """Keep at most one new Gaussian in a voxel (the paper's text; the released code does not)."""
    options: dict[str, int | float | str | bool] = field(default_factory=dict)
    """Keyword arguments for the rule."""

    def __post_init__(self):
        check_positive("seeding.quadtree_threshold", self.quadtree_threshold)
        if self.quadtree_min_cell_px < 1:
            raise ValueError(f"seeding.quadtree_min_cell_px must be >= 1, got {self.quadtree_min_cell_px}")


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """What is read from a sequence, and how."""

    width: int = 0
    """Resize colour and depth to this width, pixels; 0 keeps the source's size (or follows height)."""
    height: int = 0
    """Resize to this height, pixels; 0 keeps the source's size (or follows width)."""
    start: int = 0
    """First frame."""
    stop: int = 0
    """One past the last frame; 0 means to the end."""
    stride: int = 1
    """Take every stride-th frame."""
    depth_min_m: float = 0.0
    """Nearer depth counts as missing, metres."""
    depth_max_m: float = 0.0
    """Farther depth counts as missing, metres; 0 means no limit."""
    hold_out_every: int = 8
    """Every k-th frame is never mapped and serves as a novel view; 0 maps all."""
    hold_out_offset: int = 4
    """Which of the k frames is held out."""
    repair: RepairConfig = field(default_factory=RepairConfig)
    """Corrections of a recording that differs from what its layout says."""

    def __post_init__(self):
        for name in ("start", "stop", "hold_out_every", "hold_out_offset"):
            if getattr(self, name) < 0:
                raise ValueError(f"data.{name} must be >= 0, got {getattr(self, name)}")
        for name in ("width", "height"):
            check_number(f"data.{name}", getattr(self, name), 0, 16384)
        for name in ("depth_min_m", "depth_max_m"):
            check_number(f"data.{name}", getattr(self, name), 0, 1000)
        if self.depth_max_m and self.depth_max_m <= self.depth_min_m:
            raise ValueError(f"data.depth_max_m must be above depth_min_m {self.depth_min_m}, got {self.depth_max_m}")
        if self.stride < 1:
            raise ValueError(f"data.stride must be >= 1, got {self.stride}")
        if self.hold_out_every == 1:
            raise ValueError("data.hold_out_every=1 would hold out every frame; use 0 for none or 2 and more")
