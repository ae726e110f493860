"""From a fisheye camera to a pinhole camera of half the size, as ScanNet++'s photographs need it."""

import dataclasses

import numpy as np

from ...types import Camera
from ..lens import CameraModel, pixel_map


class HalfSizePinhole:
    """Turns pictures of a fisheye lens into pinhole pictures at half the resolution.

    The pinhole sees no place that the fisheye does not, and its principal point is the image's middle, as in the
    ScanNet++ toolbox. A picture is undistorted at full size and then averaged, two by two.
    """

    def __init__(self, lens: CameraModel):
        pinhole = lens.pinhole()
        full = dataclasses.replace(pinhole, cx=pinhole.width / 2, cy=pinhole.height / 2)
        self._map = pixel_map(lens, full)
        self.camera = half_size(full)

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """The picture as ``camera`` sees it. [H, W, 3] -> [H/2, W/2, 3], uint8"""
        import cv2

        return shrink(cv2.remap(picture, *self._map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), self.camera)


def half_size(camera: Camera) -> Camera:
    """The same view on a grid of half the pixels each way."""
    return camera.resized(camera.width // 2, camera.height // 2)


def shrink(picture: np.ndarray, camera: Camera) -> np.ndarray:
    """A picture averaged down to the size of ``camera``."""
    import cv2

    return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
