"""Azure Kinect (and Orbbec's Femto through its K4A wrapper) by ``pyk4a``."""

import importlib
from typing import Any

import numpy as np

from ...checks import check_name
from ...types import Camera
from ..lens.camera_model import CameraModel
from .depth_camera import CameraLost, CameraNotFoundError, CameraTimeout, DepthCamera, RawFrame

RESOLUTIONS = ("720P", "1080P", "1440P", "1536P", "2160P", "3072P")
DEPTH_MODES = ("NFOV_2X2BINNED", "NFOV_UNBINNED", "WFOV_2X2BINNED", "WFOV_UNBINNED")


class AzureKinect(DepthCamera):
    """Frames of an Azure Kinect, depth warped into the colour camera by the driver.

    Intrinsics: those of the colour camera at its resolution; the driver puts the centre of the first pixel at 0, so 0.5
    is added to ``cx`` and ``cy``. Its lens has OpenCV's rational distortion, which is removed from both images.

    Args:
        resolution: Mode of the colour camera; "720P" is 1280x720. Resize with ``data.width``.
        depth_mode: Narrow or wide field of view, binned or not.
        fps: 5, 15 or 30; wide unbinned depth and 3072P go up to 15.
        device: Number of the camera, if several are connected.
        options: ``warm_up``, ``timeout_s``, ``undistort``, as for every ``DepthCamera``.
    """

    def __init__(
        self,
        *,
        resolution: str = "720P",
        depth_mode: str = "NFOV_UNBINNED",
        fps: int = 30,
        device: int = 0,
        **options: Any,
    ):
        super().__init__(**options)
        check_name("colour resolution", resolution, RESOLUTIONS)
        check_name("depth mode", depth_mode, DEPTH_MODES)
        if fps not in (5, 15, 30):
            raise ValueError(f"the Azure Kinect runs at 5, 15 or 30 frames/s, got {fps}")
        if fps == 30 and (resolution == "3072P" or depth_mode == "WFOV_UNBINNED"):
            raise ValueError(
                f"the Azure Kinect supports at most 15 frames/s for {resolution} colour with {depth_mode} depth, got 30"
            )
        self.name = "kinect"
        self.resolution, self.depth_mode, self.fps, self.device = resolution, depth_mode, fps, device
        self._k4a: Any = None
        self._driver: Any = None

    def _open(self) -> CameraModel:
        driver = self._driver = _driver()
        n = driver.connected_device_count()
        if self.device >= n:
            raise CameraNotFoundError(f"no Azure Kinect number {self.device}; {n} are connected")
        config = driver.Config(
            color_resolution=getattr(driver.ColorResolution, f"RES_{self.resolution}"),
            color_format=driver.ImageFormat.COLOR_BGRA32,
            depth_mode=getattr(driver.DepthMode, self.depth_mode),
            camera_fps=getattr(driver.FPS, f"FPS_{self.fps}"),
            synchronized_images_only=True,
        )
        k4a = driver.PyK4A(config, device_id=self.device)
        try:
            k4a.start()
        except driver.K4AException as e:
            raise CameraNotFoundError(
                f"Azure Kinect {self.device} cannot be started ({e}); is another program using it?"
            ) from None
        self._k4a = k4a
        K = np.asarray(k4a.calibration.get_camera_matrix(driver.CalibrationType.COLOR), dtype=float)
        distortion = k4a.calibration.get_distortion_coefficients(driver.CalibrationType.COLOR)
        width, height = _SIZES[self.resolution]
        fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5
        camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
        return CameraModel(camera, tuple(float(k) for k in distortion))

    def _shoot(self) -> RawFrame | None:
        driver = self._driver
        try:
            capture = self._k4a.get_capture(timeout=round(1000 * self.timeout_s))
            colour, depth = capture.color, capture.transformed_depth
        except driver.K4ATimeoutException:
            raise CameraTimeout from None
        except driver.K4AException as e:
            raise CameraLost(str(e) or "the driver reports a failure") from None
        if colour is None or depth is None:
            return None
        return RawFrame(
            rgb=np.ascontiguousarray(colour[..., 2::-1]),  # BGRA
            depth_m=depth.astype(np.float32) * np.float32(1e-3),
            timestamp_s=capture.color_timestamp_usec / 1e6,
        )

    def _shut(self) -> None:
        k4a, self._k4a = self._k4a, None
        if k4a is not None:
            k4a.stop()


_SIZES = {
    "720P": (1280, 720), "1080P": (1920, 1080), "1440P": (2560, 1440),
    "1536P": (2048, 1536), "2160P": (3840, 2160), "3072P": (4096, 3072),
}  # fmt: skip
"""Width and height of the colour modes, pixels (Azure Kinect DK hardware specification)."""


def _driver() -> Any:
    try:
        return importlib.import_module("pyk4a")
    except ImportError as e:
        raise CameraNotFoundError(
            f"the Azure Kinect needs the package pyk4a ({e}): pip install 'gsfusion-nb[kinect]'"
        ) from None
