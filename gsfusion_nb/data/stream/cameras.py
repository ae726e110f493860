"""A depth camera as a live source: Intel RealSense."""

import importlib
import logging
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from ...errors import SequenceError, SequenceNotFoundError
from ...types import Camera, Frame
from ..lens import CameraModel, Undistorter
from .frame_queue import LiveSource

log = logging.getLogger(__name__)

MAX_TIMEOUTS = 5
"""After this many timeouts in a row the camera counts as lost."""
_BROWN_CONRADY = ("brown_conrady", "inverse_brown_conrady", "modified_brown_conrady")


class CameraNotFoundError(SequenceNotFoundError):
    """No such camera is connected, or its driver is not installed."""


class RealSense(LiveSource):
    """Frames of a RealSense camera, depth aligned to colour by the driver. Poses must be tracked.

    Iterating starts the camera; at the end, or when the iteration is aborted, the camera is
    switched off. Frames without colour or depth are left out. A camera that is unplugged, or sends
    nothing for ``MAX_TIMEOUTS`` waits, ends the iteration; ``broke_off`` then says why.

    Intrinsics: those of the colour stream; librealsense puts the centre of the first pixel at 0, so
    0.5 is added to ``cx`` and ``cy``. Distortion: current drivers align and deproject "inverse" and
    plain Brown-Conrady alike by OpenCV's forward model (librealsense issue 13824); it is removed
    from both images.

    Args:
        width, height: Size of both streams, pixels; the camera must offer it.
        fps: Frames per second of both streams.
        serial: Serial number, if several cameras are connected.
        warm_up: Frames to discard at the start, until exposure and white balance are stable.
        timeout_s: How long to wait for a frame, seconds.

    Raises:
        CameraNotFoundError: while iterating, no such camera is connected, or its driver is not
            installed.
    """

    name = "realsense"

    def __init__(
        self,
        *,
        width: int = 640,
        height: int = 480,
        fps: int = 30,
        serial: str = "",
        warm_up: int = 30,
        timeout_s: float | int = 2.0,
    ):
        self.width = width
        self.height = height
        self.fps = fps
        self.serial = serial
        self.warm_up = warm_up
        self.timeout_s = timeout_s
        self.camera: Camera | None = None
        """Camera of the frames; known once the device is started."""
        self._stopping = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        self._stopping.clear()
        self.broke_off = ""
        pipeline, profile = self._started()
        try:
            lens = _lens(
                profile.get_stream(self._rs.stream.color).as_video_stream_profile().get_intrinsics()
            )
            undistorter = Undistorter(lens) if any(abs(k) > 1e-9 for k in lens.distortion) else None
            self.camera = lens.camera if undistorter is None else undistorter.camera
            depth_scale = np.float32(profile.get_device().first_depth_sensor().get_depth_scale())
            index = -self.warm_up
            for colour, depth in self._pairs(pipeline):
                if index >= 0:
                    rgb = np.asanyarray(colour.get_data()).copy()
                    depth_m = np.asanyarray(depth.get_data()).astype(np.float32) * depth_scale
                    if undistorter is not None:
                        rgb = undistorter.colour(rgb)
                        depth_m = undistorter.depth(depth_m)
                    yield Frame(
                        index=index,
                        timestamp_s=colour.get_timestamp() / 1000.0,
                        rgb=torch.from_numpy(np.ascontiguousarray(rgb)),
                        depth_m=torch.from_numpy(np.ascontiguousarray(depth_m)),
                        camera=self.camera,
                        T_WC=torch.eye(4),
                    )
                index += 1
        finally:
            try:
                pipeline.stop()
            except Exception as e:  # a device that was unplugged cannot be switched off
                log.info("%s could not be switched off: %s", self.name, e)

    def stop(self) -> None:
        """End the iteration after the next frame."""
        self._stopping.set()

    def _started(self) -> tuple[Any, Any]:
        """The driver's running pipeline, and that pipeline's profile."""
        try:
            rs = self._rs = importlib.import_module("pyrealsense2")
        except ImportError as e:
            raise CameraNotFoundError(
                f"this camera needs the package pyrealsense2 ({e}): pip install "
                "'gsfusion-nb[realsense]'"
            ) from None
        config = rs.config()
        pipeline = rs.pipeline()
        if self.serial:
            config.enable_device(self.serial)
        config.enable_stream(
            rs.stream.color,
            self.width,
            self.height,
            rs.format.rgb8,
            self.fps,
        )
        config.enable_stream(
            rs.stream.depth,
            self.width,
            self.height,
            rs.format.z16,
            self.fps,
        )
        try:
            return pipeline, pipeline.start(config)
        except RuntimeError as e:
            raise CameraNotFoundError(
                f"no RealSense camera {self.serial} streams {self.width}x{self.height} at "
                f"{self.fps} fps ({e}); expected one on a USB 3 port"
            ) from None

    def _pairs(self, pipeline: Any) -> Iterator[tuple[Any, Any]]:
        """The driver's colour and depth frames, until the camera is stopped or lost."""
        align = self._rs.align(self._rs.stream.color)
        silent = 0
        while not self._stopping.is_set() and not self.broke_off:
            try:
                frames = align.process(pipeline.wait_for_frames(round(1000 * self.timeout_s)))
                silent = 0
                colour = frames.get_color_frame()
                depth = frames.get_depth_frame()
                if colour and depth:
                    yield colour, depth
            except RuntimeError as e:  # the driver uses one exception class for all errors
                silent += 1
                if "didn't arrive" not in str(e):
                    self.broke_off = f"{self.name} was disconnected: {e}"
                elif silent >= MAX_TIMEOUTS:
                    self.broke_off = f"{self.name} gave no frame for {silent * self.timeout_s:g} s"
        if self.broke_off:
            log.warning(self.broke_off)


def _lens(intrinsics: Any) -> CameraModel:
    camera = Camera(
        width=int(intrinsics.width),
        height=int(intrinsics.height),
        fx=float(intrinsics.fx),
        fy=float(intrinsics.fy),
        cx=float(intrinsics.ppx) + 0.5,
        cy=float(intrinsics.ppy) + 0.5,
    )
    distortion = tuple(float(k) for k in intrinsics.coeffs)
    model = str(intrinsics.model).rsplit(".", 1)[-1].lower()
    if any(distortion) and model not in _BROWN_CONRADY:
        raise SequenceError(
            f"the RealSense colour camera has distortion {model!r}; expected a Brown-Conrady lens"
        )
    return CameraModel(camera, distortion)
