"""``gsfusion-nb check``: examine a recording before it is mapped."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from ..config import DataConfig
from ..config.options import named
from .settings import layout_names, recording_to_open


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Examine a recording: units, conventions, intrinsics, registration, times, images.

    Reports errors and the options of gsfusion-nb map that repair them; the same options can be
    given here to test them. Writes an HTML page."""

    path: Annotated[str, tyro.conf.Positional]
    """Folder of a sequence, or "room" for the built-in scene."""
    format: str = named("auto", layout_names)
    """Layout of the data."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: register=true (7-Scenes), undistort=false (TUM),
    poses=false (folder, TUM), times=false, colour_bits=12 (folder), n_frames=480 (room)."""
    data: DataConfig = field(default_factory=DataConfig)
    out: str = ""
    """Name of the HTML file. Default: check-<name>.html."""
    frames: int = 250
    """Approximate number of frames to read; a longer recording is read in windows of 31 consecutive
    frames."""


def run(options: CheckOptions) -> int:
    """The command. Exit status 1: the recording is wrong."""
    from ..recordings.checkup import check_recording

    path, reader = recording_to_open(options, options.path)
    report = check_recording(path, data=options.data, frames=options.frames, **reader)
    print(report)
    page = report.write(options.out or f"check-{report.name}.html")
    print(f"Pictures and curves: {page}")
    return 1 if report.verdict == "wrong" else 0
