"""Depth cameras: Intel RealSense, Azure Kinect, and what they share: warm-up, timeouts, disconnection, undistortion."""

import abc
import importlib
import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ...checks import check_name
from ...types import Camera, Frame
from ..lens import CameraModel, Undistorter
from ..sequence import SequenceError, SequenceNotFoundError
from .frame_queue import LiveSource

log = logging.getLogger(__name__)

MAX_TIMEOUTS = 5
"""After this many timeouts in a row the camera counts as lost."""


class CameraNotFoundError(SequenceNotFoundError):
    """No such camera is connected, or its driver is not installed."""


class CameraTimeout(Exception):
    """No frame came in time."""


class CameraLost(Exception):
    """The camera no longer answers."""


@dataclass(frozen=True, eq=False)
class RawFrame:
    """Images of a camera at one time: colour uint8 RGB [H, W, 3]; depth in metres, 0 missing, float32 [H, W]."""

    rgb: np.ndarray
    depth_m: np.ndarray
    timestamp_s: float


class DepthCamera(LiveSource):
    """A depth camera; subclasses implement its driver in ``_open``, ``_shoot`` and ``_shut``. Poses must be tracked.

    Iterating starts the camera; at the end, or when the iteration is aborted, the camera is switched off. Frames
    without colour or depth are left out and counted. A camera that is unplugged, or sends nothing for ``MAX_TIMEOUTS``
    waits, ends the iteration; ``broke_off`` then says why.

    Args:
        warm_up: Frames to discard at the start, until exposure and white balance are stable.
        timeout_s: How long to wait for a frame, seconds.
        undistort: Remove the lens distortion of the colour camera from both images.
    """

    has_poses = False

    def __init__(self, *, warm_up: int = 30, timeout_s: float | int = 2.0, undistort: bool = True):
        self.warm_up, self.timeout_s, self.undistort = warm_up, timeout_s, undistort
        self.camera: Camera | None = None
        """Camera of the frames; known once the device is started."""
        self.n_incomplete = 0
        """Frames that came without colour or without depth."""
        self.n_timeouts = 0
        """Waits without a frame."""
        self._stopping = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        self._stopping.clear()
        self.broke_off = ""
        try:
            lens = self._open()
            undistorter = Undistorter(lens) if self.undistort and any(abs(k) > 1e-9 for k in lens.distortion) else None
            self.camera = lens.camera if undistorter is None else undistorter.camera
            for index, shot in enumerate(self._raw_frames()):
                yield self._frame(index, shot, undistorter)
        finally:
            self._switch_off()

    def stop(self) -> None:
        """End the iteration after the next frame."""
        self._stopping.set()

    def _raw_frames(self) -> Iterator[RawFrame]:
        """Images after the warm-up, until the camera is stopped or lost."""
        seen = silent = 0
        while not self._stopping.is_set():
            try:
                shot = self._shoot()
            except CameraTimeout:
                silent += 1
                self.n_timeouts += 1
                if silent >= MAX_TIMEOUTS:
                    self._lose(f"{self.name} gave no frame for {silent * self.timeout_s:g} s")
                    return
                continue
            except CameraLost as e:
                self._lose(f"{self.name} was disconnected: {e}")
                return
            silent = 0
            if shot is None:
                self.n_incomplete += 1
                continue
            seen += 1
            if seen > self.warm_up:
                yield shot

    def _frame(self, index: int, shot: RawFrame, undistorter: Undistorter | None) -> Frame:
        assert self.camera is not None
        rgb, depth_m = (shot.rgb, shot.depth_m) if undistorter is None else undistorter(shot.rgb, shot.depth_m)
        if rgb.shape[:2] != depth_m.shape:
            raise SequenceError(
                f"{self.name} gave colour of {rgb.shape[1]}x{rgb.shape[0]} and depth of "
                f"{depth_m.shape[1]}x{depth_m.shape[0]}; expected depth aligned to colour"
            )
        return Frame(
            index=index,
            timestamp_s=shot.timestamp_s,
            rgb=torch.from_numpy(np.ascontiguousarray(rgb)),
            depth_m=torch.from_numpy(np.ascontiguousarray(depth_m)),
            camera=self.camera,
            T_WC=torch.eye(4),
        )

    def _lose(self, sentence: str) -> None:
        self.broke_off = sentence
        log.warning(sentence)

    def _switch_off(self) -> None:
        try:
            self._shut()
        except Exception as e:  # a device that was unplugged cannot be switched off
            log.info("%s could not be switched off: %s", self.name, e)

    @abc.abstractmethod
    def _open(self) -> CameraModel:
        """Start the device; the colour camera that depth is aligned to, pixel centres at (i + 0.5, j + 0.5).

        Raises:
            CameraNotFoundError: it is not connected, or its driver is not installed.
        """

    @abc.abstractmethod
    def _shoot(self) -> RawFrame | None:
        """The next images; None if colour or depth is missing.

        Raises:
            CameraTimeout: none within ``timeout_s``. CameraLost: the device was disconnected.
        """

    @abc.abstractmethod
    def _shut(self) -> None:
        """Switch the device off, if it is on."""


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
        rs = self._rs = _driver("pyrealsense2", "realsense")
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


def _driver(package: str, extra: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as e:
        raise CameraNotFoundError(
            f"this camera needs the package {package} ({e}): pip install 'gsfusion-nb[{extra}]'"
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
        driver = self._driver = _driver("pyk4a", "kinect")
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
