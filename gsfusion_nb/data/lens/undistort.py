"""Removing lens distortion from a registered pair of colour and depth images."""

import numpy as np

from .camera_model import CameraModel, pixel_map


class Undistorter:
    """Maps image pairs of a camera with distortion to a pinhole camera that sees nothing outside the source image.

    Colour is interpolated; depth is taken from the nearest pixel, never interpolated. ``camera`` is the pinhole; its
    focal length differs from that of the lens by a few per cent, so that there is no border without data.
    """

    def __init__(self, lens: CameraModel):
        self.camera = lens.pinhole()
        self._u, self._v = pixel_map(lens, self.camera)

    def __call__(self, rgb: np.ndarray, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pair as ``camera`` sees it. Colour uint8 [H, W, 3], depth in metres [H, W]."""
        import cv2

        return self.colour(rgb), cv2.remap(depth_m, self._u, self._v, cv2.INTER_NEAREST)

    def colour(self, rgb: np.ndarray) -> np.ndarray:
        """The colour image as ``camera`` sees it, uint8. [H, W, 3]"""
        import cv2

        return cv2.remap(rgb, self._u, self._v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
