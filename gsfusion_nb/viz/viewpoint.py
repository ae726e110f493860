"""Where to look from: a camera that circles a point, and a good place to start."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

Vector = Float[Tensor, "3"] | Sequence[float | int]


def orbit_camera(
    target_W: Vector,
    azimuth_deg: float | int,
    elevation_deg: float | int,
    distance_m: float | int,
    up_W: Vector = (0.0, 0.0, 1.0),
) -> Float[Tensor, "4 4"]:
    """Pose of an upright camera on a sphere around ``target_W``, looking at its centre.

        r = cos(az) e_1 + sin(az) e_2,   centre = target + distance (cos(el) r + sin(el) up),   right = up x r

    with e_1 the world axis farthest from up (x when up is z) made orthogonal to it, and e_2 = up x e_1. "Right" does
    not depend on the elevation, so looking straight down needs no special case. At distance 0 the camera is at the
    target, and the angles only turn it.

    Args:
        target_W: Point in the middle of the picture, metres. [3]
        azimuth_deg: Angle around ``up_W``, counter-clockwise seen from above, degrees.
        elevation_deg: Angle above the plane through the target, degrees.
        distance_m: Radius of the sphere, metres, >= 0.
        up_W: The direction that is up in the picture, any length but 0. [3]

    Returns:
        T_WC, float32, OpenCV axes. [4, 4]

    Raises:
        ValueError: ``up_W`` has no direction, or the distance is negative.
    """
    if not distance_m >= 0:
        raise ValueError(f"distance_m must be >= 0, got {distance_m}")
    target = torch.as_tensor(target_W, dtype=torch.float64).cpu()
    e1, e2, up = _plane(up_W)
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    r = math.cos(azimuth) * e1 + math.sin(azimuth) * e2
    outwards = math.cos(elevation) * r + math.sin(elevation) * up
    right = torch.linalg.cross(up, r)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 0], T[:3, 1], T[:3, 2] = right, torch.linalg.cross(-outwards, right), -outwards
    T[:3, 3] = target + distance_m * outwards
    return T.to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """The numbers of ``orbit_camera``."""

    target_W: tuple[float, float, float]
    azimuth_deg: float
    elevation_deg: float
    distance_m: float

    def pose(self, up_W: Vector) -> Float[Tensor, "4 4"]:
        """T_WC of the camera."""
        return orbit_camera(self.target_W, self.azimuth_deg, self.elevation_deg, self.distance_m, up_W)


def viewpoint_of(T_WC: Float[Tensor, "4 4"], distance_m: float | int, up_W: Vector) -> Viewpoint:
    """The orbit that passes through a camera and circles the point ``distance_m`` in front of it (its roll is lost)."""
    T = T_WC.detach().cpu().double()
    e1, e2, up = _plane(up_W)
    forward = T[:3, 2]
    target = T[:3, 3] + distance_m * forward
    elevation = math.degrees(math.asin(max(-1.0, min(1.0, float(-forward @ up)))))
    azimuth = math.degrees(math.atan2(float(-forward @ e2), float(-forward @ e1)))
    x, y, z = target.tolist()
    return Viewpoint(target_W=(x, y, z), azimuth_deg=azimuth, elevation_deg=elevation, distance_m=distance_m)


def extent(xyz_W: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "3"], float]:
    """Centre and radius (half the diagonal) of the box around the points without the outermost 2 % on each side."""
    if not len(xyz_W):
        return torch.zeros(3), 1.0
    rows = xyz_W.detach().cpu()[:: max(1, len(xyz_W) // 20_000)].float()
    low, high = torch.quantile(rows, torch.tensor([0.02, 0.98]), dim=0)
    return (low + high) / 2, max(float((high - low).norm()) / 2, 1e-3)


def _plane(up_W: Vector) -> tuple[Tensor, Tensor, Tensor]:
    """Two horizontal directions and the unit up, a right-handed frame, float64."""
    up = torch.as_tensor(up_W, dtype=torch.float64).detach().cpu()
    if up.shape != (3,) or not float(up.norm()) > 1e-9 or not bool(up.isfinite().all()):
        raise ValueError(f"up_W must be a direction of three numbers, got {up.tolist()}")
    up = up / up.norm()
    axis = torch.zeros(3, dtype=torch.float64)
    axis[int(up.abs().argmin())] = 1.0
    e1 = axis - (axis @ up) * up
    e1 = e1 / e1.norm()
    return e1, torch.linalg.cross(up, e1), up
