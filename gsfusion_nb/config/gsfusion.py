"""Settings of GSFusion and its presets, named after papers and data sets."""

from dataclasses import dataclass, field
from typing import Any, Literal

from ..checks import check_name, check_number
from .parts import DataConfig, SeedingConfig, TsdfConfig
from .tracking import TrackingConfig
from .values import from_dict, replace


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
class GSFusionConfig:
    """Everything that decides what a GSFusion run gives, but for the data's location."""

    tsdf: TsdfConfig = field(default_factory=TsdfConfig)
    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    data: DataConfig = field(default_factory=DataConfig)
    sh_degree: int = 3
    """Degree of the view-dependent colour, 0 to 3."""
    keyframe_min_seeds: int = 50
    """A frame with more new Gaussians than this is a keyframe."""
    keep_all_frames: bool = False
    """Revisit and globally optimise over every frame, not only keyframes (ScanNet++, whose views are sparse)."""
    keyframes_on: Literal["device", "cpu"] = "device"
    """Where the keyframes' images are kept: with the map, or in the memory of the processor, which saves a GPU's."""
    seed: int = 0
    """Seed of every random draw of the run."""

    def __post_init__(self):
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")
        check_name("keyframes_on", self.keyframes_on, ("device", "cpu"))


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
