"""``gsfusion-nb locate``: the poses of another recording in the map of a run."""

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..backends import backend_names, from_environment, use_backend
from ..config.options import named
from .result import print_metrics
from .settings import layout_names, recording_to_open, system_names

if TYPE_CHECKING:
    from ..runs import LocatedRecording


@dataclass(frozen=True, kw_only=True)
class LocateOptions:
    """Find each frame of a recording in the map of an earlier run, which stays as it is. The
    recording needs no poses and no times, and may begin anywhere in the map.

    Writes trajectory.txt with the poses of the frames that were found, metrics.json and a report
    with pictures. A frame that cannot be found has no pose.
    """

    run: Annotated[str, tyro.conf.Positional]
    """Folder of the run with the map."""
    data: Annotated[str, tyro.conf.Positional]
    """Folder of the recording, or "room" for the built-in scene."""
    out: str = ""
    """New or empty folder for the results; runs/located-<name>-<time> by default."""
    format: str = named("auto", layout_names)
    """Layout of the recording."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value, as for gsfusion-nb map."""
    start: int = 0
    """Number of the first frame that is read, counted from 0."""
    stop: int = 0
    """Stop before this frame; 0 reads to the end."""
    stride: int = 1
    """Read every n-th frame."""
    width: int = 0
    """Resize the images to this width, pixels; 0: to that of the run's images."""
    same_frame: Literal["auto", "yes", "no"] = "auto"
    """Whether the poses of the recording are in the frame of the map, so that errors can be
    computed. auto: if it is the recording of the run."""
    system: str = named("", system_names)
    """System of the run; needed only if it came from a file, FILE.py:Name, which is executed."""
    device: str = "cpu"
    """Where the map is drawn: cpu or cuda."""
    backend: str = named(from_environment, backend_names)
    """What the operations run on; the environment variable GSFUSION_BACKEND changes the default."""


def run(options: LocateOptions) -> int:
    """The command. Exit status 0: frames were located; 3: none was."""
    from ..runs.located import default_frames, locate
    from ..runs.stored_map import open_map

    data, reader = recording_to_open(options, options.data)
    with use_backend(options.backend):
        system = options.system or None
        frames = default_frames(open_map(options.run, system=system))
        frames = dataclasses.replace(
            frames,
            width=options.width or frames.width,
            start=options.start,
            stop=options.stop,
            stride=options.stride,
        )
        found = locate(
            options.run,
            data,
            folder=options.out or None,
            frames=frames,
            same_frame=options.same_frame,
            system=system,
            device=options.device,
            **reader,
        )
    return _print(found)


def _print(found: "LocatedRecording") -> int:
    print_metrics(found.metrics)
    for warning in found.warnings:
        print(f"note: {warning}")
    n = len(found.frames)
    lost = [row for row in found.frames if not row.location.is_located]
    if lost:
        print(
            f"{len(lost)} of {n} frames were not located, the first because: "
            f"{lost[0].location.reason}"
        )
    print(f"Files in {found.folder}:")
    for path in sorted(path for path in found.folder.iterdir() if path.name[0] != "."):
        print(f"  {path.name:<16} {path.stat().st_size / 1e6:8.2f} MB")
    return 0 if len(lost) < n else 3
