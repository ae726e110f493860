"""Intel RealSense cameras (D400 series, L515) through ``pyrealsense2``."""

import importlib
from typing import Any

import numpy as np

from ...checks import check_name
from ...types import Camera
from ..lens.camera_model import CameraModel
from ..sequence import SequenceError
from .depth_camera import CameraLost, CameraNotFoundError, CameraTimeout, DepthCamera, RawFrame

FILTERS = ("decimation", "threshold", "spatial", "temporal", "hole_filling")
"""In the order in which the driver's documentation applies them."""

_BROWN_CONRADY = ("brown_conrady", "inverse_brown_conrady", "modified_brown_conrady")


class RealSense(DepthCamera):
    """Frames of a RealSense camera, depth aligned to colour by the driver.

    Intrinsics: those of the colour stream; librealsense puts the centre of the first pixel at 0, so 0.5 is added to
    ``cx`` and ``cy``. Distortion: current drivers align and deproject "inverse" and plain Brown-Conrady alike by
    OpenCV's forward model (librealsense issue 13824), and so does this.

    Args:
        width, height: Size of both streams, pixels; the camera must offer it.
        fps: Frames per second of both streams.
        serial: Serial number, if several cameras are connected.
        filters: The driver's filters of depth, any of ``FILTERS``. None by default: the temporal one blurs the depth of
            a moving camera, and hole filling adds surfaces that do not exist.
        options: ``warm_up``, ``timeout_s``, ``undistort``, as for every ``DepthCamera``.
    """

    def __init__(
        self,
        *,
        width: int = 640,
        height: int = 480,
        fps: int = 30,
        serial: str = "",
        filters: tuple[str, ...] = (),
        **options: Any,
    ):
        super().__init__(**options)
        for name in filters:
            check_name("RealSense filter", name, FILTERS)
        self.name = "realsense"
        self.width, self.height, self.fps, self.serial, self.filters = width, height, fps, serial, filters
        self._rs: Any = None
        self._pipeline: Any = None
        self._context: Any = None

    def _open(self) -> CameraModel:
        rs = self._rs = _driver()
        self._context = rs.context()
        serials = self._serials()
        if not serials or (self.serial and self.serial not in serials):
            wanted = f"with serial number {self.serial}; connected: {', '.join(serials) or 'none'}"
            raise CameraNotFoundError(
                f"no RealSense camera {wanted if self.serial else 'is connected; expected one on a USB 3 port'}"
            )
        self.serial = self.serial or serials[0]
        config, pipeline = rs.config(), rs.pipeline(self._context)
        config.enable_device(self.serial)
        config.enable_stream(rs.stream.color, self.width, self.height, rs.format.rgb8, self.fps)
        config.enable_stream(rs.stream.depth, self.width, self.height, rs.format.z16, self.fps)
        try:
            profile = pipeline.start(config)
        except RuntimeError as e:
            raise CameraNotFoundError(
                f"RealSense camera {self.serial} cannot stream {self.width}x{self.height} at {self.fps} fps: {e}"
            ) from None
        self._pipeline = pipeline
        self._depth_scale = float(profile.get_device().first_depth_sensor().get_depth_scale())
        self._align = rs.align(rs.stream.color)
        self._filters = self._make_filters()
        return _lens(profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics())

    def _shoot(self) -> RawFrame | None:
        try:
            frames = self._pipeline.wait_for_frames(round(1000 * self.timeout_s))
            for each in self._filters:
                frames = each.process(frames).as_frameset()
            frames = self._align.process(frames)
            colour, depth = frames.get_color_frame(), frames.get_depth_frame()
            if not colour or not depth:
                return None
            return RawFrame(
                rgb=np.asanyarray(colour.get_data()).copy(),
                depth_m=np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(self._depth_scale),
                timestamp_s=colour.get_timestamp() / 1000.0,
            )
        except RuntimeError as e:  # the driver uses one exception class for all errors
            if self.serial not in self._serials():
                raise CameraLost(str(e)) from None
            if "didn't arrive" in str(e):
                raise CameraTimeout from None
            raise CameraLost(str(e)) from None

    def _shut(self) -> None:
        pipeline, self._pipeline = self._pipeline, None
        if pipeline is not None:
            pipeline.stop()

    def _serials(self) -> list[str]:
        """Serial numbers of the cameras that are connected now."""
        return [d.get_info(self._rs.camera_info.serial_number) for d in self._context.query_devices()]

    def _make_filters(self) -> list[Any]:
        """The driver's filters in its order; spatial and temporal work on disparity."""
        rs = self._rs
        chosen = {name: getattr(rs, f"{name}_filter")() for name in FILTERS if name in self.filters}
        middle = [chosen[name] for name in ("spatial", "temporal") if name in chosen]
        if middle:
            middle = [rs.disparity_transform(True), *middle, rs.disparity_transform(False)]
        first = [chosen[name] for name in ("decimation", "threshold") if name in chosen]
        last = [chosen["hole_filling"]] if "hole_filling" in chosen else []
        return [*first, *middle, *last]


def _driver() -> Any:
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as e:
        raise CameraNotFoundError(
            f"RealSense cameras need the package pyrealsense2 ({e}): pip install 'gsfusion-nb[realsense]'"
        ) from None


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
        raise SequenceError(f"the RealSense colour camera has distortion {model!r}; expected a Brown-Conrady lens")
    return CameraModel(camera, distortion)
