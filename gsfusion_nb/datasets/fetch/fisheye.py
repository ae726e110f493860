"""From a fisheye camera to a pinhole camera of half the size, as ScanNet++'s photographs need it."""

from dataclasses import dataclass

import numpy as np

from ...types import Camera


@dataclass(frozen=True)
class Fisheye:
    """OpenCV's fisheye model: r = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""

    camera: Camera
    k: tuple[float, float, float, float]


class HalfSizePinhole:
    """Turns pictures of a fisheye lens into pinhole pictures at half the resolution.

    The pinhole sees no place that the fisheye does not (OpenCV's estimate, balance 0), and its principal point is the
    image's middle, as in the ScanNet++ toolbox. A picture is undistorted at full size and then averaged, two by two.
    """

    def __init__(self, lens: Fisheye):
        import cv2

        source = lens.camera
        K = source.K.numpy().copy()
        K[:2, 2] -= 0.5  # OpenCV puts pixel centres at integers
        k, size = np.asarray(lens.k, dtype=np.float64), (source.width, source.height)
        K_new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, k, size, np.eye(3), balance=0.0)
        K_new[:2, 2] = (source.width - 1) / 2, (source.height - 1) / 2
        self._map = cv2.fisheye.initUndistortRectifyMap(K, k, np.eye(3), K_new, size, cv2.CV_32FC1)
        full = Camera(
            width=source.width,
            height=source.height,
            fx=float(K_new[0, 0]),
            fy=float(K_new[1, 1]),
            cx=source.width / 2,
            cy=source.height / 2,
        )
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
