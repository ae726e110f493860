"""A stand-in for ``pyrealsense2`` with the part of its API that is used, replaying given pictures.

``plan`` lists what each wait gives: a number (that picture), "timeout", "no depth", "no colour", or
"unplug".
"""

import types
from typing import Any

import numpy as np


class Replay:
    """What the device behind the driver does."""

    def __init__(
        self,
        pictures,
        plan,
        *,
        K,
        size,
        coeffs=(0.0,) * 8,
    ):
        self.pictures = pictures
        self.plan = list(plan)
        self.K = K
        self.size = size
        self.coeffs = coeffs
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
        self._array = array
        self._milliseconds = milliseconds

    def get_data(self):
        return self._array

    def get_timestamp(self):
        return self._milliseconds


class _Frames:
    def __init__(self, colour, depth):
        self.colour = colour
        self.depth = depth

    def get_color_frame(self):
        return self.colour

    def get_depth_frame(self):
        return self.depth

    def as_frameset(self):
        return self


def realsense(replay: Replay, *, scale=0.001, model="distortion.inverse_brown_conrady"):
    """A module like pyrealsense2."""
    rs = types.SimpleNamespace()
    rs.stream = types.SimpleNamespace(color="color", depth="depth")
    rs.format = types.SimpleNamespace(rgb8="rgb8", z16="z16")

    class Config:
        def enable_device(self, serial):
            if serial != "123":
                raise_later.append(serial)
            replay.log.append(("device", serial))

        def enable_stream(self, stream, width, height, kind, fps):
            if (width, height) != replay.size:
                raise_later.append((width, height))
            replay.log.append((stream, width, height, kind, fps))

    raise_later: list = []

    class Pipeline:
        def start(self, config):
            if raise_later:
                raise RuntimeError("Couldn't resolve requests")
            replay.running = True
            K = replay.K
            width, height = replay.size
            intrinsics = types.SimpleNamespace(
                width=width,
                height=height,
                fx=K[0],
                fy=K[1],
                ppx=K[2],
                ppy=K[3],
                model=model,
                coeffs=replay.coeffs[:5],
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
                None if entry == "no colour" else _Data(rgb, at),
                None if entry == "no depth" else _Data(depth, at),
            )

        def stop(self):
            replay.running = False
            replay.log.append("stopped")
            if not replay.connected:
                raise RuntimeError("stop() cannot be called before start()")

    class Align:
        def __init__(self, stream):
            assert stream == "color"

        def process(self, frames):
            return frames

    rs.config = Config
    rs.pipeline = Pipeline
    rs.align = Align
    return rs
