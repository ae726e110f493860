"""Options of ``gsfusion-nb bench``."""

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ...checks import check_name

TIMED_BACKENDS = ("reference", "torch", "numba", "cuda")
"""Those with a rasteriser and TSDF integration."""

SECTIONS = ("raster", "tsdf", "map", "panels", "latency", "checkpoints")


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure the speed of the toolkit on this machine, compared with other installed programs, and print a table."""

    what: Annotated[str, tyro.conf.Positional] = "all"
    """What to time: raster (rasteriser), tsdf (TSDF integration), map (whole mapper), panels (notebook panels),
    latency (import, recording check, landmarks, search for similar keyframes), checkpoints (time and size of one, and
    time from SIGTERM until it is saved) or all."""
    data: str = "room"
    """Folder of the sequence used by tsdf, map, latency and checkpoints, or "room" for the built-in scene."""
    size: tuple[str, ...] = ()
    """Image sizes of the sequence, for example 320x240 640x480. Default: the size of the recording, 320x240 for the
    room."""
    frames: int = 0
    """Number of frames of the sequence to use. 0: 60, or 8 with --quick."""
    backend: tuple[str, ...] = ()
    """Backends of gsfusion-nb to time: reference, torch, numba, cuda. Default: all that run on this machine except
    reference, which is slow because it is written for reading."""
    threads: int = 1
    """Number of threads for every method."""
    quick: bool = False
    """Run few and small cases, in one or two minutes, to test that everything works."""
    scaling: bool = False
    """Also measure how the time grows with the number of Gaussians, pixels and voxels."""
    json: str = ""
    """Write all numbers to this file, as JSON."""
    markdown: bool = False
    """Print the table as Markdown."""

    @property
    def sections(self) -> tuple[str, ...]:
        """Sections to run, in order."""
        return SECTIONS if self.what == "all" else (self.what,)

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
        cores = os.cpu_count() or 1
        if not 1 <= self.threads <= cores:
            raise ValueError(f"--threads must be between 1 and {cores}, the cores of this machine, got {self.threads}")
        if self.frames < 0 or self.frames == 1:
            raise ValueError(f"--frames must be at least 2 (or 0 for the default), got {self.frames}")
        for width, height in self.sizes:
            if width and min(width, height) < 32:
                raise ValueError(f"--size must be at least 32x32, got {width}x{height}")
        if self.json:
            folder = Path(self.json).expanduser().parent
            if not folder.is_dir():
                raise ValueError(f"--json: {folder} is not a folder, so {Path(self.json).name} cannot be written there")
            if Path(self.json).expanduser().is_dir():
                raise ValueError(f"--json: {self.json} is a folder; expected the name of a file")

    def as_dict(self) -> dict:
        """For the JSON file."""
        return dataclasses.asdict(self)


def _parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise ValueError(f"--size must look like 320x240, got {text!r}")
    return int(width), int(height)
