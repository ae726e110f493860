"""Settings of camera tracking, for all systems."""

from dataclasses import dataclass
from typing import Literal

from .values import Settings, positive, within


@dataclass(frozen=True, kw_only=True)
class TrackingConfig(Settings, group="tracking"):
    """Where the poses come from, and the frame-to-model ICP (iterative closest points; Peng et al. 2024, Eq. 10)."""

    poses: Literal["given", "tracked"] = "given"
    """"given": poses of the data; "tracked": poses are estimated, and only the first frame's comes from the data."""
    pose_jumps: Literal["skip", "map"] = "skip"
    """What happens to a frame whose given pose is farther from the last one than a camera moves: more than 2 m a frame
    and 20 m/s by the time stamps, or 120 degrees a frame and 1500 degrees/s. "skip": it is not mapped, and the run says
    so; frames that go on from there are mapped. "map": it is mapped, and the run says so."""
    pyramid: tuple[int, ...] = within((8, 4, 2), 1, 1000)
    """Reduction of the image on each level, coarse to fine (code: 4, 2, 1). Larger first numbers: tolerates faster
    motion. A last level of 1 takes twice the time and gave no better poses, worse ones with noisy depth."""
    iterations: tuple[int, ...] = within((5, 5, 5), 1, 1000)
    """Gauss-Newton steps on each level, one number per level of pyramid. Larger: converges from farther away, slower.
    Usual: 3 to 20."""
    max_distance_m: float = positive(0.1)
    """Two points correspond only if they are closer than this, metres; on coarser levels the limit is multiplied by the
    square root of the reduction (not in the code). Larger: tolerates faster motion, but more wrong pairs. Usual: 0.05
    to 0.3."""
    max_angle_deg: float = positive(30.0)
    """Two points correspond only if the angle between their normals is below this, degrees (code: 20, which refuses two
    thirds of a Kinect's far points). Larger: keeps noisy points, but more wrong pairs. Usual: 15 to 45."""
    even_to_m: float | None = positive(1.0)
    """Up to this depth, metres, all points have the same weight; beyond it the weight falls as (this / z)^4, the
    inverse variance of a structured-light camera. Larger: far points count more; None: no weights (paper, code). Usual:
    0.5 to 3, or None for depth without noise. Absolute trajectory error (ATE) with weights and without: 1.9 and 6.1 cm
    on the noisy redkitchen250, 0.3 and 0.3 cm on the clean livingroom1_clean211, 0.6 and 0.2 cm on a clean room."""
    brightness_m: float | None = positive(0.1)
    """How much brightness counts beside depth: a difference of 1 (black to white) counts as much as this distance,
    metres. Depth alone slides along flat surfaces. Larger: pictures count more; None: depth alone (paper, code). Usual:
    0.05 to 0.2. docs/tracking.md has the errors of both."""
    prior: Literal["constant_velocity", "previous"] = "constant_velocity"
    """Where ICP starts: "constant_velocity", the last motion repeated, or "previous", the last pose (released code;
    better for jerky motion)."""
    target: Literal["model", "hybrid"] = "model"
    """What ICP aligns the frame with. "model": the rendered map (paper), best for GSFusion's TSDF; "hybrid": the map
    where it agrees with the last frame to 1 cm and the last frame's own depth elsewhere (released code), needed for
    RTG-SLAM, whose newest discs are not exact yet. RTG-SLAM's mean ATE: on the built-in room 0.2 cm with "hybrid" and
    5.5 cm with "model"; on redkitchen250 5.4 cm with "hybrid", lost with "model"."""
    min_eigenvalue: float = within(1e-3, 0, 1)
    """A direction of motion is degenerate (the scene does not determine it, such as along a plain wall) if its
    information is below this share of the strongest direction's; then the predicted motion is kept in that direction.
    Rotation is measured in units of the points' spread. Well tracked frames had 0.009 or more. Usual: 1e-4 to 1e-2."""
    max_step_m: float = positive(0.5)
    """Tracking fails if the camera would have moved by more than this between two frames, metres. Usual: 0.1 to 1."""
    max_step_deg: float = positive(30.0)
    """Likewise if it would have turned by more than this, degrees. Usual: 10 to 60."""
    landmarks: bool = False
    """Search corners (ORB) of earlier keyframes in every frame. Where their pose is far from the predicted one, ICP
    starts from it, and their errors join ICP's. On by default for RTG-SLAM, whose model is less exact than a TSDF:
    docs/tracking.md has the errors of both systems without and with it."""
    back_end: bool = False
    """Detect loops, and correct the trajectory by landmarks and a pose graph over keyframes (Peng et al. 2024, section
    3.2, "Camera tracking"). Each Gaussian moves with the keyframe near which it was created; the released code leaves
    them."""

    def __post_init__(self):
        super().__post_init__()
        if len(self.pyramid) != len(self.iterations) or not self.pyramid:
            raise ValueError(
                "tracking.pyramid and tracking.iterations must have one entry per level, got "
                f"{self.pyramid} and {self.iterations}"
            )
