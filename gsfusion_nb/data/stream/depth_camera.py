"""Shared code of all depth cameras: warm-up, timeouts, disconnection, undistortion, frames."""

import abc
import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ...types import Camera, Frame
from ..lens.camera_model import CameraModel
from ..lens.undistort import Undistorter
from ..sequence import SequenceError, SequenceNotFoundError
from .live_source import LiveSource

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
