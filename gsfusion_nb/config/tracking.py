"""Settings of camera tracking and of its back end, for both systems."""

from dataclasses import dataclass, field
from typing import Literal

from ..checks import check_number, check_positive
from .values import check_kinds


@dataclass(frozen=True, kw_only=True)
class BackEndConfig:
    """Landmarks, loop closure and the pose graph over keyframes (Peng et al. 2024, section 3.2, "Camera tracking")."""

    enabled: bool = False
    """Needs the extra "slam" (GTSAM)."""
    on_correction: Literal["move", "leave"] = "move"
    """What happens to the Gaussians when a loop corrects the trajectory: each moves with the keyframe it was born
    near, or all stay where they are (released code)."""
    features: int = 1000
    """ORB features per keyframe."""
    levels: int = 8
    """Levels of the ORB pyramid."""
    keyframe_rotation_deg: float = 15.0
    keyframe_translation_m: float = 0.15
    """The graph takes a keyframe when the camera has turned or moved so far since the last one."""
    loop_min_gap: int = 8
    """A loop joins keyframes at least so many keyframes apart."""
    loop_min_inliers: int = 30
    """Landmarks that must agree on a loop's relative pose."""
    loop_max_drift: float = 0.2
    """A loop that disagrees with the trajectory by more than 0.3 m and 10 degrees plus this share of the path between
    its ends (metres of metres, degrees of degrees) is another place that looks the same."""
    correct_from_m: float = 0.02
    correct_from_deg: float = 0.5
    """A loop that the trajectory misses by less needs no correction at once; ``finish`` uses it all the same."""
    odometry_sigma_m: float = 0.02
    odometry_sigma_deg: float = 0.5
    """Largest standard deviation of the front end's relative pose between two keyframes of the graph, per axis; it is
    trusted more where it agrees with the landmarks."""
    landmarks_per_keyframe: int = 150
    """Landmarks of each keyframe that take part in the last optimisation, those with the longest tracks first."""

    def __post_init__(self):
        check_kinds("tracking.back_end", self)
        for name in ("features", "levels", "loop_min_gap", "loop_min_inliers", "landmarks_per_keyframe"):
            check_number(f"tracking.back_end.{name}", getattr(self, name), 1, 100_000)
        for name in ("keyframe_rotation_deg", "keyframe_translation_m", "odometry_sigma_m", "odometry_sigma_deg"):
            check_positive(f"tracking.back_end.{name}", getattr(self, name))
        for name in ("loop_max_drift", "correct_from_m", "correct_from_deg"):
            check_number(f"tracking.back_end.{name}", getattr(self, name), 0, 1000)


@dataclass(frozen=True, kw_only=True)
class TrackingConfig:
    """Where a frame's pose comes from, and the frame-to-model ICP (Peng et al. 2024, Eq. 10)."""

    poses: Literal["given", "tracked"] = "given"
    """Poses of the data, or estimated: then only the first frame's is taken from the data."""
    pyramid: tuple[int, ...] = (8, 4, 2)
    """Image reduction of each level, coarse to fine (code: 4, 2, 1). The frames' last level gives no better pose, and
    at twice the time a worse one from noisy depth."""
    iterations: tuple[int, ...] = (5, 5, 5)
    """Gauss-Newton steps at each level."""
    max_distance_m: float = 0.1
    """Farther apart two points do not correspond; on coarser levels the limit is wider, by the
    square root of the reduction (code: not)."""
    max_angle_deg: float = 30.0
    """Normals at a larger angle do not correspond (code: 20, which refuses two thirds of a Kinect's far points)."""
    even_to_m: float | None = 1.0
    """Up to this depth all points weigh the same, beyond it by (this / z)^4, the inverse variance of a structured-light
    camera. None: no weights (paper, code). Measured on redkitchen250: ATE 1.9 cm with it, 6.1 cm without; clean data
    lose little, livingroom1_clean211 0.3 and 0.3 cm, a clean room 0.6 and 0.2 cm."""
    damping: float = 1e-6
    """Added to the normal equations, as a share of their trace (released code: 1e-4)."""
    prior: Literal["constant_velocity", "previous"] = "constant_velocity"
    """Where ICP starts: the last motion once more, or the last pose (released code)."""
    target: Literal["model", "hybrid"] = "model"
    """What ICP aligns with: the rendered model (paper), or the model where it agrees with the last frame to 1 cm and
    the last frame's own depth elsewhere (released code). A TSDF is good enough alone; young discs are not: RTG-SLAM's
    mean ATE is 0.2 cm with "hybrid" and 5.5 cm with "model" on the built-in room, 5.4 cm and lost on redkitchen250."""
    min_inliers: float = 0.15
    """Less than this share of the pixels with depth in correspondence: tracking is lost."""
    min_agreement: float = 0.4
    """Less than this share of the pixels that fall on a known part of the model in correspondence: likewise. Tracked
    frames had 0.53 and more, and of 390 started from the pose of another place 15 came to above 0.4."""
    max_rms_m: float = 0.02
    """A larger root mean square point-to-plane distance: tracking is lost."""
    min_eigenvalue: float = 1e-3
    """A direction of motion whose information is below this share of the strongest (rotation in units of the
    points' spread) is degenerate: the prior decides it. Tracked frames had 0.009 and more."""
    max_step_m: float = 0.5
    max_step_deg: float = 30.0
    """A motion beyond this between two frames is a failure."""
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
        for name in ("max_distance_m", "max_angle_deg", "max_rms_m", "max_step_m", "max_step_deg"):
            check_positive(f"tracking.{name}", getattr(self, name))
        if self.even_to_m is not None:
            check_positive("tracking.even_to_m", self.even_to_m)
        check_number("tracking.damping", self.damping, 0, 1)
        check_number("tracking.min_inliers", self.min_inliers, 0, 1)
        check_number("tracking.min_agreement", self.min_agreement, 0, 1)
        check_number("tracking.min_eigenvalue", self.min_eigenvalue, 0, 1)
