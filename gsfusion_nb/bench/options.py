"""What ``gsfusion-nb bench`` can be asked for."""

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..backends import BACKENDS
from ..checks import check_name

SECTIONS = ("raster", "tsdf", "map", "panels", "waits")


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Time the toolkit on this machine, beside other programs where they are installed, and print one table."""

    what: Annotated[str, tyro.conf.Positional] = "all"
    """raster, tsdf, map, panels, waits or all."""
    data: str = "room"
    """Folder of the sequence for tsdf, map and the check-up in waits, or "room" for the built-in scene."""
    size: tuple[str, ...] = ()
    """Image sizes for these, such as 320x240 640x480; those of the recording by default, 320x240 for the room."""
    frames: int = 0
    """Frames of the sequence to use; 0 means 60, or 8 with --quick."""
    backend: tuple[str, ...] = ()
    """Only these of our backends: reference, torch, numba, triton, cuda. By default all that run here but the
    reference, which is written for reading and slow."""
    threads: int = 1
    """Threads that every method may use."""
    quick: bool = False
    """Few cases, small ones: under a minute or two, to see that everything works."""
    scaling: bool = False
    """Also show how the cost grows with Gaussians, pixels and voxels."""
    json: str = ""
    """File to write all numbers to."""
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
        """Time to spend on repeating one measurement, seconds."""
        return 0.3 if self.quick else 1.0

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Image sizes as (width, height); (0, 0) is the recording's own."""
        if not self.size:
            return [(320, 240) if self.data == "room" else (0, 0)]
        return [_parse_size(text) for text in self.size]

    def check(self) -> None:
        """Refuse what cannot be run, before anything takes time.

        Raises:
            KeyError, ValueError, OSError: with a sentence.
        """
        check_name("bench", self.what, ("all", *SECTIONS))
        for backend in self.backend:
            check_name("backend", backend, BACKENDS)
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
