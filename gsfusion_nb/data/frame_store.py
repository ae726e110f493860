"""Frames that are kept when they are read, within a limit of memory, for whoever reads them
again."""

import contextlib
import dataclasses
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager

from ..types import Frame


class FrameStore:
    """Frames of a sequence by position, as they were read: colour as bytes if it has eight bits,
    without ``extra``.

    Which frames are kept when the memory is full: first those that are ``wanted``, then those that
    came first.

    Args:
        limit_bytes: Of all images that are kept.
        clock: Gives a context in which a frame is read, such as a stage of a clock.
    """

    def __init__(
        self,
        limit_bytes: int,
        clock: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        self.limit_bytes = limit_bytes
        self.timed = clock
        self.wanted: frozenset[int] = frozenset()
        """Positions of frames that will be read again for certain."""
        self.n_bytes = 0
        """Of the images that are kept."""
        self._frames: dict[int, Frame] = {}
        self._lock = threading.Lock()  # frames are read in advance on another thread

    def __len__(self) -> int:
        return len(self._frames)

    def get(self, position: int) -> Frame | None:
        """The frame at a position, if it is kept: a new object, whose colour as floats is not kept
        with it."""
        with self._lock:
            frame = self._frames.get(position)
        return None if frame is None else dataclasses.replace(frame)

    def add(self, position: int, frame: Frame) -> None:
        """Keep a copy of a frame that was read, if there is room, or room can be made for a wanted
        one."""
        size = frame.colour.nbytes + frame.depth_m.nbytes
        with self._lock:
            if position in self._frames or not self._make_room(size, position in self.wanted):
                return
            images = {name: getattr(frame, name).clone() for name in ("colour", "depth_m", "T_WC")}
            self._frames[position] = dataclasses.replace(frame, **images, extra={})
            self.n_bytes += size

    def clear(self) -> None:
        """Keep nothing more: no frame will be read again."""
        with self._lock:
            self._frames.clear()
            self.n_bytes = 0
            self.limit_bytes = 0

    def _make_room(self, size: int, is_wanted: bool) -> bool:
        others = [p for p in self._frames if p not in self.wanted] if is_wanted else []
        while self.n_bytes + size > self.limit_bytes:
            if not others or size > self.limit_bytes:
                return False
            frame = self._frames.pop(others.pop())
            self.n_bytes -= frame.colour.nbytes + frame.depth_m.nbytes
        return True
