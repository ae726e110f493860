"""Cameras with lens distortion, and removing it."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import ArgumentError, SequenceError
from ..geometry import se3
from ..geometry.operands import check_plausible_camera
from ..types import Camera
from .depth_registration import warp_depth

SAME_PX = 0.05
"""Two cameras whose rays meet the image border within this distance, in pixels, count as equal."""


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
