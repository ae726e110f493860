"""The sequence that cases work on."""

from typing import Any

from ...config import DataConfig
from ...data import OpenedSequence, open_sequence
from ...types import Frame
from ...work import run_in_processes, usable_cores
from .options import BenchOptions

_WALK = 200
"""Frames of the room's walk; more frames are closer together on the same walk."""
_JOB = 8
"""Frames that a process renders at a time; the first are rendered here, and with them what all of them share."""


class StoredFrames:
    """Decoded frames with 8-bit colour, so that reading is not timed and many frames fit into memory."""

    def __init__(self, sequence: OpenedSequence):
        self.name, self.camera = sequence.name, sequence.camera
        self._images, self._poses = [], []
        for frame in sequence:
            self._images.append((frame.rgb_u8, frame.depth_m))
            self._poses.append(frame.T_WC)

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, i: int) -> Frame:
        rgb, depth_m = self._images[i]
        return Frame(
            index=i,
            timestamp_s=float(i),
            rgb=rgb,
            depth_m=depth_m,
            camera=self.camera,
            T_WC=self._poses[i],
        )


def stored_frames(options: BenchOptions, size: tuple[int, int]) -> StoredFrames:
    """The frames selected by the options, decoded."""
    return StoredFrames(open_frames(options, size))


def open_frames(options: BenchOptions, size: tuple[int, int]) -> OpenedSequence:
    """The sequence that the options ask for, without held-out frames; nothing is read yet."""
    data = DataConfig(width=size[0], height=size[1], stop=options.n_frames, hold_out_every=0)
    walk: dict[str, Any] = {"n_frames": max(_WALK, options.n_frames)} if options.data == "room" else {}
    return open_sequence(options.data, data=data, **walk)


def render_in_advance(options: BenchOptions, size: tuple[int, int]) -> None:
    """Render those frames of the room that are not in its cache, in as many processes as cores; of other sequences
    nothing, because there reading is timed."""
    if options.data != "room":
        return
    n = options.n_frames
    _render(options, size, 0, min(_JOB, n))
    jobs = [(options, size, first, min(first + _JOB, n)) for first in range(_JOB, n, _JOB)]
    for _ in run_in_processes(_render, jobs, [frozenset()] * len(jobs), usable_cores()):
        pass


def _render(options: BenchOptions, size: tuple[int, int], first: int, stop: int) -> None:
    frames = open_frames(options, size)
    for i in range(first, stop):
        frames[i]


def case_name(name: str, width: int, height: int) -> str:
    """Sequence and size, short enough for the table."""
    return f"{name if len(name) <= 13 else name[:12] + '~'} {width}x{height}"
