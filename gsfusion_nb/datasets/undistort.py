"""Removing lens distortion from a registered pair of colour and depth images."""

from dataclasses import dataclass

import numpy as np

from ..types import Camera


@dataclass(frozen=True)
class Lens:
    """A pinhole camera with the distortion of Brown's model, k1 k2 p1 p2 k3 in OpenCV's order."""

    camera: Camera
    distortion: tuple[float, ...] = ()


class Undistorter:
    """Maps image pairs of a lens onto a pinhole camera that sees nothing outside the source image.

    Colour is interpolated; depth is taken from the nearest pixel, never interpolated. ``camera`` is the pinhole; its
    focal length differs from the lens's by a few per cent, chosen so that there is no border without data.
    """

    def __init__(self, lens: Lens):
        import cv2

        source = lens.camera
        K = source.K.numpy().copy()
        K[:2, 2] -= 0.5  # OpenCV puts pixel centres at integers
        D = np.asarray(lens.distortion, dtype=np.float64)
        size = (source.width, source.height)
        K_new, _ = cv2.getOptimalNewCameraMatrix(K, D, size, 0.0)
        self._u, self._v = cv2.initUndistortRectifyMap(K, D, np.eye(3), K_new, size, cv2.CV_32FC1)
        self.camera = Camera(
            width=source.width,
            height=source.height,
            fx=float(K_new[0, 0]),
            fy=float(K_new[1, 1]),
            cx=float(K_new[0, 2]) + 0.5,
            cy=float(K_new[1, 2]) + 0.5,
        )

    def __call__(self, rgb: np.ndarray, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pair as ``camera`` sees it. Colour uint8 [H, W, 3], depth in metres [H, W]."""
        import cv2

        return self.colour(rgb), cv2.remap(depth_m, self._u, self._v, cv2.INTER_NEAREST)

    def colour(self, rgb: np.ndarray) -> np.ndarray:
        """The colour image as ``camera`` sees it, uint8. [H, W, 3]"""
        import cv2

        return cv2.remap(rgb, self._u, self._v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
