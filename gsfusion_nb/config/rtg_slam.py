"""Settings of RTG-SLAM (Peng et al. 2024) and its presets, named after data sets.

Where the paper and the released code differ, the field says what each does;
``rtg_slam(fidelity=...)`` sets them all.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from .parts import DataConfig, SeedingConfig, SystemConfig, TrackingConfig
from .preset_table import ROOM_IMAGES, Changes, Presets
from .values import Settings, positive, replace, setting, with_values, within

PUBLISHED_LR_XYZ_M = 1e-3
"""``window.lr_xyz`` of the released code on every data set, metres per step; a step of this size
has confidence 1."""


@dataclass(frozen=True, kw_only=True)
class DiscConfig(Settings, group="discs"):
    """When a ray hits a disc, and at which depth (Eq. 4-5)."""

    opaque_alpha: float = within(0.3, 0.01, 0.99)
    """delta_alpha: a ray hits a disc where the disc's alpha is at least this. Smaller: larger
    discs, fewer holes, less exact edges. Paper exp(-0.5) = 0.61, code 0.6. Usual: 0.2 to 0.8."""
    max_offset: float | None = positive(3.0)
    """Largest distance along z between the hit and the disc's centre, in units of the disc's
    largest standard deviation; beyond it the depth of the centre is used. Larger: more exact depth
    on tilted discs, but more outliers. Code 1; paper: no limit (None). Usual: 1 to 5."""
    min_cosine: float = within(0.17, 0, 1)
    """Smallest cosine of the angle between ray and disc normal at which the two are intersected; a
    disc seen at a flatter angle gets the depth of its centre. Smaller: intersects at flatter
    angles, more exact but more sensitive to errors of the normal. Paper 0.5 (60 degrees). Usual:
    0.1 to 0.7."""
    depth: Literal["disc", "blended"] = "disc"
    """"disc": depth where the ray meets the first disc (RTG-SLAM); "blended": weighted mean of the
    depths of all Gaussians on the ray, sum of w_k z_k / alpha, as in other splatting systems (the
    comparison of Fig. 7)."""


@dataclass(frozen=True, kw_only=True)
class WindowConfig(Settings, group="window"):
    """Optimisation over the last frames (Eq. 7-9)."""

    every_frames: int = within(8, 1)
    """Optimise once in this many frames. Larger: faster, but new areas stay rough for longer.
    Published on Replica: 6. Usual: 3 to 8."""
    frames: int = within(12, 1)
    """How many of the last frames the optimisation uses. Larger: less overfitting to one view, more
    memory. Published on Replica: 5. Usual: 1 to 12."""
    iterations: int = within(20, 0)
    """Steps per optimisation of the window. Larger: better pictures, slower. Published: 50. Usual:
    20 to 100."""
    lr_xyz: float = within(3e-3, 0, 10)
    """Learning rate of the centres, metres per step, and of the rotations. Larger: the discs reach
    the measured surface in fewer steps, and are stable after fewer (states.stable_confidence).
    Published: 0.001. Usual: 0.001 to 0.005."""
    lr_sh_dc: float = within(0.015, 0, 10)
    """Learning rate of the base colour (spherical harmonics of degree 0). The view-dependent colour
    learns at 1/20 of it. Published on Replica: 5e-4."""
    lr_log_scale: float = within(0.06, 0, 10)
    """Learning rate of the logarithm of the sizes: 0.06 changes a size by about 6 % per step.
    Published on Replica: 4e-3."""
    weight_colour: float = within(1.0, 0, 1e6)
    """w_c of Eq. 8: weight of the colour error (code 0.8). Larger: better pictures at the cost of
    depth. Usual: 0.5 to 2."""
    anchor: Literal["birth", "window"] = "birth"
    """The anchor values of transparent Gaussians: "birth", those they were created with (paper), or
    "window", those at the start of this optimisation (code), so that they can drift from window to
    window."""
    draw: Literal["random", "newest_half"] = "newest_half"
    """Which frame of the window a step uses. "random": any (paper); "newest_half": any in the first
    half of the steps, the newest frame in the second half (code), which favours the present
    view."""
    depth_behind_m: float | None = positive(0.1)
    """Pixels whose rendered depth lies farther than this behind the measurement have no depth loss,
    metres (code; paper: no limit, None). Smaller: fewer pixels count. Usual: 0.05 to 0.5."""
    history_max_weight: float = within(1.0, 0, 1)
    """Largest weight of a Gaussian's values from before the optimisation when the old and the new
    values are averaged (Eq. 9), 0 to 1. Larger: well observed Gaussians change less; 0: only the
    new values count. Paper 1, code 0.5."""
    only_unstable: bool = True
    """Optimise only unstable Gaussians, on the pixels that they touch. Off: all Gaussians on all
    pixels, slower (the comparison in the paper)."""

    @property
    def confidence_per_step(self) -> float:
        """Confidence of one step that changed a Gaussian's colour: its size, in steps of the
        released code."""
        return self.lr_xyz / PUBLISHED_LR_XYZ_M


@dataclass(frozen=True, kw_only=True)
class StateConfig(Settings, group="states"):
    """When a Gaussian becomes stable (no longer optimised), unstable again, or is deleted (section
    3.2, "State management")."""

    stable_confidence: float = positive(150.0)
    """delta_eta: a Gaussian whose confidence is above this becomes stable. Its confidence counts
    the steps that changed its colour, each as window.lr_xyz / 0.001: three times the published rate
    is three published steps, so that few large steps and many small ones give the same confidence.
    Larger: better fitted before it is fixed, but slower. Code 100 on Replica. Usual: 100 to 300. A
    run in which no Gaussian becomes stable says so."""
    unstable_frames: int = within(120, 1)
    """delta_t: a Gaussian that is still unstable after this many frames is deleted. Larger: rarely
    seen places survive, and so do floaters. Usual: 100 to 400."""
    age: Literal["all", "in_view"] = setting("in_view", before="all")
    """Which frames count for unstable_frames: "all" since the Gaussian was created (paper, code),
    or "in_view", those with its centre in the picture. With "in_view" places that the camera passes
    quickly are not deleted later."""
    error_count: int = within(5, 1)
    """delta_e: a stable Gaussian that is wrong in more frames than this is no longer stable (code:
    in 10 or more). Larger: slower to repair mistakes, less disturbed by noise. Usual: 2 to 20."""
    colour_error: float = positive(0.03)
    """delta_c: a pixel's colour is wrong if it differs by more than this, the mean absolute
    difference over R, G, B in 0..1. Larger: tolerates changes of exposure. Code 0.067. Usual: 0.03
    to 0.2."""
    depth_error_m: float = positive(0.02)
    """delta_d: a pixel's depth is wrong if it differs by more than this, metres. Larger: tolerates
    noisier depth. Code 0.2. Usual: 0.02 to 0.2."""
    on_error: Literal["release", "delete"] = "release"
    """What happens to a stable Gaussian that is wrong too often. "release": it becomes unstable
    again (paper); "delete": it is deleted if its depth is wrong, where the model is in front of the
    measurement, and left as it is if only its colour is (code)."""
    max_radius_factor: float | None = within(10.0, 1)
    """Gaussians with a radius above this many times the mean radius are deleted (code 10; paper:
    none are, None). Smaller: fewer blurred blobs, but also fewer large plain areas. Usual: 5 to
    20."""


@dataclass(frozen=True, kw_only=True)
class KeyframeConfig(Settings, group="keyframes"):
    """When a frame becomes a keyframe, and the optimisation over earlier keyframes that each new
    one starts (section 3.2, "Keyframes and global optimization")."""

    latest: int = within(1, 0)
    """How many of the latest keyframes take part in the optimisation (paper 1, code 3)."""
    random: int = within(3, 0)
    """How many randomly drawn earlier keyframes take part (paper 3, code 0). Larger: less
    forgetting. Usual: 0 to 8."""
    iterations: int = within(20, 0)
    """Steps of the optimisation at each keyframe. Larger: earlier views improve more, slower.
    Published: 50. Usual: 0 to 100."""
    rows: Literal["all", "stable"] = "all"
    """Which Gaussians are drawn and optimised: "all" (paper) or only the "stable" ones (code)."""
    worst: Literal["tiles", "pixels"] = "tiles"
    """Of what the 40 % with the largest colour errors have a loss: "tiles" of 16x16 pixels (code),
    of which the others take no time to draw, or "pixels" (paper)."""
    instead_of_window: bool = False
    """On: at a keyframe this optimisation replaces that of the window (code, except on
    ScanNet++)."""


@dataclass(frozen=True, kw_only=True)
class FinalConfig(Settings, group="final"):
    """Optimisation over all keyframes after the scan."""

    passes: int = within(10, 0)
    """Steps per keyframe (paper 10; code 20 on Replica). Larger: better pictures, longer wait.
    Usual: 0 to 20."""
    lr_factor: float = within(0.5, 0, 100)
    """Learning rates as a multiple of the window's (code 4 on Replica, 1 elsewhere); centres do not
    move. Usual: 0.1 to 4."""
    weight_depth: float = within(1.0, 0, 1e6)
    """Weight of the depth error in metres (code 0). 0: best pictures; larger: the depth is kept.
    Usual: 0 to 5."""


@dataclass(frozen=True, kw_only=True)
class RtgSlamConfig(SystemConfig):
    """All settings of an RTG-SLAM run, except where the data is."""

    seeding: SeedingConfig = field(
        default_factory=lambda: SeedingConfig(rule="rtg_slam", options={"share": 0.1})
    )
    tracking: TrackingConfig = field(
        default_factory=lambda: TrackingConfig(target="hybrid", landmarks=True)
    )
    discs: DiscConfig = field(default_factory=DiscConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    states: StateConfig = field(default_factory=StateConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    final: FinalConfig = field(default_factory=FinalConfig)
    mesh_voxel_m: float = within(0.02, 0.001, 1)
    """Edge length of a voxel of the volume into which the rendered depth is fused when a mesh is
    needed, metres. Larger: coarser meshes in less time and memory. Usual: 0.01 to 0.05."""
    data: DataConfig = field(default_factory=lambda: DataConfig(depth_min_m=0.3, depth_max_m=5.0))


_PUBLISHED_FOR: dict[str, Changes] = {
    "tum": {
        "window": {"every_frames": 4, "lr_sh_dc": 0.001, "lr_log_scale": 0.02},
        "states": {"stable_confidence": 200.0},
    },
    "scannetpp": {
        "window": {"every_frames": 3, "iterations": 75, "frames": 1},
        "states": {"stable_confidence": 400.0},
        "keyframes": {"iterations": 75},
    },
    "azure": {
        "window": {"every_frames": 8, "frames": 3, "lr_sh_dc": 0.001, "lr_log_scale": 0.002},
        "states": {"stable_confidence": 250.0},
    },
}
"""Preset -> what was published for its data, where it is not as on Replica."""


def _measured_settings(preset: str) -> RtgSlamConfig:
    return RtgSlamConfig()


def _published_settings(preset: str) -> RtgSlamConfig:
    """What paper and released code have in common. The paper gives neither pyramid nor angle nor
    where ICP starts: these are the released code's."""
    config = with_values(
        RtgSlamConfig(),
        all_in_view=True,
        window={
            "every_frames": 6,
            "frames": 5,
            "iterations": 50,
            "lr_xyz": PUBLISHED_LR_XYZ_M,
            "lr_sh_dc": 5e-4,
            "lr_log_scale": 4e-3,
        },
        states={"stable_confidence": 100.0, "age": "all"},
        keyframes={"iterations": 50},
        final={"lr_factor": 1.0},
        tracking={
            "pyramid": (4, 2, 1),
            "max_angle_deg": 20.0,
            "even_to_m": None,
            "brightness_m": None,
            "prior": "previous",
            "landmarks": False,
        },
    )
    return replace(config, **_PUBLISHED_FOR.get(preset, {}))


def _paper(preset: str) -> RtgSlamConfig:
    return with_values(
        _published_settings(preset),
        seeding={"options": {"fidelity": "paper"}},
        discs={
            "opaque_alpha": math.exp(-0.5),
            "min_cosine": 0.5,  # 60 degrees
            "max_offset": None,
        },
        window={"draw": "random", "depth_behind_m": None},
        keyframes={"worst": "pixels"},
        states={
            "error_count": 10,
            "colour_error": 0.1,
            "depth_error_m": 0.1,
            "max_radius_factor": None,
        },
        tracking={"target": "model"},
    )


def _code(preset: str) -> RtgSlamConfig:
    config = with_values(
        _published_settings(preset),
        seeding={"options": {"fidelity": "code"}},
        discs={"opaque_alpha": 0.6, "min_cosine": 0.5, "max_offset": 1.0},
        window={
            "weight_colour": 0.8,
            "anchor": "window",
            "draw": "newest_half",
            "history_max_weight": 0.5,
        },
        states={
            "error_count": 9,
            "colour_error": 0.2 / 3,  # 0.2 of the sum over R, G, B
            "depth_error_m": 0.2,
            "on_error": "delete",
        },
        keyframes={"latest": 3, "random": 0, "rows": "stable", "instead_of_window": True},
        final={"weight_depth": 0.0},
        tracking={"target": "hybrid"},
    )
    return with_values(config, **_CODE_FOR.get(preset, {}))


_CODE_FOR: dict[str, Changes] = {
    "replica": {"final": {"passes": 20, "lr_factor": 4.0}},
    # 50,000 of 640x480 pixels
    "tum": {"seeding": {"options": {"fidelity": "code", "share": 50_000 / (640 * 480)}}},
    "scannetpp": {
        # 68,620 of 1752x1168 pixels
        "seeding": {"options": {"fidelity": "code", "share": 68_620 / (1752 * 1168)}},
        "keyframes": {"instead_of_window": False},
    },
}
"""Preset -> what only the released code has for its data."""


_PRESETS = Presets(
    fidelities={"measured": _measured_settings, "paper": _paper, "code": _code},
    data_sets={
        "replica": {},
        "tum": {"states": {"unstable_frames": 150}},
        "scannetpp": {
            "states": {"unstable_frames": 200},
            "data": {"depth_max_m": 10.0, "hold_out_every": 0},
        },
        "azure": {"states": {"unstable_frames": 400}, "data": {"depth_max_m": 2.5}},
        "room": ROOM_IMAGES,
        "online": {"final": {"passes": 0}},
    },
)


def rtg_slam(
    preset: str = "replica", fidelity: str = "measured", **overrides: Any
) -> RtgSlamConfig:
    """Settings of RTG-SLAM for a data set: "replica", "tum", "scannetpp", "azure"; "room" for the
    built-in scene; "online" is "replica" without the passes after the scan. Without arguments they
    are ``RtgSlamConfig()``.

    Args:
        preset: Name of the preset.
        fidelity: Which to follow where paper and released code differ: "paper" or "code", with the
            numbers published for the data set, or "measured", our defaults (``docs/rtg_slam.md``).
        overrides: Fields, nested ones with a double underscore:
            ``rtg_slam("tum", window__iterations=20)``.

    Raises:
        KeyError: unknown preset or fidelity. ValueError: unknown field.
    """
    return _PRESETS.make(preset, fidelity, overrides)


rtg_slam_fidelities = tuple(_PRESETS.fidelities)
"""What ``fidelity`` may be, the default first."""
rtg_slam_fidelity = _PRESETS.fidelity_of
"""Which fidelity settings have, and what they set otherwise: "code, but final.passes 5"."""
