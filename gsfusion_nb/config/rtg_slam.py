"""Settings of RTG-SLAM (Peng et al. 2024) and its presets, named after data sets.

Where the paper and the released code differ, the field says what each does; ``rtg_slam(fidelity=...)`` sets them all.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from ..checks import check_name, check_number, check_positive
from ..constants import DISC_MAX_OFFSET, DISC_MIN_COSINE, OPAQUE_ALPHA
from .parts import DataConfig, SeedingConfig, TsdfConfig
from .tracking import TrackingConfig
from .values import check_kinds, from_dict, replace


@dataclass(frozen=True, kw_only=True)
class DiscConfig:
    """When a ray hits a disc, and where (Eq. 4-5)."""

    opaque_alpha: float = OPAQUE_ALPHA
    """delta_alpha: a disc is hit where its alpha reaches this (paper exp(-0.5), code 0.6)."""
    max_offset: float | None = DISC_MAX_OFFSET
    """Farther from the centre than so many largest standard deviations the centre's depth counts (paper: no such test,
    None; code 1)."""
    min_cosine: float = DISC_MIN_COSINE
    """Discs seen at a flatter angle take the centre's depth."""
    depth: Literal["disc", "blended"] = "disc"
    """"blended": depth as in other splatting systems, sum of w_k z_k / alpha (the ablation of Fig. 7)."""

    def __post_init__(self):
        check_kinds("discs", self)
        check_number("discs.opaque_alpha", self.opaque_alpha, 0.01, 0.99)
        check_number("discs.min_cosine", self.min_cosine, 0, 1)
        if self.max_offset is not None:
            check_positive("discs.max_offset", self.max_offset)


@dataclass(frozen=True, kw_only=True)
class WindowConfig:
    """Optimisation over the last frames (Eq. 7-9)."""

    every_frames: int = 6
    """Optimise after every so many frames."""
    frames: int = 5
    """Length of the window, frames."""
    iterations: int = 50
    """Steps per optimisation."""
    lr_xyz: float = 1e-3
    """Metres per step."""
    lr_sh_dc: float = 5e-4
    lr_sh_rest: float = 2.5e-5
    lr_log_scale: float = 4e-3
    lr_quat: float = 1e-3
    weight_colour: float = 1.0
    """w_c of Eq. 8 (code 0.8)."""
    weight_depth: float = 1.0
    """w_d of Eq. 8."""
    weight_regulariser: float = 1000.0
    """w_reg of Eq. 8: holds centre, orientation and scale of transparent Gaussians at their anchor."""
    anchor: Literal["birth", "window"] = "birth"
    """The values they are held at: those they were born with (paper), or those at the start of the window (code)."""
    draw: Literal["random", "newest_half"] = "random"
    """Each step takes a random frame of the window (paper); or that in the first half, the newest frame in the second
    (code)."""
    depth_behind_m: float | None = 0.1
    """Depth rendered farther than this behind the measurement has no loss (code; paper: None)."""
    history_max_weight: float = 1.0
    """Fusion with the values before the window (Eq. 9): largest weight of these (paper 1, code 0.5)."""
    only_unstable: bool = True
    """Optimise unstable Gaussians and the pixels they touch; otherwise all of them (the ablation)."""

    def __post_init__(self):
        check_kinds("window", self)
        for name in ("every_frames", "frames"):
            check_number(f"window.{name}", getattr(self, name), 1, 10_000)
        check_number("window.iterations", self.iterations, 0, 100_000)
        for name in ("lr_xyz", "lr_sh_dc", "lr_sh_rest", "lr_log_scale", "lr_quat"):
            check_number(f"window.{name}", getattr(self, name), 0, 10)
        for name in ("weight_colour", "weight_depth", "weight_regulariser"):
            check_number(f"window.{name}", getattr(self, name), 0, 1e6)
        check_number("window.history_max_weight", self.history_max_weight, 0, 1)
        if self.depth_behind_m is not None:
            check_positive("window.depth_behind_m", self.depth_behind_m)


@dataclass(frozen=True, kw_only=True)
class StateConfig:
    """Stable and unstable Gaussians (section 3.2, "State management")."""

    stable_confidence: float = 100.0
    """delta_eta: a Gaussian optimised more often than this becomes stable."""
    unstable_frames: int = 120
    """delta_t: one that is still unstable after so many frames is removed."""
    age: Literal["all", "in_view"] = "all"
    """Frames that count for it: all since it was born (paper, code), or those with its centre in the picture, so that
    what the camera passes quickly and leaves is not lost."""
    error_count: int = 10
    """delta_e: a stable Gaussian in error in more frames than this loses its state (code: in 10 or more)."""
    colour_error: float = 0.1
    """delta_c: in error where the mean absolute difference over R, G, B, in 0..1, is above this."""
    depth_error_m: float = 0.1
    """delta_d."""
    depth_error_sides: Literal["both", "in_front"] = "both"
    """Depth errors that count: of either sign (paper), or only of a model in front of the measurement (code)."""
    on_error: Literal["release", "delete"] = "release"
    """A stable Gaussian in error becomes unstable again (paper); or is deleted if its depth is wrong and left alone if
    its colour is (code)."""
    max_radius_factor: float | None = 10.0
    """Gaussians with a radius above so many times the mean are removed (code; paper: None)."""

    def __post_init__(self):
        check_kinds("states", self)
        check_positive("states.stable_confidence", self.stable_confidence)
        for name in ("unstable_frames", "error_count"):
            check_number(f"states.{name}", getattr(self, name), 1, 1_000_000)
        check_positive("states.colour_error", self.colour_error)
        check_positive("states.depth_error_m", self.depth_error_m)
        if self.max_radius_factor is not None:
            check_number("states.max_radius_factor", self.max_radius_factor, 1, math.inf)


@dataclass(frozen=True, kw_only=True)
class KeyframeConfig:
    """Keyframes by motion, and the optimisation that each starts (section 3.2, "Keyframes and global optimization")."""

    rotation_deg: float = 30.0
    translation_m: float = 0.3
    """A keyframe is taken when the camera has turned or its centre moved so far since the last one."""
    latest: int = 1
    """The optimisation draws from so many latest keyframes (code 3) ..."""
    random: int = 3
    """... and so many random ones (code 0)."""
    iterations: int = 50
    pixel_share: float = 0.4
    """Share of the pixels, those with the largest colour errors, that have a loss."""
    lr_factor: float = 0.1
    """Learning rates in these, as a share of the window's; centres do not move."""
    rows: Literal["all", "stable"] = "all"
    """All Gaussians (paper), or only the stable ones are drawn and optimised (code)."""
    instead_of_window: bool = False
    """Leave out the window optimisation of that frame (code, except on ScanNet++)."""

    def __post_init__(self):
        check_kinds("keyframes", self)
        check_positive("keyframes.rotation_deg", self.rotation_deg)
        check_positive("keyframes.translation_m", self.translation_m)
        for name in ("latest", "random", "iterations"):
            check_number(f"keyframes.{name}", getattr(self, name), 0, 100_000)
        check_number("keyframes.pixel_share", self.pixel_share, 0.001, 1)
        check_number("keyframes.lr_factor", self.lr_factor, 0, 100)


@dataclass(frozen=True, kw_only=True)
class FinalConfig:
    """Optimisation over all keyframes after the scan."""

    passes: int = 10
    """Steps per keyframe (paper 10; code 20 on Replica)."""
    lr_factor: float = 1.0
    """Learning rates, as a share of the window's (code 4 on Replica, 1 elsewhere); centres do not move."""
    weight_depth: float = 1.0
    """Weight of the depth loss (code 0)."""

    def __post_init__(self):
        check_kinds("final", self)
        check_number("final.passes", self.passes, 0, 10_000)
        check_number("final.lr_factor", self.lr_factor, 0, 100)
        check_number("final.weight_depth", self.weight_depth, 0, 1e6)


@dataclass(frozen=True, kw_only=True)
class RtgSlamConfig:
    """Everything that decides what an RTG-SLAM run gives, but for the data's location."""

    seeding: SeedingConfig = field(default_factory=lambda: SeedingConfig(rule="rtg_slam"))
    discs: DiscConfig = field(default_factory=DiscConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    states: StateConfig = field(default_factory=StateConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    final: FinalConfig = field(default_factory=FinalConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mesh: TsdfConfig = field(default_factory=lambda: TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0, near_m=0.2))
    """The volume that the rendered depth is fused into when a mesh is asked for."""
    data: DataConfig = field(default_factory=lambda: DataConfig(depth_min_m=0.3, depth_max_m=5.0))
    sh_degree: int = 3
    """Degree of the view-dependent colour, 0 to 3."""
    keyframes_on: Literal["device", "cpu"] = "device"
    """Where the keyframes' images are kept: with the map, or in the memory of the processor, which saves a GPU's."""
    seed: int = 0
    """Seed of every random draw of the run."""

    def __post_init__(self):
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")
        check_name("keyframes_on", self.keyframes_on, ("device", "cpu"))


_RTG_SLAM: dict[str, dict[str, Any]] = {
    "replica": {},
    "tum": {
        "window": {"every_frames": 4, "lr_sh_dc": 1e-3, "lr_sh_rest": 5e-5, "lr_log_scale": 0.02},
        "states": {"stable_confidence": 200.0, "unstable_frames": 150},
    },
    "scannetpp": {
        "window": {"every_frames": 3, "iterations": 75, "frames": 1},
        "states": {"stable_confidence": 400.0, "unstable_frames": 200},
        "keyframes": {"iterations": 75},
        "data": {"depth_max_m": 10.0, "hold_out_every": 0},
    },
    "azure": {
        "window": {"every_frames": 8, "frames": 3, "lr_sh_dc": 1e-3, "lr_sh_rest": 5e-5, "lr_log_scale": 2e-3},
        "states": {"stable_confidence": 250.0, "unstable_frames": 400},
        "data": {"depth_max_m": 2.5},
    },
    "room": {"data": {"width": 320, "height": 240}},
}

_FIDELITY: dict[str, dict[str, Any]] = {
    "measured": {
        "seeding": {"options": {"share": 0.1}},
        "discs": {"opaque_alpha": 0.3, "min_cosine": 0.17, "max_offset": 3.0},
        "window": {"lr_sh_dc": 5e-3, "lr_sh_rest": 2.5e-4, "lr_log_scale": 0.02, "draw": "newest_half"},
        "states": {"stable_confidence": 300.0, "age": "in_view"},
        "tracking": {"target": "hybrid"},
    },
    "paper": {
        "seeding": {"options": {"fidelity": "paper"}},
        "discs": {"max_offset": None},
        "window": {"depth_behind_m": None},
        "states": {"max_radius_factor": None},
        "tracking": {"even_to_m": None},
    },
    "code": {
        "seeding": {"options": {"fidelity": "code"}},
        "discs": {"opaque_alpha": 0.6},
        "window": {"weight_colour": 0.8, "anchor": "window", "draw": "newest_half", "history_max_weight": 0.5},
        "states": {
            "colour_error": 0.2 / 3,
            "depth_error_m": 0.2,
            "depth_error_sides": "in_front",
            "on_error": "delete",
            "error_count": 9,
        },
        "keyframes": {"latest": 3, "random": 0, "rows": "stable", "instead_of_window": True},
        "final": {"weight_depth": 0.0},
        "tracking": {
            "pyramid": (4, 2, 1),
            "max_angle_deg": 20.0,
            "even_to_m": None,
            "damping": 1e-4,
            "prior": "previous",
            "target": "hybrid",
            "min_agreement": 0.25,
        },
    },
}

_CODE_ON: dict[str, dict[str, Any]] = {
    "replica": {"final": {"passes": 20, "lr_factor": 4.0}},
    "tum": {"seeding": {"options": {"fidelity": "code", "share": 50_000 / (640 * 480)}}},
    "scannetpp": {
        "seeding": {"options": {"fidelity": "code", "share": 68_620 / (1752 * 1168)}},
        "keyframes": {"instead_of_window": False},
    },
}


def rtg_slam(preset: str = "replica", fidelity: str = "measured", **overrides: Any) -> RtgSlamConfig:
    """Settings of RTG-SLAM as published for a data set: "replica", "tum", "scannetpp", "azure"; "room" for the
    built-in scene.

    Args:
        preset: Data set whose published numbers to take.
        fidelity: Where paper and released code differ: "paper", "code", or "measured", of each the better by our
            measurements, which come before the data set's numbers.
        overrides: Fields, nested ones with a double underscore: ``rtg_slam("tum", window__iterations=20)``.

    Raises:
        KeyError: unknown preset or fidelity. ValueError: unknown field.
    """
    check_name("preset", preset, _RTG_SLAM)
    check_name("fidelity", fidelity, _FIDELITY)
    config = from_dict(RtgSlamConfig, _RTG_SLAM[preset])
    layers = [_FIDELITY[fidelity], _CODE_ON.get(preset, {}) if fidelity == "code" else {}]
    for layer in layers:
        config = from_dict(RtgSlamConfig, layer, start=config)
    return replace(config, **overrides)
