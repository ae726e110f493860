"""Limits of a plausible camera, pose and depth scale: one set for all readers, converters and mappers.

The limits are wide. A value beyond them is a mistake in a file (a wrong unit, swapped numbers) that would lead to a
wrong or an empty map.
"""

from jaxtyping import Bool, Float
from torch import Tensor

from .types import Camera

FOCAL_PER_SIDE = (0.05, 100.0)
"""Focal length in units of the image's side: fields of view from 169 down to 0.6 degrees."""
PIXEL_ASPECT = 10.0
"""fx and fy differ by at most this factor; pixels of cameras are square, and images may be resized along one side."""
CENTRE_SIDES = (-1.0, 2.0)
"""Place of the principal point in units of the image's side; 0 and 1 are the image's edges."""
MAX_DISTANCE_M = 10_000.0
"""Distance of anything from the origin, metres: farther out float32 cannot hold a millimetre."""
FAR_DEPTH_M = 30.0
"""A frame whose median depth is beyond this is doubtful: depth cameras measure up to 10 m."""
DEPTH_SCALE = (1.0, 1_000_000.0)
"""Stored depth value of one metre: from metres to micrometres."""

LATEST_S = 1e11
"""Time of a frame, seconds; the seconds since 1970 are 1.8e9."""
LEAST_SIDE_PX = 2
"""Side of an image, pixels: gradients and the points between pixels need neighbours."""
FARTHEST = 1e7
"""Distance and size of a Gaussian of another program, in its units: farther out float32 cannot hold one of them."""


def check_camera(source: str, camera: Camera) -> None:
    """Raise ``ValueError`` for an impossible camera; the sentence begins with ``source``."""
    if min(camera.width, camera.height) < LEAST_SIDE_PX:
        raise ValueError(
            f"{source}: images must have at least {LEAST_SIDE_PX} x {LEAST_SIDE_PX} pixels, got {camera.width} x "
            f"{camera.height}"
        )
    for axis, focal, centre, side in (
        ("x", camera.fx, camera.cx, camera.width),
        ("y", camera.fy, camera.cy, camera.height),
    ):
        low, high = (limit * side for limit in FOCAL_PER_SIDE)
        if not low <= focal <= high:
            raise ValueError(
                f"{source}: f{axis} must be between {low:g} and {high:g} pixels for {side} pixels, got {focal:g}"
            )
        first, last = (limit * side for limit in CENTRE_SIDES)
        if not first <= centre <= last:
            raise ValueError(
                f"{source}: c{axis} must be between {first:g} and {last:g} pixels for {side} pixels, got {centre:g}"
            )
    if not 1 / PIXEL_ASPECT <= camera.fx / camera.fy <= PIXEL_ASPECT:
        raise ValueError(
            f"{source}: fx and fy must not differ by more than a factor of {PIXEL_ASPECT:g}, got {camera.fx:g} and "
            f"{camera.fy:g}"
        )


def check_place(source: str, T_WC: Float[Tensor, "4 4"]) -> None:
    """Raise ``ValueError`` if the camera is too far from the origin; the sentence begins with ``source``."""
    if float(T_WC[:3, 3].abs().max()) > MAX_DISTANCE_M:
        place = ", ".join(f"{float(v):.4g}" for v in T_WC[:3, 3])
        raise ValueError(
            f"{source} must be within {MAX_DISTANCE_M / 1000:g} km of the origin, got ({place}) m: is the unit metres? "
            "Of map coordinates, subtract one origin from all poses"
        )


def check_depth_scale(source: str, scale: float) -> None:
    """Raise ``ValueError`` if no depth of one metre is stored as ``scale``; the sentence begins with ``source``."""
    low, high = DEPTH_SCALE
    if not low <= scale <= high:
        inverse = f"; is it {1 / scale:g}, the inverse?" if 0 < scale < low else ""
        raise ValueError(
            f"{source}: the depth scale, the stored value of one metre, must be between {low:g} and {high:g}, got "
            f"{scale:g}{inverse}"
        )


def is_near(xyz_W: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
    """Which points are within the limit of distance; False for NaN. [N]"""
    return (xyz_W.abs() <= MAX_DISTANCE_M).all(dim=-1)
