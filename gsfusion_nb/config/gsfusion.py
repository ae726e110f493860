"""Settings of GSFusion (Wei & Leutenegger 2024) and its presets, named after papers and data sets.

Where paper and released code agree, or the paper says nothing, both fidelities have the released
code's value.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

from ..errors import ArgumentError
from .parts import SystemConfig, TsdfConfig
from .preset_table import NAMES, ROOM_IMAGES, Changes, Presets
from .values import Settings, replace, setting, with_values, within


@dataclass(frozen=True, kw_only=True)
class OptimConfig(Settings, group="optim"):
    """Learning rates of Adam, which stay constant, and how many optimisation steps are taken when.

    A larger rate learns faster, but the values may oscillate; useful values lie within a factor of
    ten of the defaults.
    """

    lr_xyz: float = within(3.2e-4, 0, 10)
    """Learning rate of the centres, metres per step. Published: half of it, as for all rates
    below."""
    lr_sh_dc: float = within(5e-3, 0, 10)
    """Learning rate of the base colour (spherical harmonics of degree 0)."""
    lr_sh_rest: float = within(2.5e-4, 0, 10)
    """Learning rate of the view-dependent colour (degrees 1 to 3)."""
    lr_log_scale: float = within(2e-3, 0, 10)
    """Learning rate of the logarithm of the sizes: 2e-3 changes a size by about 0.2 % per step."""
    lr_quat: float = within(2e-3, 0, 10)
    """Learning rate of the rotations (quaternion components)."""
    lr_opacity_logit: float = within(0.1, 0, 10)
    """Learning rate of the opacities, before the sigmoid."""
    beta1: float = within(0.9, 0, 0.999)
    """Adam's memory of the gradient, 0 to 1. Larger: smoother, slower to change direction. Usual:
    0.8 to 0.95."""
    beta2: float = within(0.999, 0, 0.999999)
    """Adam's memory of the squared gradient, above the square of beta1 and below 1. Larger: the
    step size follows changes more slowly. Usual: 0.99 to 0.999."""
    eps: float = within(1e-15, 1e-30, 1)
    """Added to Adam's denominator against division by zero. Larger: smaller steps where gradients
    are small."""
    adam_steps: Literal["none", "shared", "per_row"] = "none"
    """Bias correction of Adam: decides how fast Gaussians move. "none": no correction, so the first
    steps of a new Gaussian are 3 to 6 learning rates long; "shared": by the step count of the whole
    map, as in the released code: all steps are shorter during the first 2,000 (0.15 times at step
    10, 0.44 at 210), then as with "none"; "per_row": by the age of each Gaussian (textbook Adam),
    so its first step is 1 learning rate."""
    keyframe_iterations: int = within(3, 0)
    """m: optimisation steps on a frame that is a keyframe. Larger: better pictures while scanning,
    slower. Published:
    5. Usual: 3 to 20."""
    frame_iterations: int = within(1, 0)
    """n: optimisation steps on a frame that is not a keyframe. Published: 3. Usual: 1 to 10."""
    random_keyframe_iterations: int = within(2, 0)
    """Steps on randomly drawn earlier keyframes after each frame that is not a keyframe. Larger:
    places seen earlier stay sharp (less forgetting), slower. Usual: 0 to 10."""
    global_iterations: int = within(10, 0)
    """Passes over all keyframes after the scan. Larger: better pictures, longer wait; the gain
    shrinks. Usual: 0 to 20."""
    ssim_weight: float = within(0.2, 0, 1)
    """Weight of the structural loss D-SSIM in the passes after the scan, 0 to 1; the colour
    difference L1 has the rest. Larger: sharper structure, less exact colours. 0.2 in the released
    code; 0 is the paper's loss (Eq. 12)."""
    online_ssim_weight: float = within(0.0, 0, 1)
    """Weight of D-SSIM in the steps while scanning, 0 to 1; L1 has the rest. Larger: as for
    ssim_weight, and slower steps. 0 as published; SplaTAM has 0.2."""
    refine_poses: bool = False
    """In the passes after the scan, each keyframe also moves towards the pose at which the map fits
    its picture; the frames between follow. On: sharper pictures where the poses of the data are
    some tenths of a degree off; the given poses then fit the map less well. The TSDF keeps the
    given poses."""
    pose_sigma_m: float = within(0.02, 1e-6, 10)
    """Standard deviation of the given positions, metres: how far refine_poses may move them.
    Larger: the picture counts more, the given pose less. Usual: 0.005 to 0.05."""
    pose_sigma_deg: float = within(1.0, 1e-6, 180)
    """Likewise of the given rotations about each axis, degrees. Usual: 0.2 to 2."""
    fit_exposure: bool = False
    """In the passes after the scan, compare each keyframe with the map's picture times three
    factors, one a colour, that are fitted to it, with a mean of 1 over all keyframes. On: the map
    has the mean brightness and white balance of a camera that changes them; without such changes it
    costs a little sharpness."""
    depth_weight: float = within(0.2, 0, 1e6, before=0.0)
    """Weight of the mean depth error in metres, over the pixels with measured depth, in all steps.
    Larger: closer to the measured depth, noise included. 0 as published; SplaTAM has 2 in units of
    its colour loss."""
    depth_over_alpha: bool = setting(True, before=False)
    """What of a picture is compared with the measured depth, where depth_weight is above 0. On: the
    blended depth divided by alpha, as the score of the depth does; pixels beyond ``tsdf.far_m``,
    where nothing is mapped, count less. Off: the blended depth as it is, as in SplaTAM: where alpha
    is 0.99, the surface comes to lie 1 % too far away."""
    depth_coverage: float = within(0.1, 0, 100)
    """With depth_over_alpha, how much a pixel with measured depth is pulled to alpha 1: its depth
    error has depth_coverage times depth times (1 - alpha) more. Larger: holes close sooner, colours
    count less. Usual: 0 to 1."""
    isotropy_weight: float = within(0.0, 0, 1e6)
    """Weight of the mean difference, in metres, between a Gaussian's three sizes and their mean, in
    all steps. Larger: rounder Gaussians, fewer long needles. 0 as published; MonoGS has 10."""
    scale_weight: float = within(0.0, 0, 1e6)
    """Weight of the mean size of the Gaussians in metres, in all steps. Larger: smaller Gaussians.
    0 as published; 3DGS-MCMC has 0.01 in a scene of a few metres."""
    opacity_weight: float = within(0.0, 0, 1e6)
    """Weight of the mean opacity of the Gaussians, in all steps. Larger: Gaussians that the
    pictures do not need disappear. 0 as published; 3DGS-MCMC has 0.01."""

    def __post_init__(self):
        super().__post_init__()
        if self.beta1**2 >= self.beta2:  # then the steps of a row without gradient never end
            raise ArgumentError(
                f"optim.beta2 must be above beta1 squared, {self.beta1**2:.4g}, got {self.beta2}"
            )


@dataclass(frozen=True, kw_only=True)
class GSFusionConfig(SystemConfig):
    """All settings of a GSFusion run, except where the data is."""

    tsdf: TsdfConfig = field(default_factory=TsdfConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    keyframe_min_seeds: int = within(50, 0)
    """A frame that adds more Gaussians than this becomes a keyframe. Larger: fewer keyframes, less
    memory. Usual: 20 to 500."""
    keyframe_every: int = within(0, 0)
    """Make every n-th mapped frame a keyframe, from the first on, however many Gaussians it adds;
    0: keyframe_min_seeds decides, as published. Above 0, all seeding rules get the same number of
    optimisation steps. Larger: fewer keyframes. Usual: 0, or 3 to 10."""
    keyframe_max_gap: int = within(5, 0, before=0)
    """Largest number of mapped frames from one keyframe to the next, however few Gaussians they
    add, except where an earlier keyframe shows the same; 0: no limit, as published. A camera that
    sees nothing new would otherwise have one keyframe, which the map overfits. Smaller: more
    keyframes, more memory and longer passes. Usual: 5 to 20."""
    keep_all_frames: bool = False
    """Keep every frame, not only keyframes, for optimising earlier views and for the passes after
    the scan (ScanNet++, whose views are far apart). On: more memory and a longer optimisation after
    the scan."""


_PUBLISHED_RATES = {
    "lr_xyz": 1.6e-4,
    "lr_sh_dc": 2.5e-3,
    "lr_sh_rest": 1.25e-4,
    "lr_log_scale": 1e-3,
    "lr_quat": 1e-3,
    "lr_opacity_logit": 0.05,
}
_PUBLISHED_STEPS: dict[str, Changes] = {
    "scannetpp": {
        "keyframe_iterations": 10,
        "frame_iterations": 1,
        "random_keyframe_iterations": 9,
    },
    "tum": {
        "keyframe_iterations": 10,
        "frame_iterations": 5,
        "random_keyframe_iterations": 5,
    },
}
"""Preset -> the optimisation steps that were published for its data, where they are others."""


def _measured_settings(preset: str) -> GSFusionConfig:
    """The defaults. Views that are far apart need the published steps, at the published rates."""
    if preset != "scannetpp":
        return GSFusionConfig()
    optim = {**_PUBLISHED_STEPS[preset], **_PUBLISHED_RATES}
    return with_values(GSFusionConfig(), optim=optim)


def _paper_steps(preset: str) -> GSFusionConfig:
    """The paper's steps, learning rates, loss and shape of new Gaussians, with the TSDF of
    "measured"."""
    optim = {
        "keyframe_iterations": 5,
        "frame_iterations": 3,
        "depth_weight": 0.0,
        "depth_over_alpha": False,
        **_PUBLISHED_RATES,
    }
    seeding = {"quadtree_largest_m": 0.0, "thickness": 1.0, "opacity": 0.5}
    config = with_values(GSFusionConfig(), keyframe_max_gap=0, optim=optim, seeding=seeding)
    return replace(config, optim=_PUBLISHED_STEPS.get(preset, {}))


def _published_settings(preset: str) -> GSFusionConfig:
    """What paper and released code have in common."""
    return with_values(
        _paper_steps(preset),
        all_in_view=True,
        tsdf={"outlier_guard": False, "colour_band_voxels": 0.0, "colour_by_distance": False},
        seeding={"without_depth": "skip"},
        optim={"adam_steps": "shared"},
        data={"hold_out_every": 0, "scored_views": 0},
    )


def _paper(preset: str) -> GSFusionConfig:
    return with_values(
        _published_settings(preset),
        tsdf={"sdf": "z", "average": "eq9"},
        seeding={"one_per_voxel": True},
        optim={"ssim_weight": 0.0},
    )


def _code(preset: str) -> GSFusionConfig:
    return with_values(_published_settings(preset), tsdf={"average": "int16"})


_PRESETS = Presets(
    fidelities={
        "measured": _measured_settings,
        "paper_steps": _paper_steps,
        "paper": _paper,
        "code": _code,
    },
    data_sets={
        "replica": {},
        "scannetpp": {"data": {"hold_out_every": 0}, "keep_all_frames": True},
        "tum": {"optim": {"global_iterations": 20}},
        "azure": {},
        "room": ROOM_IMAGES,
        "online": {"optim": {"global_iterations": 0}},
    },
)


def gsfusion(
    preset: str = "replica", fidelity: str = "measured", **overrides: Any
) -> GSFusionConfig:
    """Settings of GSFusion for a data set: "replica", "scannetpp", "tum", "azure"; "room" for the
    built-in scene; "online" is "replica" without the optimisation after the scan. Without arguments
    they are ``GSFusionConfig()``.

    Args:
        preset: Name of the preset.
        fidelity: Which to follow where they differ: "paper", "code" (as released), or "measured",
            our defaults, which gave the better result in our measurements. "paper_steps" is
            "measured" with the paper's optimisation and seeds: its steps for the data set, its
            learning rates, no depth in the loss, and round Gaussians as large as their cells.
            ``docs/gsfusion.md`` lists every difference.
        overrides: Fields to change, nested ones with a dict or a double underscore:
            ``gsfusion("replica", optim__global_iterations=0, sh_degree=0)``.

    Raises:
        KeyError: unknown preset or fidelity. ValueError: unknown field.
    """
    return _PRESETS.make(preset, fidelity, overrides)


gsfusion_fidelities = tuple(_PRESETS.fidelities)
"""What ``fidelity`` may be, the default first."""
gsfusion_fidelity = _PRESETS.fidelity_of
"""Which fidelity settings have, and what they set otherwise: "code, but final.passes 5"."""


def presets() -> list[str]:
    """Names of the presets, the same for every system."""
    return list(NAMES)
