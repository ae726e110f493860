"""Settings of a run: frozen dataclasses with the unit in the name, and presets named after papers and data sets."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from .checks import check_name, check_number, check_positive

C = TypeVar("C")


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
    options: dict[str, float] = field(default_factory=dict)
    """Keyword arguments for the rule."""

    def __post_init__(self):
        check_positive("seeding.quadtree_threshold", self.quadtree_threshold)
        if self.quadtree_min_cell_px < 1:
            raise ValueError(f"seeding.quadtree_min_cell_px must be >= 1, got {self.quadtree_min_cell_px}")


@dataclass(frozen=True, kw_only=True)
class OptimConfig:
    """Learning rates and schedule. GSFusion uses constant rates."""

    lr_xyz: float = 1.6e-4
    """Metres per step."""
    lr_sh_dc: float = 2.5e-3
    lr_sh_rest: float = 1.25e-4
    lr_log_scale: float = 1e-3
    lr_quat: float = 1e-3
    lr_opacity_logit: float = 5e-2
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    adam_steps: Literal["none", "shared", "per_row"] = "none"
    """Bias correction of Adam, which decides how fast a newborn Gaussian moves. "none": none, so that every newborn's
    first steps are 3 to 6 learning rates; "shared": by the step count of the whole map, as the released code, where it
    is so for all but the first frames' Gaussians; "per_row": by each Gaussian's own age, 1 learning rate."""
    keyframe_iterations: int = 5
    """m: steps on a keyframe."""
    frame_iterations: int = 3
    """n: steps on a frame that is no keyframe."""
    random_keyframe_iterations: int = 2
    """Steps on random earlier keyframes after a frame that is no keyframe."""
    global_iterations: int = 10
    """Passes over the keyframes after the scan."""
    ssim_weight: float = 0.2
    """Weight of D-SSIM in the global optimisation (released code 0.2; 0 is the loss as printed, Eq. 12)."""

    def __post_init__(self):
        for name in ("lr_xyz", "lr_sh_dc", "lr_sh_rest", "lr_log_scale", "lr_quat", "lr_opacity_logit"):
            check_number(f"optim.{name}", getattr(self, name), 0, 10)
        for name in ("beta1", "beta2"):
            check_number(f"optim.{name}", getattr(self, name), 0, 0.999999)
        check_number("optim.eps", self.eps, 0, 1)
        counts = ("keyframe_iterations", "frame_iterations", "random_keyframe_iterations", "global_iterations")
        for name in counts:
            if getattr(self, name) < 0:
                raise ValueError(f"optim.{name} must be >= 0, got {getattr(self, name)}")
        if not 0 <= self.ssim_weight <= 1:
            raise ValueError(f"optim.ssim_weight must be between 0 and 1, got {self.ssim_weight}")


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


@dataclass(frozen=True, kw_only=True)
class GSFusionConfig:
    """Everything that decides what a GSFusion run gives, but for the data's location."""

    tsdf: TsdfConfig = field(default_factory=TsdfConfig)
    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    data: DataConfig = field(default_factory=DataConfig)
    sh_degree: int = 3
    """Degree of the view-dependent colour, 0 to 3."""
    keyframe_min_seeds: int = 50
    """A frame with more new Gaussians than this is a keyframe."""
    keep_all_frames: bool = False
    """Revisit and globally optimise over every frame, not only keyframes (ScanNet++, whose views are sparse)."""
    seed: int = 0
    """Seed of every random draw of the run."""

    def __post_init__(self):
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")


_GSFUSION: dict[str, dict[str, Any]] = {
    "replica": {},
    "scannetpp": {
        "optim": {"keyframe_iterations": 10, "frame_iterations": 1, "random_keyframe_iterations": 9},
        "data": {"hold_out_every": 0},
        "keep_all_frames": True,
    },
    "tum": {
        "optim": {
            "keyframe_iterations": 10,
            "frame_iterations": 5,
            "random_keyframe_iterations": 5,
            "global_iterations": 20,
        },
    },
    "room": {"data": {"width": 320, "height": 240}},
    "online": {"optim": {"global_iterations": 0}},
}


def gsfusion(preset: str = "replica", **overrides: Any) -> GSFusionConfig:
    """Settings of GSFusion as published for a data set: "replica", "scannetpp", "tum"; "room" for the built-in scene;
    "online" is "replica" without the optimisation after the scan.

    Overrides are fields, nested ones with a dict or a double underscore:
    ``gsfusion("replica", optim__global_iterations=0, sh_degree=0)``.

    Raises:
        KeyError: unknown preset. ValueError: unknown field.
    """
    check_name("preset", preset, _GSFUSION)
    config = from_dict(GSFusionConfig, _GSFUSION[preset])
    return replace(config, **overrides)


def presets() -> list[str]:
    """Names that ``gsfusion`` takes."""
    return list(_GSFUSION)


def replace(config: GSFusionConfig, **overrides: Any) -> GSFusionConfig:
    """A copy of ``config`` with some fields changed; nested ones take a double underscore: ``tsdf__voxel_size_m``."""
    tree: dict[str, Any] = {}
    for name, value in overrides.items():
        node = tree
        *groups, leaf = name.split("__")
        for group in groups:
            node = node.setdefault(group, {})
        node[leaf] = value
    return _merge(config, tree, "")


def from_dict(cls: type[C], values: dict[str, Any]) -> C:
    """Build ``cls`` from nested dictionaries, as ``to_dict`` or ``config.json`` give them; unknown keys are refused."""
    return _merge(cls(), values, "")


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dictionaries of a config, ready for JSON."""
    return dataclasses.asdict(config)


def _merge(config: Any, values: dict[str, Any], path: str) -> Any:
    known = {f.name for f in dataclasses.fields(config)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ValueError(f"{path or 'config'}: unknown keys {unknown}; known: {sorted(known)}")
    changed = {}
    for name, value in values.items():
        old = getattr(config, name)
        nested = dataclasses.is_dataclass(old) and isinstance(value, dict)
        changed[name] = _merge(old, value, f"{path}{name}.") if nested else value
    return dataclasses.replace(config, **changed)
