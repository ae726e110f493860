"""Settings that several systems share, and those that every system has."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..errors import ArgumentError
from .repair import RepairConfig
from .values import Settings, positive, replace, setting, within


@dataclass(frozen=True, kw_only=True)
class TsdfConfig(Settings, group="tsdf"):
    """The volumetric map: a truncated signed distance field (TSDF) in voxels."""

    voxel_size_m: float = within(0.01, 0.001, 1)
    """Edge length of a voxel, metres. Larger: less memory and time, coarser surface. Usual in a
    room: 0.01 to 0.02."""
    truncation_voxels: float = within(8.0, 1, 64)
    """Half width of the band around the surface in which distances are stored, voxels. Larger:
    bridges noisier depth, but thin objects disappear and memory grows. Usual: 4 to 8, and at least
    about three times the depth noise."""
    max_weight: float = within(100.0, 1)
    """Largest observation count of a voxel (w_max of GSFusion Eq. 8). Larger: smoother, but slower
    to follow a scene that changes. Usual: 20 to 255."""
    near_m: float = within(0.4, 0)
    """Nearer depth is ignored, metres. Set it to the least distance that the sensor measures well;
    below 0.2, Gaussians are drawn from there on. Usual: 0.1 to 0.5."""
    far_m: float = within(6.0, 0, 1000)
    """Depth beyond this creates no new voxels, metres. Larger: more of a big scene, with noisier
    depth and more memory. Usual with indoor depth cameras: 3 to 6."""
    sdf: Literal["z", "ray"] = "ray"
    """How the distance from a voxel to the measured surface is taken: along the optical axis ("z",
    GSFusion Eq. 6) or along the viewing ray ("ray", as the released code; more accurate away from
    the image centre)."""
    average: Literal["mean", "eq9", "int16"] = "mean"
    """How a new distance is averaged with those before. "mean": all count the same; "eq9":
    GSFusion's Eq. 9 as printed, where a new one counts a little more than all before together, so
    the surface follows the last frames and their noise; "int16": the mean in whole numbers of
    1/32767 truncation distances, rounded towards zero, as the released code."""
    colour_band_voxels: float = within(1.5, 0, 64, before=0.0)
    """A voxel takes its colour from pixels whose surface is within this distance of its centre,
    voxels. Larger: blurs colours, because voxels in front of and behind a surface see other places
    at an angle; smaller: fewer observations, more noise. 0: from all pixels that observe it, with
    equal weights, as GSFusion. Usual: 1 to 2."""
    colour_weights: Literal["falling", "equal"] = "falling"
    """How much a pixel within this band counts: "falling", from 1 at the surface to 0 at the border
    of the band, or "equal", all the same, as GPS-SLAM's released code."""
    colour_by_distance: bool = setting(True, before=False)
    """A colour seen from the distance z counts 1 / z^2, as many times as its pixels are finer. Off:
    all distances count the same."""
    outlier_guard: bool = True
    """Create no voxels for isolated depth pixels, those that differ strongly in depth from all
    their neighbours. Turn it off only for depth without noise."""

    def __post_init__(self):
        super().__post_init__()
        if self.near_m >= self.far_m:
            raise ArgumentError(
                f"tsdf.near_m must be below far_m, got near {self.near_m} and far {self.far_m}"
            )

    @property
    def weighs_colours(self) -> bool:
        """Whether colours have weights of their own, other than the observation count."""
        return self.colour_by_distance or self.colour_band_voxels > 0

    @property
    def truncation_m(self) -> float:
        """Half width of the band, metres."""
        return self.truncation_voxels * self.voxel_size_m


@dataclass(frozen=True, kw_only=True)
class SeedingConfig(Settings, group="seeding"):
    """Where new Gaussians are created."""

    rule: str = "gsfusion"
    """Name of a registered seeding rule: gsfusion, rtg_slam, splatam, monogs, uniform, another one
    of those listed in docs/seeding_rules.md, or your own; or a rule in a file: FILE.py:name."""
    quadtree_threshold: float = positive(0.1)
    """A quadtree cell with a contrast above this is split into four. Smaller: more, smaller
    Gaussians and finer detail, but more time and memory. With "released" contrast 0.01 (fine) to
    0.2 (coarse); with "std" about 0.01 to 0.05."""
    quadtree_min_cell_px: int = within(1, 1)
    """A cell is split only if half its width and half its height are larger than this, pixels.
    Larger: no small cells, so fewer Gaussians. Usual: 1 to 8."""
    quadtree_largest_m: float = within(0.1, 0, 1000, before=0.0)
    """A cell is also split while its Gaussian would have a larger standard deviation than this,
    metres, whatever its contrast; 0: no limit, as published. Smaller: plain surfaces are sharper
    where they end and where they turn, with more Gaussians. Usual: 0.05 to 0.2 in a room."""
    quadtree_contrast: Literal["released", "std"] = "released"
    """How contrast is measured. "released": variance of the colour levels (0 to 255) times the
    number of image pixels / 9e7, as in the released code, so the threshold depends on the image
    size; "std": standard deviation of the colours in 0..1, the same at every size. Both average the
    variances of R, G and B with luma weights (0.3, 0.59, 0.11)."""
    thickness: float = within(0.2, 0.001, 1, before=1.0)
    """Standard deviation of a cell's new Gaussian along the normal of the measured surface, as a
    share of the two in the surface. 1: round, as published. Smaller: closer to the surface, so less
    is in front of it and behind. Usual: 0.1 to 0.5."""
    opacity: float = within(0.9, 0.01, 0.99, before=0.5)
    """Opacity of a cell's new Gaussian, 0 to 1. Larger: the surface hides what is behind it from
    the first step on. Published: 0.5."""
    one_per_voxel: bool = False
    """A voxel holds at most one Gaussian: of the new ones that share a voxel the largest is
    created, and none where the map has one already (GSFusion's paper, section IV-C.1; the released
    code does not check this). On: fewer Gaussians close to the camera."""
    without_depth: Literal["skip", "sides"] = setting("sides", before="skip")
    """What the rule gsfusion does with quadtree cells whose middle has no depth: "skip", as
    published: they get no Gaussian; "sides": where the map shows nothing yet, they get one at the
    depth of the measured pixels to their left, right, above and below. For windows, gloss and
    sensors with holes; without holes both are the same."""
    source_stride: int = within(0, 0)
    """Frames of a recording at 30 Hz from one mapped frame to the next: rules that are asked every
    n frames (``seeding.every``), and a rule's own interval of keyframes, count these. 0:
    data.stride. Set it for a recording that was thinned before. Larger: such rules are asked in
    more of the mapped frames."""
    options: dict[str, int | float | str | bool | Path] = field(default_factory=dict)
    """Keyword arguments of the rule, by name; on the command line: --rule-options name=value."""
    own_settings: tuple[str, ...] = field(default=(), compare=False)
    """What the user set, which stays although the rule brings another value: names, such as
    optim.lr_xyz, groups, such as optim, or all. Options on the command line, changes in Python and
    the values of a data set's preset are added by themselves."""

    def __post_init__(self):
        super().__post_init__()
        if any(isinstance(value, Path) for value in self.options.values()):
            plain = {
                name: str(value) if isinstance(value, Path) else value
                for name, value in self.options.items()
            }
            object.__setattr__(self, "options", plain)
        if not all(isinstance(name, str) for name in self.own_settings):
            raise ArgumentError(
                f"seeding.own_settings must hold names of settings, got {self.own_settings}"
            )


@dataclass(frozen=True, kw_only=True)
class DataConfig(Settings, group="data"):
    """Which frames are read from a sequence, and how."""

    width: int = within(0, 0, 16384)
    """Resize colour and depth to this width, pixels; 0 keeps the original width, or follows from
    height. Smaller: faster and less detail. Usual: 320 to 1280."""
    height: int = within(0, 0, 16384)
    """Resize to this height, pixels; 0 keeps the original height, or follows from width."""
    start: int = within(0, 0)
    """Number of the first frame that is read, counted from 0."""
    stop: int = within(0, 0)
    """Stop before this frame; 0 reads to the end."""
    stride: int = within(1, 1)
    """Read every n-th frame. Larger: faster, but less overlap between frames; tracking needs small
    steps. Usual: 1 to 10."""
    depth_min_m: float = within(0.0, 0, 1000)
    """Nearer depth counts as missing, metres; 0 keeps all. In RTG-SLAM Gaussians are drawn from
    there on, where it is above 0 and below 0.2, otherwise from 0.2 m on."""
    depth_max_m: float = within(0.0, 0, 1000)
    """Farther depth counts as missing, metres; 0 means no limit. Set it where the sensor becomes
    unreliable. Usual with a depth camera: 3 to 8."""
    hold_out_every: int = within(8, 0)
    """Every k-th frame is never mapped; the map is scored on these unseen views. Smaller: more
    views for the score, fewer for the map. 0 maps all frames; 8 is usual."""
    hold_out_offset: int = within(4, 0)
    """Which of each k frames is held out: 0 to k - 1."""
    scored_views: int = within(250, 0, before=0)
    """At most this many mapped views are scored, evenly spread; all held-out views are. 0 scores
    every mapped view, as the papers do; larger: more exact means, longer scoring. Usual: 100 to
    500."""
    align_held_out: bool = False
    """Score the held-out views again, each at the pose that fits its picture best, and once more
    with its brightness and white balance fitted, too: how good the map is where the data's poses
    are some millimetres off and the camera changed its exposure. All numbers are given. On: scoring
    takes longer, up to 20 pictures a view."""
    repair: RepairConfig = field(default_factory=RepairConfig)
    """Corrections of a recording that differs from what its layout says."""

    def __post_init__(self):
        super().__post_init__()
        if self.depth_max_m and self.depth_max_m <= self.depth_min_m:
            raise ArgumentError(
                f"data.depth_max_m must be above depth_min_m {self.depth_min_m}, got "
                f"{self.depth_max_m}"
            )
        if self.hold_out_every == 1:
            raise ArgumentError(
                "data.hold_out_every=1 would hold out every frame; use 0 for none or 2 and more"
            )


@dataclass(frozen=True, kw_only=True)
class TrackingConfig(Settings, group="tracking"):
    """Where the poses come from, and the frame-to-model ICP (iterative closest points; Peng et al.
    2024, Eq. 10)."""

    poses: Literal["given", "tracked"] = "given"
    """"given": poses of the data; "tracked": poses are estimated, and only the first frame's comes
    from the data."""
    pose_jumps: Literal["skip", "map"] = setting("skip", before="map")
    """What happens to a frame whose given pose is farther from the last one than a camera moves:
    more than 2 m a frame and 20 m/s by the time stamps, or 120 degrees a frame and 1500 degrees/s.
    "skip": it is not mapped, and the run says so; frames that go on from there are mapped. "map":
    it is mapped, and the run says so."""
    pyramid: tuple[int, ...] = within((8, 4, 2), 1, 1000)
    """Reduction of the image on each level, coarse to fine (code: 4, 2, 1). Larger first numbers:
    tolerates faster motion. A last level of 1 takes twice the time and gave no better poses, worse
    ones with noisy depth."""
    iterations: tuple[int, ...] = within((5, 5, 5), 1, 1000)
    """Gauss-Newton steps on each level, one number per level of pyramid. Larger: converges from
    farther away, slower. Usual: 3 to 20."""
    max_distance_m: float = positive(0.1)
    """Two points correspond only if they are closer than this, metres; on coarser levels the limit
    is multiplied by the square root of the reduction (not in the code). Larger: tolerates faster
    motion, but more wrong pairs. Usual: 0.05 to 0.3."""
    max_angle_deg: float = positive(30.0)
    """Two points correspond only if the angle between their normals is below this, degrees (code:
    20, which refuses two thirds of a Kinect's far points). Larger: keeps noisy points, but more
    wrong pairs. Usual: 15 to 45."""
    even_to_m: float | None = positive(1.0)
    """Up to this depth, metres, all points have the same weight; beyond it the weight falls as
    (this / z)^4, the inverse variance of a structured-light camera. Larger: far points count more;
    None: no weights (paper, code). Usual: 0.5 to 3, or None for depth without noise. Absolute
    trajectory error (ATE) with weights and without: 1.9 and 6.1 cm on the noisy redkitchen250, 0.3
    and 0.3 cm on the clean livingroom1_clean211, 0.6 and 0.2 cm on a clean room."""
    brightness_m: float | None = positive(0.1, before=None)
    """How much brightness counts beside depth: a difference of 1 (black to white) counts as much as
    this distance, metres. Depth alone slides along flat surfaces. Larger: pictures count more;
    None: depth alone (paper, code). Usual: 0.05 to 0.2. docs/tracking.md has the errors of both."""
    prior: Literal["constant_velocity", "previous"] = "constant_velocity"
    """Where ICP starts: "constant_velocity", the last motion repeated, or "previous", the last pose
    (released code; better for jerky motion)."""
    target: Literal["model", "hybrid"] = "model"
    """What ICP aligns the frame with. "model": the rendered map (paper), best for GSFusion's TSDF;
    "hybrid": the map where it agrees with the last frame to 1 cm and the last frame's own depth
    elsewhere (released code), needed for RTG-SLAM, whose newest discs are not exact yet. RTG-SLAM's
    mean ATE: on the built-in room 0.2 cm with "hybrid" and 5.5 cm with "model"; on redkitchen250
    5.4 cm with "hybrid", lost with "model"."""
    min_eigenvalue: float = within(1e-3, 0, 1)
    """A direction of motion is degenerate (the scene does not determine it, such as along a plain
    wall) if its information is below this share of the strongest direction's; then the predicted
    motion is kept in that direction. Rotation is measured in units of the points' spread. Well
    tracked frames had 0.009 or more. Usual: 1e-4 to 1e-2."""
    max_step_m: float = positive(0.5)
    """Tracking fails if the camera would have moved by more than this between two frames, metres.
    Usual: 0.1 to 1."""
    max_step_deg: float = positive(30.0)
    """Likewise if it would have turned by more than this, degrees. Usual: 10 to 60."""
    landmarks: bool = setting(False, before=False)
    """Search corners (ORB) of earlier keyframes in every frame. Where their pose is far from the
    predicted one, ICP starts from it, and their errors join ICP's. RTG-SLAM needs it, because its
    model is less exact than a TSDF: docs/tracking.md has the errors of both systems without and
    with it."""
    back_end: bool = False
    """Detect loops, and correct the trajectory by landmarks and a pose graph over keyframes (Peng
    et al. 2024, section 3.2, "Camera tracking"). Each Gaussian moves with the keyframe near which
    it was created; the released code leaves them."""

    def __post_init__(self):
        super().__post_init__()
        if len(self.pyramid) != len(self.iterations) or not self.pyramid:
            raise ArgumentError(
                "tracking.pyramid and tracking.iterations must have one entry per level, got "
                f"{self.pyramid} and {self.iterations}"
            )


@dataclass(frozen=True, kw_only=True)
class SystemConfig(Settings):
    """What the settings of any system hold; each system adds its own."""

    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    data: DataConfig = field(default_factory=DataConfig)
    sh_degree: int = within(3, 0, 3)
    """Degree of the spherical harmonics that store a Gaussian's colour, 0 to 3. 0: one colour from
    all sides, least memory and time. 3: colour may change with the viewing direction (gloss,
    reflections)."""
    keyframes_on: Literal["device", "cpu"] = "device"
    """Where the images of the keyframes are kept: "device" (with the map) or "cpu", which saves
    memory of the GPU."""
    all_in_view: bool = False
    """Off: in a map of more than 10,000 Gaussians, gradient steps leave out those that are more
    than 0.5 m behind the measured depth of their view, so that a room does not cost what is in the
    rooms behind its walls. On: a step changes whatever may be in its view, as published; slower in
    a building."""
    seed: int = 0
    """Seed of all random numbers. The same seed on the same machine gives the same map."""

    def __post_init__(self):
        super().__post_init__()
        # the data's poses may not move the depth that the tracker aligns
        if self.tracking.poses == "tracked":
            object.__setattr__(self, "data", replace(self.data, repair__depth_pose="colour"))

    @property
    def source_stride(self) -> int:
        """Frames of the recording from one mapped frame to the next."""
        return self.seeding.source_stride or self.data.stride
