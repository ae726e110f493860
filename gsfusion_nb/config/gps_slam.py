"""Settings of GPS-SLAM (Peng et al. 2025), Gaussians over a signed distance field, and its presets.

"paper" is the paper (arXiv 2509.11574), with the released code's values where it gives none; "code"
is the released code; "rrg" is what the same group's next paper (RRG-SLAM, 2026) says about the
method. Where they differ, the field says what each does.
"""

import functools
from dataclasses import dataclass, field
from typing import Any, Literal

from .gsfusion import OptimConfig
from .parts import SeedingConfig, SystemConfig, TsdfConfig
from .preset_table import ROOM_IMAGES, Presets
from .values import Settings, setting, with_values, within


@dataclass(frozen=True, kw_only=True)
class BaseConfig(Settings, group="base"):
    """The picture of the TSDF that the Gaussians are blended over."""

    holes: Literal["filled", "black", "gaussians"] = "filled"
    """Pixels where the TSDF has no surface. "filled": with the colours around them; "black": black
    with full weight, as released, which stays dark; "gaussians": no weight, so that only Gaussians
    count there."""
    resolution: Literal["full", "half"] = "half"
    """Size of the TSDF's picture for seeds and gradient steps: as large as the image, or half as
    wide and high and then enlarged ("half"), which takes 0.4 of the time. What tracks, is scored or
    shown is always full."""
    behind_m: float = within(0.1, 0, 100)
    """A Gaussian whose centre is farther than this behind the surface is hidden, metres. Larger:
    Gaussians of hidden surfaces shine through; smaller: noise of the surface hides Gaussians that
    belong to it. Released 0.1; the paper gives no value, and RRG-SLAM, which cites it, the
    truncation distance. Usual: 0.02 to 0.1."""


@dataclass(frozen=True, kw_only=True)
class ResidualConfig(Settings, group="residual"):
    """Learning rates of the Gaussians, which stay constant, and which of them are removed."""

    lr_xyz: float = within(5e-4, 0, 10)
    """Learning rate of the centres, metres per step. Useful learning rates, here and below, lie
    within a factor of ten of the defaults; a larger one learns faster, but the values may
    oscillate. Released: 1.6e-4 times the size of the whole walk, which is not known online."""
    lr_sh_dc: float = within(2.5e-2, 0, 10)
    """Learning rate of the base colour (spherical harmonics of degree 0). Released: 2.5e-3."""
    lr_sh_rest: float = within(1.25e-3, 0, 10)
    """Learning rate of the view-dependent colour (degrees 1 to 3). Released: 5e-4."""
    lr_log_scale: float = within(1e-2, 0, 10)
    """Learning rate of the logarithm of the sizes: 1e-2 changes a size by about 1 % per step.
    Released: 5e-3."""
    lr_quat: float = within(1e-3, 0, 10)
    """Learning rate of the rotations (quaternion components)."""
    lr_opacity_logit: float = within(5e-2, 0, 10)
    """Learning rate of the opacities, before the sigmoid."""
    loss: Literal["l1", "l2"] = setting("l2", before="l1")
    """What a step makes smaller: the mean absolute ("l1", as released) or squared ("l2") difference
    of the colours. With "l2" a place that looks different in every picture, because poses or depth
    are noisy, becomes their mean, which is smoother and has a higher PSNR; with "l1" their
    median."""
    restart_adam: bool = False
    """Forget Adam's moments whenever new Gaussians are asked for (released: new optimiser for each
    burst). On: sizes of steps are exactly the learning rates at first, and colours learn more
    slowly."""
    min_radius_m: float = within(0.0005, 0, 10)
    """Gaussians whose largest standard deviation is below this are removed, metres. Larger: no
    detail close to the camera. Released: 0.003."""
    max_radius_m: float = within(1000.0, 0, 1e6)
    """Gaussians whose largest standard deviation is above this are removed, metres. Smaller: no
    large blobs, but also none that correct a whole wall. Released: 0.1. 1000 removes none."""

    @functools.cached_property
    def adam(self) -> OptimConfig:
        """The learning rates as Adam takes them."""
        rates = {name: value for name, value in vars(self).items() if name.startswith("lr_")}
        return OptimConfig(adam_steps="per_row" if self.restart_adam else "none", **rates)


@dataclass(frozen=True, kw_only=True)
class ScheduleConfig(Settings, group="schedule"):
    """Which views are optimised, and when."""

    every_frames: int = within(10, 1)
    """Length of a round, frames: in each, views are renewed and steps are taken. Larger: faster,
    but slower to follow. Released: 10. Usual: 5 to 20."""
    iterations: int = within(20, 0)
    """Gradient steps in a round. Larger: better pictures, slower. Paper and release 20, RRG-SLAM
    30. Usual: 10 to 60."""
    spread: bool = True
    """On: the steps and the pictures of the TSDF are spread evenly over the frames of a round, so
    that all frames take about the same time. Off: all in the last frame of a round, as released,
    which then takes twenty times as long."""
    window_every: int = within(5, 1)
    """Distance between the frames of the window, mapped frames. Usual: 2 to 10."""
    keyframes: int = within(24, 0)
    """How many keyframes are among the views, at most. Larger: less forgetting, but the pictures of
    the surface below them are older, and each takes 2 MB at 320 x 240. Without any, places that the
    camera has left become worse than the TSDF alone. Released: 7. Usual: 7 to 32."""
    recalled: int = within(4, 0)
    """At how many keyframes the TSDF is looked at in a round, each drawn at random. One that is not
    among the views takes the place of the one that was looked at longest ago. Larger: newer
    surfaces below the Gaussians, slower. Released: 7. Usual: 2 to 8."""
    recalled_new: int = within(2, 0, before=0)
    """How many of these are instead the newest keyframe that was not looked at yet, if there is
    one. Larger: places that the camera sees now are optimised sooner, old ones are seen again
    later. Released: 0. Usual: 0 to recalled."""


@dataclass(frozen=True, kw_only=True)
class ViewsConfig(Settings, group="views"):
    """Which frames are kept as keyframes."""

    rotation_deg: float = within(30.0, 0, 360)
    """A frame becomes a keyframe when the camera has turned by more than this since the last one,
    degrees. Larger: fewer keyframes, less memory, less overlap. Released: 30. Usual: 5 to 30."""
    translation_m: float = within(0.3, 0)
    """Likewise when the camera's centre has moved by more than this, metres. Usual: 0.05 to 0.5."""
    every_frames: int = within(2, 0)
    """Also keep every n-th mapped frame, from the first on, but none that shows only what an
    earlier keyframe shows; 0: those that moved, as released, also where the camera was before.
    Smaller: more views for the passes after the scan, more memory. Usual: 0, or 2 to 10."""


@dataclass(frozen=True, kw_only=True)
class PassesConfig(Settings, group="final"):
    """Optimisation over all keyframes after the scan; the released system has none."""

    passes: int = within(20, 0)
    """Steps per keyframe. Larger: better pictures, longer wait. Usual: 0 to 40."""


@dataclass(frozen=True, kw_only=True)
class GpsSlamConfig(SystemConfig):
    """All settings of a GPS-SLAM run, except where the data is."""

    seeding: SeedingConfig = field(
        default_factory=lambda: SeedingConfig(
            rule="gps_slam",
            options={
                "colour_error": 0.08,
                "share": 0.15,
                "most": 0.01,
                "max_weight": 1.0,
                "in_holes": True,
            },
        )
    )
    tsdf: TsdfConfig = field(default_factory=lambda: TsdfConfig(truncation_voxels=4.0))
    base: BaseConfig = field(default_factory=BaseConfig)
    residual: ResidualConfig = field(default_factory=ResidualConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    views: ViewsConfig = field(default_factory=ViewsConfig)
    final: PassesConfig = field(default_factory=PassesConfig)
    sh_degree: int = within(0, 0, 3)
    """Degree of the spherical harmonics that store a Gaussian's colour, 0 to 3. 0: one colour from
    all sides, least memory and time. 3: colour may change with the viewing direction (gloss,
    reflections), as released."""


def _measured_settings(preset: str) -> GpsSlamConfig:
    return GpsSlamConfig()


def _code(preset: str) -> GpsSlamConfig:
    """The release has settings for Replica and one Azure Kinect only, which are the same but for
    the data; the presets of other systems mean the same data here."""
    return with_values(
        GpsSlamConfig(),
        all_in_view=True,
        sh_degree=3,
        seeding={"options": {"only_with_depth": False}},
        tsdf={
            "average": "int16",
            "voxel_size_m": 0.005,
            "near_m": 0.2,
            "far_m": 10.0,
            "sdf": "z",
            "outlier_guard": False,
            "colour_band_voxels": 1.0,
            "colour_weights": "equal",
            "colour_by_distance": False,
        },
        base={"holes": "black", "resolution": "full"},
        residual={
            "lr_xyz": 1.6e-4,
            "lr_sh_dc": 2.5e-3,
            "lr_sh_rest": 5e-4,
            "lr_log_scale": 5e-3,
            "loss": "l1",
            "restart_adam": True,
            "min_radius_m": 0.003,
            "max_radius_m": 0.1,
        },
        schedule={"spread": False, "keyframes": 7, "recalled": 7, "recalled_new": 0},
        views={"every_frames": 0},
        final={"passes": 0},
    )


def _paper(preset: str) -> GpsSlamConfig:
    """As the code, where the paper says nothing else."""
    options = {"only_with_depth": False, "max_weight": 4.0, "max_radius_m": 0.1}
    return with_values(
        _code(preset),
        seeding={"options": options},
        # "a small positive threshold"; RRG-SLAM 2026 cites it as the truncation distance
        base={"behind_m": 0.02},
    )


def _rrg(preset: str) -> GpsSlamConfig:
    """As the code, but for what the same group's next paper, RRG-SLAM 2026, says of this method."""
    options = {"only_with_depth": False, "max_weight": 3.0, "surface": "depth"}
    return with_values(
        _code(preset),
        seeding={"options": options},
        base={"behind_m": 0.02},
        schedule={"iterations": 30},
    )


_PRESETS = Presets(
    fidelities={"measured": _measured_settings, "paper": _paper, "rrg": _rrg, "code": _code},
    data_sets={
        "replica": {},
        "scannetpp": {"data": {"hold_out_every": 0}},
        "tum": {},
        "azure": {},
        "room": ROOM_IMAGES,
        "online": {"final": {"passes": 0}},
    },
)


def gps_slam(
    preset: str = "replica", fidelity: str = "measured", **overrides: Any
) -> GpsSlamConfig:
    """Settings of GPS-SLAM: "replica", "scannetpp", "tum", "azure", which differ only in what is
    held out; "room" for the built-in scene; "online" is "replica" without the passes after the
    scan. Without arguments they are ``GpsSlamConfig()``.

    Args:
        preset: Name of the preset.
        fidelity: Which to follow where they differ: "paper", "code" (as released), "rrg" (as the
            same group's next paper, RRG-SLAM, describes the method, without its structural and
            depth losses), or "measured", our defaults. ``docs/gps_slam.md`` lists every difference.
        overrides: Fields to change, nested ones with a double underscore:
            ``gps_slam("room", final__passes=0)``.

    Raises:
        KeyError: unknown preset or fidelity. ValueError: unknown field.
    """
    return _PRESETS.make(preset, fidelity, overrides)


gps_slam_fidelities = tuple(_PRESETS.fidelities)
"""What ``fidelity`` may be, the default first."""
gps_slam_fidelity = _PRESETS.fidelity_of
"""Which fidelity settings have, and what they set otherwise: "code, but final.passes 5"."""
