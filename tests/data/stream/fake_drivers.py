"""Stand-ins for ``pyrealsense2`` and ``pyk4a`` with the part of their API that is used, replaying given pictures.

``plan`` lists what each wait gives: a number (that picture), "timeout", "no depth", "no colour", or "unplug".
"""

import types
from typing import Any

import numpy as np


class Replay:
    """What the device behind both drivers does."""

    def __init__(self, pictures, plan, *, K, size, coeffs=(0.0,) * 8):
        self.pictures, self.plan, self.K, self.size, self.coeffs = pictures, list(plan), K, size, coeffs
        self.connected = True
        self.running = False
        self.log: list[Any] = []
        self.n = 0

    def next(self):
        """The next entry of the plan with its pictures; the last is repeated."""
        assert self.running, "the camera was asked for a frame while it was off"
        entry = self.plan.pop(0) if len(self.plan) > 1 else self.plan[0]
        self.n += 1
        if entry == "unplug":
            self.connected = False
        if entry in ("unplug", "timeout"):
            return entry, None, None
        rgb, depth_m = self.pictures[entry if isinstance(entry, int) else 0]
        return entry, rgb, depth_m


class _Data:
    def __init__(self, array, milliseconds):
        self._array, self._milliseconds = array, milliseconds

    def get_data(self):
        return self._array

    def get_timestamp(self):
        return self._milliseconds


class _Frames:
    def __init__(self, colour, depth):
        self.colour, self.depth = colour, depth

    def get_color_frame(self):
        return self.colour

    def get_depth_frame(self):
        return self.depth

    def as_frameset(self):
        return self


def realsense(replay: Replay, *, scale=0.001, model="distortion.inverse_brown_conrady", serials=("123",)):
    """A module like pyrealsense2."""
    rs = types.SimpleNamespace()
    rs.camera_info = types.SimpleNamespace(serial_number="serial")
    rs.stream = types.SimpleNamespace(color="color", depth="depth")
    rs.format = types.SimpleNamespace(rgb8="rgb8", z16="z16")

    class Context:
        def query_devices(self):
            known = serials if replay.connected else ()
            return [types.SimpleNamespace(get_info=lambda what, s=s: s) for s in known]

    class Config:
        def enable_device(self, serial):
            replay.log.append(("device", serial))

        def enable_stream(self, stream, width, height, kind, fps):
            if (width, height) != replay.size:
                raise_later.append((width, height))
            replay.log.append((stream, width, height, kind, fps))

    raise_later: list = []

    class Pipeline:
        def __init__(self, context):
            pass

        def start(self, config):
            if raise_later:
                raise RuntimeError("Couldn't resolve requests")
            replay.running = True
            K, (width, height) = replay.K, replay.size
            intrinsics = types.SimpleNamespace(
                width=width, height=height, fx=K[0], fy=K[1], ppx=K[2], ppy=K[3], model=model, coeffs=replay.coeffs[:5]
            )
            video = types.SimpleNamespace(get_intrinsics=lambda: intrinsics)
            stream = types.SimpleNamespace(as_video_stream_profile=lambda: video)
            sensor = types.SimpleNamespace(get_depth_scale=lambda: scale)
            device = types.SimpleNamespace(first_depth_sensor=lambda: sensor)
            return types.SimpleNamespace(get_device=lambda: device, get_stream=lambda which: stream)

        def wait_for_frames(self, timeout_ms):
            entry, rgb, depth_m = replay.next()
            if entry == "timeout":
                raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
            if entry == "unplug":
                raise RuntimeError("Device disconnected. Failed to reconnect: No device connected")
            assert rgb is not None
            assert depth_m is not None
            at = 1000.0 + replay.n * 1000 / 30
            depth = np.rint(depth_m / scale).astype(np.uint16)
            return _Frames(
                None if entry == "no colour" else _Data(rgb, at), None if entry == "no depth" else _Data(depth, at)
            )

        def stop(self):
            replay.running = False
            replay.log.append("stopped")
            if not replay.connected:
                raise RuntimeError("stop() cannot be called before start()")

    class Step:
        def __init__(self, name, *args):
            self.name = (name, *args) if args else name

        def process(self, frames):
            replay.log.append(self.name)
            return frames

    rs.context, rs.config, rs.pipeline = Context, Config, Pipeline
    rs.align = lambda stream: Step("align", stream)
    rs.disparity_transform = lambda to: Step("disparity", to)
    for name in ("decimation", "threshold", "spatial", "temporal", "hole_filling"):
        setattr(rs, f"{name}_filter", lambda name=name: Step(name))
    return rs


class _Names:
    """Any attribute is its own name."""

    def __getattr__(self, name):
        return name


def kinect(replay: Replay, *, busy=False):
    """A module like pyk4a."""
    k4a = types.SimpleNamespace()

    class K4AException(Exception):
        pass

    class K4ATimeoutException(K4AException):
        pass

    class Calibration:
        def get_camera_matrix(self, which):
            assert which == "COLOR"
            fx, fy, cx, cy = replay.K
            return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

        def get_distortion_coefficients(self, which):
            assert which == "COLOR"
            return np.array(replay.coeffs)

    class PyK4A:
        calibration = Calibration()

        def __init__(self, config, device_id):
            replay.log.append((config, device_id))

        def start(self):
            if busy:
                raise K4AException("device is open elsewhere")
            replay.running = True

        def stop(self):
            replay.running = False
            replay.log.append("stopped")

        def get_capture(self, timeout):
            entry, rgb, depth_m = replay.next()
            if entry == "timeout":
                raise K4ATimeoutException
            if entry == "unplug":
                raise K4AException
            assert rgb is not None
            assert depth_m is not None
            bgra = np.dstack([rgb[..., ::-1], np.full(rgb.shape[:2], 255, np.uint8)])
            return types.SimpleNamespace(
                color=None if entry == "no colour" else bgra,
                transformed_depth=None if entry == "no depth" else np.rint(depth_m * 1000).astype(np.uint16),
                color_timestamp_usec=1_000_000 + replay.n * 1_000_000 // 30,
            )

    k4a.K4AException, k4a.K4ATimeoutException, k4a.PyK4A = K4AException, K4ATimeoutException, PyK4A
    k4a.ColorResolution = k4a.DepthMode = k4a.FPS = k4a.ImageFormat = k4a.CalibrationType = _Names()
    k4a.Config = lambda **options: options
    k4a.connected_device_count = lambda: 1 if replay.connected else 0
    return k4a
