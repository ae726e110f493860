"""Settings of camera tracking and of its back end, for all systems."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from ..checks import check_number, check_positive
from .values import check_kinds


@dataclass(frozen=True, kw_only=True)
class BackEndConfig:
    """Landmarks, loop closure and the pose graph over keyframes (Peng et al. 2024, section 3.2, "Camera tracking")."""

    enabled: bool = False
    """Detect loops and correct the trajectory. Needs the extra "slam" (GTSAM)."""
    on_correction: Literal["move", "leave"] = "move"
    """What happens to the Gaussians when a loop corrects the trajectory: "move", each moves with the keyframe near
    which it was created, or "leave", all stay where they are (released code)."""
    features: int = 1000
    """ORB features per keyframe. Larger: more reliable loops and relocalisation, slower. Usual: 500 to 2000."""
    levels: int = 8
    """Levels of the ORB image pyramid. Larger: features match over larger changes of distance. Usual: 4 to 10."""
    keyframe_rotation_deg: float = 15.0
    """The pose graph gets a new keyframe when the camera has turned by this since the last one, degrees. Larger: a
    smaller graph, faster, but fewer chances to find a loop. Usual: 10 to 30."""
    keyframe_translation_m: float = 0.15
    """Likewise when the camera has moved by this, metres. Usual: 0.1 to 0.5."""
    loop_min_gap: int = 8
    """A loop connects keyframes that are at least this many keyframes apart. Larger: ignores short loops. Usual: 5 to
    20."""
    loop_min_inliers: ClassVar[int] = 30
    """Smallest number of landmarks that must agree on the relative pose of a loop. Larger: fewer false loops, and fewer
    true ones. Usual: 20 to 100."""
    loop_max_drift: ClassVar[float] = 0.2
    """A loop is refused, as another place that looks the same, if it disagrees with the trajectory by more than 0.3 m
    and 10 degrees plus this share of the path between its ends (of its length, of its rotation). Larger: accepts loops
    after more drift, and more false ones. Usual: 0.05 to 0.5."""
    correct_from_m: float = 0.02
    """A loop corrects the trajectory at once if they disagree by more than this, metres; smaller differences are
    corrected at the end of the scan. Larger: fewer interruptions. Usual: 0.01 to 0.1."""
    correct_from_deg: ClassVar[float] = 0.5
    """Likewise for the angle between them, degrees. Usual: 0.2 to 5."""
    odometry_sigma_m: ClassVar[float] = 0.02
    """Largest standard deviation of the tracked motion between two keyframes of the graph, metres per axis; it is
    trusted more where it agrees with the landmarks. Larger: loops bend the trajectory more. Usual: 0.005 to 0.1."""
    odometry_sigma_deg: ClassVar[float] = 0.5
    """Likewise for its rotation, degrees per axis. Usual: 0.1 to 2."""
    landmarks_per_keyframe: ClassVar[int] = 150
    """How many landmarks of each keyframe take part in the optimisation at the end, those seen in most frames first.
    Larger: more exact, slower. Usual: 50 to 500."""

    def __post_init__(self):
        check_kinds("tracking.back_end", self)
        for name in ("features", "levels", "loop_min_gap"):
            check_number(f"tracking.back_end.{name}", getattr(self, name), 1, 100_000)
        for name in ("keyframe_rotation_deg", "keyframe_translation_m"):
            check_positive(f"tracking.back_end.{name}", getattr(self, name))
        check_number("tracking.back_end.correct_from_m", self.correct_from_m, 0, 1000)


@dataclass(frozen=True, kw_only=True)
class LandmarkConfig:
    """Landmarks that help ICP in every frame: corners (ORB) of earlier keyframes, found again in the frame."""

    enabled: bool = False
    """Search the landmarks of the local map in every frame. Where their pose is far from the predicted one, ICP starts
    from it, and their errors join ICP's. The settings of the features are those of the back end, which need not be
    enabled. On by default for RTG-SLAM, whose model is less exact than a TSDF: docs/tracking.md has the errors
    of both systems without and with it."""
    sigma_m: ClassVar[float] = 0.02
    """A landmark that is off by one standard deviation counts as much as a pixel of near depth that is off by this,
    metres, where the pose from depth contradicts the landmarks beyond their noise; where it does not, they do not
    count. Larger: texture counts more, depth less. Usual: 0.01 to 0.03."""

    def __post_init__(self):
        check_kinds("tracking.landmarks", self)


@dataclass(frozen=True, kw_only=True)
class TrackingConfig:
    """Where the poses come from, and the frame-to-model ICP (iterative closest points; Peng et al. 2024, Eq. 10)."""

    poses: Literal["given", "tracked"] = "given"
    """"given": poses of the data; "tracked": poses are estimated, and only the first frame's comes from the data."""
    pose_jumps: Literal["skip", "map"] = "skip"
    """What happens to a frame whose given pose is farther from the last one than a camera moves: more than 2 m a frame
    and 20 m/s by the time stamps, or 120 degrees a frame and 1500 degrees/s. "skip": it is not mapped, and the run says
    so; frames that go on from there are mapped. "map": it is mapped, and the run says so."""
    pyramid: tuple[int, ...] = (8, 4, 2)
    """Reduction of the image on each level, coarse to fine (code: 4, 2, 1). Larger first numbers: tolerates faster
    motion. A last level of 1 takes twice the time and gave no better poses, worse ones with noisy depth."""
    iterations: tuple[int, ...] = (5, 5, 5)
    """Gauss-Newton steps on each level, one number per level of pyramid. Larger: converges from farther away, slower.
    Usual: 3 to 20."""
    max_distance_m: float = 0.1
    """Two points correspond only if they are closer than this, metres; on coarser levels the limit is multiplied by the
    square root of the reduction (not in the code). Larger: tolerates faster motion, but more wrong pairs. Usual: 0.05
    to 0.3."""
    max_angle_deg: float = 30.0
    """Two points correspond only if the angle between their normals is below this, degrees (code: 20, which refuses two
    thirds of a Kinect's far points). Larger: keeps noisy points, but more wrong pairs. Usual: 15 to 45."""
    even_to_m: float | None = 1.0
    """Up to this depth, metres, all points have the same weight; beyond it the weight falls as (this / z)^4, the
    inverse variance of a structured-light camera. Larger: far points count more; None: no weights (paper, code). Usual:
    0.5 to 3, or None for depth without noise. Absolute trajectory error (ATE) with weights and without: 1.9 and 6.1 cm
    on the noisy redkitchen250, 0.3 and 0.3 cm on the clean livingroom1_clean211, 0.6 and 0.2 cm on a clean room."""
    brightness_m: float | None = 0.1
    """How much brightness counts beside depth: a difference of 1 (black to white) counts as much as this distance,
    metres. Depth alone slides along flat surfaces. Larger: pictures count more; None: depth alone (paper, code). Usual:
    0.05 to 0.2. docs/tracking.md has the errors of both."""
    damping: float = 1e-6
    """Damping of the normal equations, as a share of their trace (released code: 1e-4). Larger: smaller, safer steps,
    slower convergence. Usual: 0 to 1e-3."""
    prior: Literal["constant_velocity", "previous"] = "constant_velocity"
    """Where ICP starts: "constant_velocity", the last motion repeated, or "previous", the last pose (released code;
    better for jerky motion)."""
    target: Literal["model", "hybrid"] = "model"
    """What ICP aligns the frame with. "model": the rendered map (paper), best for GSFusion's TSDF; "hybrid": the map
    where it agrees with the last frame to 1 cm and the last frame's own depth elsewhere (released code), needed for
    RTG-SLAM, whose newest discs are not exact yet. RTG-SLAM's mean ATE: on the built-in room 0.2 cm with "hybrid" and
    5.5 cm with "model"; on redkitchen250 5.4 cm with "hybrid", lost with "model"."""
    min_inliers: ClassVar[float] = 0.15
    """Tracking fails if less than this share of the pixels with depth found a corresponding point, 0 to 1. Larger:
    gives up earlier instead of accepting a wrong pose. Usual: 0.1 to 0.4."""
    min_overlap_inliers: float = 0.4
    """Tracking also fails if less than this share of the pixels that fall on a known part of the model found a
    corresponding point, 0 to 1. Correctly tracked frames had 0.53 or more; of 390 frames started at the pose of another
    place, 15 reached more than 0.4. Usual: 0.3 to 0.5."""
    max_rms_m: ClassVar[float] = 0.02
    """Tracking fails if the root mean square of the point-to-plane distances is above this, metres. Larger: accepts
    noisier depth. Usual: 0.01 to 0.05."""
    min_eigenvalue: float = 1e-3
    """A direction of motion is degenerate (the scene does not determine it, such as along a plain wall) if its
    information is below this share of the strongest direction's; then the predicted motion is kept in that direction.
    Rotation is measured in units of the points' spread. Well tracked frames had 0.009 or more. Usual: 1e-4 to 1e-2."""
    max_step_m: float = 0.5
    """Tracking fails if the camera would have moved by more than this between two frames, metres. Usual: 0.1 to 1."""
    max_step_deg: float = 30.0
    """Likewise if it would have turned by more than this, degrees. Usual: 10 to 60."""
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    back_end: BackEndConfig = field(default_factory=BackEndConfig)

    def __post_init__(self):
        check_kinds("tracking", self)
        if len(self.pyramid) != len(self.iterations) or not self.pyramid:
            raise ValueError(
                "tracking.pyramid and tracking.iterations must have one entry per level, got "
                f"{self.pyramid} and {self.iterations}"
            )
        for name in ("pyramid", "iterations"):
            for value in getattr(self, name):
                check_number(f"tracking.{name}", value, 1, 1000)
        for name in ("max_distance_m", "max_angle_deg", "max_step_m", "max_step_deg"):
            check_positive(f"tracking.{name}", getattr(self, name))
        if self.even_to_m is not None:
            check_positive("tracking.even_to_m", self.even_to_m)
        if self.brightness_m is not None:
            check_positive("tracking.brightness_m", self.brightness_m)
        check_number("tracking.damping", self.damping, 0, 1)
        check_number("tracking.min_overlap_inliers", self.min_overlap_inliers, 0, 1)
        check_number("tracking.min_eigenvalue", self.min_eigenvalue, 0, 1)
