"""Where to look from: a camera that circles a point, and good places to start."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_pose
from ..errors import ArgumentError
from ..evaluation import expected_depth_m
from ..render import render
from ..render.constants import NEAR_PLANE_M
from ..types import Camera, GaussianParams

Vector = Float[Tensor, "3"] | Sequence[float | int]


def orbit_camera(
    target_W: Vector,
    azimuth_deg: float | int,
    elevation_deg: float | int,
    distance_m: float | int,
    up_W: Vector = (0.0, 0.0, 1.0),
) -> Float[Tensor, "4 4"]:
    """Pose of an upright camera on a sphere around ``target_W``, looking at its centre.

        r      = cos(az) e_1 + sin(az) e_2
        centre = target + distance (cos(el) r + sin(el) up)
        right  = up x r

    with e_1 the world axis farthest from up (x when up is z) made orthogonal to it, and e_2 = up x
    e_1. "Right" does not depend on the elevation, so looking straight down needs no special case.
    At distance 0 the camera is at the target, and the angles only turn it.

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
        raise ArgumentError(f"distance_m must be >= 0, got {distance_m}")
    target = torch.as_tensor(target_W, dtype=torch.float64).cpu()
    up_axis = torch.as_tensor(up_W, dtype=torch.float64).detach().cpu()
    if not float(up_axis.norm()) > 1e-9:
        raise ArgumentError(f"up_W must be a direction of three numbers, got {up_axis.tolist()}")
    up_axis = up_axis / up_axis.norm()
    axis = torch.nn.functional.one_hot(up_axis.abs().argmin(), 3).double()
    e1 = torch.nn.functional.normalize(axis - (axis @ up_axis) * up_axis, dim=0)
    e2 = torch.linalg.cross(up_axis, e1)
    azimuth = math.radians(azimuth_deg)
    elevation = math.radians(elevation_deg)
    r = math.cos(azimuth) * e1 + math.sin(azimuth) * e2
    outwards = math.cos(elevation) * r + math.sin(elevation) * up_axis
    right = torch.linalg.cross(up_axis, r)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 0] = right
    T[:3, 1] = torch.linalg.cross(-outwards, right)
    T[:3, 2] = -outwards
    T[:3, 3] = target + distance_m * outwards
    return T.to(torch.float32)


def extent(xyz_W: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "3"], float]:
    """Centre and radius (half the diagonal) of the box around the points without the outermost 2 %
    on each side."""
    if not len(xyz_W):
        return torch.zeros(3), 1.0
    rows = xyz_W.detach().cpu()[:: max(1, len(xyz_W) // 20_000)].float()
    low, high = torch.quantile(
        rows,
        torch.tensor([0.02, 0.98]),
        dim=0,
    )
    return (low + high) / 2, max(float((high - low).norm()) / 2, 1e-3)


_FOCAL_PER_WIDTH = 0.7
"""Focal length / image width of a viewer without a camera: a 71 degree wide view."""


def viewing_camera(camera: Camera | None, width: int | None, height: int | None) -> Camera:
    """The given camera for a canvas of the given size, with its horizontal angle of view.

    By default the canvas has the camera's size, at most 640 pixels wide; without a camera it is 480
    x 360.
    """
    if camera is None:
        w = width or 480
        h = height or 360
        return Camera(
            width=w,
            height=h,
            fx=_FOCAL_PER_WIDTH * w,
            fy=_FOCAL_PER_WIDTH * w,
            cx=w / 2,
            cy=h / 2,
        )
    if width is None:
        width = (
            min(camera.width, 640)
            if height is None
            else round(height * camera.width / camera.height)
        )
    resized_camera = camera.resized(width, round(width * camera.height / camera.width))
    if height is None or height == resized_camera.height:
        return resized_camera
    return Camera(
        width=width,
        height=height,
        fx=resized_camera.fx,
        fy=resized_camera.fy,
        cx=resized_camera.cx,
        cy=resized_camera.cy + (height - resized_camera.height) / 2,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """A camera pose of a viewer, and what it hides."""

    T_WC: Float[Tensor, "4 4"]
    pivot_m: float
    """Distance of the point to turn around, metres."""
    cut_m: float = 0.0
    """Everything nearer than this is hidden, metres."""


def places_of(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"] | None,
    up_W: Float[Tensor, "3"],
    near_m: float = NEAR_PLANE_M,
) -> dict[str, Place]:
    """Where a viewer of a map can be put.

    Args:
        params: The map.
        camera: Of the viewer.
        T_WC: The pose "photo"; without one it is a view of the whole map from 35 degrees above. Its
            pivot is at the median depth of the view.
        up_W: The world's up direction.
        near_m: Nearer Gaussians are not drawn, metres.

    Returns:
        "photo", where the viewer starts; "above", without the roof; and "inside", in the middle of
        the map.
    """
    centre_W, radius_m = extent(params.xyz_W)
    x, y, z = centre_W.tolist()
    far_m = 0.9 * radius_m / min(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)

    def orbit_pose(
        azimuth_deg: float, elevation_deg: float, distance_m: float
    ) -> Float[Tensor, "4 4"]:
        return orbit_camera((x, y, z), azimuth_deg, elevation_deg, distance_m, up_W)

    if T_WC is None:
        photo = Place(T_WC=orbit_pose(-60.0, 35.0, far_m), pivot_m=far_m)
    else:
        check_pose("T_WC", T_WC)
        pose = T_WC.detach().cpu().float()
        depth_m = expected_depth_m(render(params, camera, pose, near_m=near_m))
        valid_depth_m = depth_m[depth_m > 0]
        photo = Place(
            T_WC=pose, pivot_m=float(valid_depth_m.median()) if len(valid_depth_m) else radius_m
        )
    return {
        "photo": photo,
        "above": Place(
            T_WC=orbit_pose(-60.0, 74.0, far_m),
            pivot_m=far_m,
            cut_m=max(far_m - 0.13 * radius_m, 0.0),
        ),
        "inside": Place(T_WC=orbit_pose(90.0, 0.0, 0.0), pivot_m=0.3),
    }
