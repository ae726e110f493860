"""What ``gsfusion-nb bench`` times, and on what; and a row of its table."""

import os
from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
import tyro

from ... import backends, seeding  # noqa: F401  (importing the rooms declares their operations)
from ...checks import check_name, check_whole
from ...config import DataConfig
from ...config.options import named
from ...data import OpenedSequence, open_sequence
from ...errors import ArgumentError
from ...mapping import get_system
from ...mapping.systems import SYSTEMS, system_names
from .timing import Timing

SECTIONS = {
    "raster": "Gaussian rasteriser",
    "tsdf": "integration with colour, truncation 4 voxels; raycasts",
    "map": "GSFusion, Replica settings, means over the frames; note: frames/s, number of Gaussians",
    "growth": "a building, room by room, means over the frames; note: number of Gaussians",
}
"""Section of the table -> its title."""
TIMED_BACKENDS = ("reference", "numba", "cuda")
"""Those with a rasteriser and TSDF integration."""
DEVICES = {"reference": "cpu", "numba": "cpu", "triton": "cuda", "cuda": "cuda"}
"""Device of each backend."""
_WALK = 200
"""Frames of the room's walk; more frames are closer together on the same walk."""


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure the speed of the toolkit on this machine and print a table."""

    what: Annotated[str, tyro.conf.Positional] = named(
        "all", lambda: ("all (but growth)", *SECTIONS)
    )
    """What to time: raster is the rasteriser, tsdf TSDF integration, map the whole mapper, growth
    the systems in a building of 64 rooms, a quarter of an hour for the three of this package."""
    data: str = "room"
    """Folder of the sequence used by tsdf and map, or "room" for the built-in scene."""
    size: tuple[str, ...] = ()
    """Image sizes of the sequence, for example 320x240 640x480. Default: the size of the recording,
    320x240 for the room."""
    frames: int = 0
    """Number of frames of the sequence to use. 0: 60, or 8 with --quick."""
    backend: tuple[str, ...] = named((), lambda: TIMED_BACKENDS)
    """Backends of gsfusion-nb to time. Where none is given: all that run on this machine except
    reference, which is slow because it is written for reading."""
    system: tuple[str, ...] = named(tuple(SYSTEMS), system_names)
    """Systems that growth times, also one in a file, which is executed: FILE.py:Name."""
    threads: int = 1
    """Number of threads for every method."""
    quick: bool = False
    """Run few and small cases, in one or two minutes, to test that everything works."""
    json: str = ""
    """Write all numbers to this file, as JSON."""

    @property
    def sections(self) -> tuple[str, ...]:
        """Sections to run, in order."""
        return (
            tuple(name for name in SECTIONS if name != "growth")
            if self.what == "all"
            else (self.what,)
        )

    @property
    def n_frames(self) -> int:
        """Frames to use."""
        return self.frames or (8 if self.quick else 60)

    @property
    def budget_s(self) -> float:
        """Time for repeating one measurement, seconds."""
        return 0.3 if self.quick else 1.0

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Image sizes as (width, height); (0, 0) is the recording's own."""
        if not self.size:
            return [(320, 240) if self.data == "room" else (0, 0)]
        return [_parse_size(text) for text in self.size]

    def check(self) -> None:
        """Check the options before anything is run.

        Raises:
            KeyError, ValueError, OSError: an invalid option.
        """
        check_name("bench", self.what, ("all", *SECTIONS))
        for backend in self.backend:
            check_name("backend", backend, TIMED_BACKENDS)
        for system in self.system:
            get_system(system)
        check_whole("--threads", self.threads, 1, os.cpu_count() or 1)
        check_whole("--frames", self.n_frames, 2)
        for size in self.sizes:
            if self.what != "raster":
                open_frames(self, size)


def _parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()) or min(int(width), int(height)) < 32:
        raise ArgumentError(f"--size must look like 320x240, and be at least 32x32, got {text!r}")
    return int(width), int(height)


def open_frames(options: BenchOptions, size: tuple[int, int]) -> OpenedSequence:
    """The sequence that the options ask for, without held-out frames; nothing is read yet.

    Args:
        options: Of the command.
        size: Width and height; 0: as recorded.
    """
    data = DataConfig(
        width=size[0],
        height=size[1],
        stop=options.n_frames,
        hold_out_every=0,
    )
    room: dict[str, Any] = (
        {"n_frames": max(_WALK, options.n_frames)} if options.data == "room" else {}
    )
    return open_sequence(options.data, data=data, **room)


def case_name(frames: OpenedSequence) -> str:
    """Sequence and size, short enough for the table."""
    name = frames.name if len(frames.name) <= 13 else frames.name[:12] + "~"
    return f"{name} {frames.camera.width}x{frames.camera.height}"


def our_backends(options: BenchOptions, *operations: str) -> list[str]:
    """The requested backends that can run all of ``operations`` on this machine, slow ones first.

    The reference is written for reading: it is timed only if the options name it.
    """
    working = {(name, backend) for name, backend, state in backends.report() if state == "ok"}
    usable = [b for b in backends.BACKENDS if all((name, b) in working for name in operations)]
    names = [
        b for b in usable if b in options.backend or (not options.backend and b != "reference")
    ]
    return [b for b in names if DEVICES[b] == "cpu" or torch.cuda.is_available()]


@dataclass(frozen=True, kw_only=True)
class BenchRow:
    """One line of the table."""

    section: str
    """Key of ``SECTIONS``."""
    case: str
    """The work."""
    method: str
    """The backend."""
    timing: Timing
    note: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    """Further numbers, for the JSON file."""
