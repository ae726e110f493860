"""Cameras with lens distortion: removing it, and registering depth to the colour of another
camera."""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..errors import ArgumentError, SequenceError
from ..geometry import depth_to_points, project, se3
from ..geometry.operands import check_plausible_camera
from ..types import Camera

TIE = 1e-3
"""Nearest-pixel maps are shifted by this many pixels, so that of two equally near pixels the lower
one is always chosen."""
SAME_PX = 0.05
"""Two cameras whose rays meet the image border within this distance, in pixels, count as equal."""
LARGEST_FOOTPRINT_PX = 64
"""A pixel of depth that would cover more pixels of the other camera across, because it is almost in
that camera's image plane, is a point."""
SAME_SURFACE = 0.05
"""Depths that differ by less than this share of the nearer one may be of one surface within a
pixel."""
SEAM_PX = 0.25
"""Slanted surfaces come apart between two pixels of depth, by less than this in the other image. A
seam is filled from both sides."""


@dataclass(frozen=True)
class CameraModel:
    """A pinhole with OpenCV's distortion: Brown's (k1 k2 p1 p2 [k3 [k4 k5 k6 ...]]) or, for a
    fisheye, k1 to k4."""

    camera: Camera
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @property
    def is_pinhole(self) -> bool:
        """Whether there is no distortion."""
        return not self.fisheye and not any(self.distortion)

    def resized(self, width: int, height: int) -> "CameraModel":
        """The same lens on another pixel grid."""
        return CameraModel(self.camera.resized(width, height), self.distortion, self.fisheye)

    def fitted(self, width: int, height: int, source: str) -> "CameraModel":
        """This camera for an image of the given size.

        Raises:
            SequenceError: the image has other proportions than the camera, so it is not only
                resized.
        """
        own_size = (self.camera.width, self.camera.height)
        if own_size == (width, height):
            return self
        if not same_proportions((width, height), own_size):
            raise SequenceError(
                f"{source} is {width}x{height}, but its camera is "
                f"{self.camera.width}x{self.camera.height}, of other "
                "proportions; give the intrinsics of the images as they are"
            )
        return self.resized(width, height)

    def pinhole(self) -> Camera:
        """The pinhole of the undistorted image, which sees nothing outside the stored one.

        Raises:
            ValueError: the distortion is so strong that there is none.
        """
        if self.is_pinhole:
            return self.camera
        K, D, size = _opencv(self)
        if self.fisheye:
            K_new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                K, D, size, np.eye(3), balance=0.0
            )
        else:
            K_new, _ = cv2.getOptimalNewCameraMatrix(K, D, size, 0.0)
        try:
            camera = Camera(
                width=size[0],
                height=size[1],
                fx=float(K_new[0, 0]),
                fy=float(K_new[1, 1]),
                cx=float(K_new[0, 2]) + 0.5,
                cy=float(K_new[1, 2]) + 0.5,
            )
            check_plausible_camera("the camera without it", camera)
            return camera
        except ValueError as e:
            numbers = " ".join(f"{value:g}" for value in self.distortion)
            raise ArgumentError(
                f"the distortion {numbers} cannot be removed by a pinhole camera: {e}"
            ) from None


def same_proportions(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Whether two sizes, width and height, can be those of one view: resized, they differ by less
    than a pixel of the smaller one."""
    difference = abs(first[0] * second[1] - first[1] * second[0])
    return difference <= max(*first, *second)


def same_rays(model: CameraModel, camera: Camera) -> bool:
    """``model`` is ``camera``, or so close to it that no pixel would move."""
    a = model.camera
    if not model.is_pinhole or (a.width, a.height) != (camera.width, camera.height):
        return False
    left_right = np.array([0, a.width])
    top_bottom = np.array([0, a.height])
    dx_px = (left_right - a.cx) / a.fx * camera.fx + camera.cx - left_right
    dy_px = (top_bottom - a.cy) / a.fy * camera.fy + camera.cy - top_bottom
    return bool(np.abs([dx_px, dy_px]).max() < SAME_PX)


def pixel_map(model: CameraModel, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Position in the image of ``model`` for each pixel of ``camera``, for ``cv2.remap``. Two
    float32 [H, W]"""
    K, D, _ = _opencv(model)
    K_new, _, size = _opencv(CameraModel(camera))
    if model.fisheye:
        return cv2.fisheye.initUndistortRectifyMap(
            K,
            D,
            np.eye(3),
            K_new,
            size,
            cv2.CV_32FC1,
        )
    return cv2.initUndistortRectifyMap(K, D, np.eye(3), K_new, size, cv2.CV_32FC1)


def z_of_range(range_m: np.ndarray, model: CameraModel) -> np.ndarray:
    """z-depth of distances measured along each pixel's ray: z = range / |ray with z = 1|, float32.
    [H, W]"""
    height, width = range_m.shape
    K, D, _ = _opencv(model)
    u, v = np.meshgrid(
        np.arange(width, dtype=np.float64),
        np.arange(height, dtype=np.float64),
    )
    uv = np.stack([u, v], -1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if model.fisheye else cv2.undistortPoints
    xy = undistort(uv, K, D).reshape(height, width, 2)
    return (range_m / np.sqrt(1 + (xy * xy).sum(-1))).astype(np.float32)


def _opencv(model: CameraModel) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    K = model.camera.K.numpy().copy()
    K[:2, 2] -= 0.5  # OpenCV puts pixel centres at integers
    # OpenCV takes 4, 5, 8, 12 or 14 coefficients
    n = 4 if model.fisheye else next(n for n in (4, 5, 8, 12, 14) if n >= len(model.distortion))
    D = np.zeros(n)
    D[: len(model.distortion)] = model.distortion
    return K, D, (model.camera.width, model.camera.height)


def warp_depth(
    depth_m: Float[Tensor, "H W"],
    source: Camera,
    target: Camera,
    T_target_source: Float[Tensor, "4 4"],
) -> Float[Tensor, "h w"]:
    """Depth as ``target`` sees it: every point is moved to its pixel there; if several meet, the
    nearest is kept.

    One source pixel fills one target pixel, as it is right for two views of one camera. A target of
    a higher resolution would have holes (``register_depth``).

    Args:
        depth_m: z-depth, metres, 0 = missing. [H, W]
        source: Camera of ``depth_m``.
        target: Camera to warp into.
        T_target_source: Rigid transform from the source camera's frame to the target camera's.

    Returns:
        z-depth in the target camera, metres, 0 = missing. [h, w]

    Differentiable: no.
    """
    points = depth_to_points(source, depth_m)[depth_m > 0]
    P = se3.apply(T_target_source.to(depth_m.dtype), points)
    P = P[P[:, 2] > 0]
    u, v = project(target, P).floor().long().unbind(1)
    in_width = (u >= 0) & (u < target.width)
    in_height = (v >= 0) & (v < target.height)
    is_inside = in_width & in_height
    place = (v * target.width + u)[is_inside]
    nearest = depth_m.new_full((target.height * target.width,), torch.inf)
    nearest.scatter_reduce_(0, place, P[is_inside, 2], reduce="amin")
    nearest = nearest.where(nearest.isfinite(), torch.zeros_like(nearest))
    return nearest.reshape(target.height, target.width)


def register_depth(
    depth_m: Float[Tensor, "H W"],
    source: Camera,
    target: Camera,
    T_target_source: Float[Tensor, "4 4"],
) -> Float[Tensor, "h w"]:
    """Depth as a camera of another resolution sees it, without the holes that single points would
    leave.

    Every pixel of depth is a small plane parallel to its image. It fills the pixels of ``target``
    whose centres its outline covers there, and the one that its own centre falls into. Where
    several meet, the nearest surface is kept, and of it the pixel whose centre is nearest. Pixels
    that are left in a seam take one of the outlines beside it. So a lower resolution of depth gives
    blocks, and no depth is interpolated. librealsense fills outlines, too, when it aligns depth to
    colour.

    Args:
        depth_m: z-depth, metres, 0 = missing. [H, W]
        source: Camera of ``depth_m``.
        target: Camera to register to.
        T_target_source: Rigid transform from the source camera's frame to the target camera's.

    Returns:
        z-depth in the target camera, metres, 0 = missing. [h, w]

    Differentiable: no.
    """
    T = T_target_source.to(depth_m.dtype)
    has_depth = depth_m > 0
    P = se3.apply(T, depth_to_points(source, depth_m)[has_depth])
    half_width_m = 0.5 * depth_m[has_depth] / source.fx
    half_height_m = 0.5 * depth_m[has_depth] / source.fy
    half_right = T[:3, 0] * half_width_m[:, None]
    half_down = T[:3, 1] * half_height_m[:, None]
    in_front = P[:, 2] > 0
    P = P[in_front]
    half_right = half_right[in_front]
    half_down = half_down[in_front]
    outline = _Outline(
        uv=project(target, P),
        right=project(target, P + half_right) - project(target, P - half_right),
        down=project(target, P + half_down) - project(target, P - half_down),
        is_point=P[:, 2] <= half_right[:, 2].abs() + half_down[:, 2].abs(),
    )
    pairs = outline.covered(target)
    z = P[pairs.rows, 2]
    own = (~pairs.is_seam).nonzero()[:, 0]
    front_m = _front(
        pairs.place[own],
        z[own],
        pairs.away_px[own],
        target,
    )
    seam = pairs.is_seam.nonzero()[:, 0]
    seam = seam[front_m.flatten()[pairs.place[seam]] == 0]
    return torch.maximum(
        front_m,
        _front(pairs.place[seam], z[seam], pairs.away_px[seam], target),
    )


def _front(
    place: Int[Tensor, " K"],
    z: Float[Tensor, " K"],
    away_px: Float[Tensor, " K"],
    camera: Camera,
) -> Float[Tensor, "h w"]:
    """Of the depths ``z`` at each pixel, numbered row by row, one of the nearest surface; 0 where
    there is none.

    Of several on that surface the one is taken whose centre is nearest to that of the pixel: the
    nearest one of all would draw slanted surfaces towards the camera.
    """
    empty = z.new_full((camera.height * camera.width,), torch.inf)
    nearest = empty.scatter_reduce(0, place, z, reduce="amin")
    away_px = away_px.where(z <= (1 + SAME_SURFACE) * nearest[place], torch.inf)
    central = empty.scatter_reduce(0, place, away_px, reduce="amin")
    front = empty.scatter_reduce(
        0, place, z.where(away_px == central[place], torch.inf), reduce="amin"
    )
    return front.where(front.isfinite(), 0).reshape(camera.height, camera.width)


@dataclass(frozen=True, eq=False)
class _Covered:
    """Pairs of an outline and a pixel."""

    rows: Int[Tensor, " K"]
    """Of the outlines."""
    place: Int[Tensor, " K"]
    """The pixels, numbered row by row."""
    away_px: Float[Tensor, " K"]
    """Distance of their centres."""
    is_seam: Bool[Tensor, " K"]
    """The pixel is beside the outline."""


@dataclass(frozen=True, eq=False)
class _Outline:
    """Pixels of one camera as parallelograms in the image of another."""

    uv: Float[Tensor, "N 2"]
    """Their centres there."""
    right: Float[Tensor, "N 2"]
    down: Float[Tensor, "N 2"]
    """Their sides there."""
    is_point: Bool[Tensor, " N"]
    """They are so near that the sides are unknown."""

    def covered(self, camera: Camera) -> "_Covered":
        """Every pair of an outline and a pixel of ``camera``, the other one, that it covers or
        misses by less than a seam."""
        pixel = self.uv.floor()
        reach = 0.5 * (self.right.abs() + self.down.abs()) + SEAM_PX
        is_outline = ~self.is_point & (reach <= LARGEST_FOOTPRINT_PX / 2).all(dim=1)
        reach = reach * is_outline[:, None]
        area = 0.5 * _cross(self.right, self.down).abs()
        lengths = torch.stack([self.down.norm(dim=1), self.right.norm(dim=1)])
        farthest = (0, 0)
        if len(pixel):
            farthest = torch.ceil(reach - 0.5).clamp(min=0).amax(dim=0).long().tolist()
        offsets_x, offsets_y = (range(-n, n + 1) for n in farthest)
        pieces = []
        for du, dv in itertools.product(offsets_x, offsets_y):
            is_own = (du, dv) == (0, 0)
            place_px = pixel + pixel.new_tensor([du, dv])
            offset_px = place_px + 0.5 - self.uv
            over_sides = torch.stack(
                [_cross(offset_px, self.down).abs(), _cross(self.right, offset_px).abs()]
            )
            beyond = over_sides - area
            within_seam = (beyond <= SEAM_PX * lengths).all(dim=0)
            within_reach = (offset_px.abs() <= reach).all(dim=1)
            is_near = torch.ones_like(within_seam) if is_own else within_seam & within_reach
            is_near &= (place_px >= 0).all(dim=1)
            is_near &= (place_px < place_px.new_tensor([camera.width, camera.height])).all(dim=1)
            rows = is_near.nonzero()[:, 0]
            is_outside = (beyond[:, rows] > TIE * lengths[:, rows]).any(dim=0)
            is_seam = torch.zeros_like(is_outside) if is_own else is_outside
            u, v = place_px[rows].long().unbind(dim=1)
            place = v * camera.width + u
            away_px = offset_px[rows].norm(dim=1)
            pieces.append((rows, place, away_px, is_seam))
        return _Covered(*(torch.cat(parts) for parts in zip(*pieces, strict=True)))


def _cross(
    a: Float[Tensor, "N 2"],
    b: Float[Tensor, "N 2"],
) -> Float[Tensor, " N"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


class Undistorter:
    """Maps images of a camera with distortion to a pinhole camera that sees nothing outside the
    source image.

    Colour is interpolated; depth is taken from the nearest pixel, never interpolated, or warped
    into the pinhole if it is that of a second camera. ``camera`` is the pinhole; its focal length
    differs from that of the lens by a few per cent, so that there is no border without data.

    Args:
        lens: Of the colour image.
        depth_camera: Camera of the depth image, if it is another one.
        T_depth_colour: Pose of the colour camera in its frame.
    """

    def __init__(
        self,
        lens: CameraModel,
        depth_camera: Camera | None = None,
        T_depth_colour: Float[Tensor, "4 4"] | None = None,
    ):
        self.depth_camera = depth_camera
        self.camera = lens.pinhole()
        self.lens = lens
        self._u, self._v = pixel_map(lens, self.camera)
        self._T_colour_depth = (
            torch.eye(4) if T_depth_colour is None else se3.inverse(T_depth_colour)
        )

    def colour(self, rgb: np.ndarray) -> np.ndarray:
        """Colour as ``camera`` sees it, uint8. [H, W, 3]"""
        return cv2.remap(
            rgb,
            self._u,
            self._v,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )

    def depth(self, depth_m: np.ndarray) -> np.ndarray:
        """z-depth as ``camera`` sees it, metres. [H, W]"""
        if self.depth_camera is None:
            return cv2.remap(depth_m, self._u, self._v, cv2.INTER_NEAREST)
        return warp_depth(
            torch.from_numpy(depth_m), self.depth_camera, self.camera, self._T_colour_depth
        ).numpy()
