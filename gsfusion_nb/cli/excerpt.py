"""``gsfusion-nb excerpt``: a part of a recording as a recording."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..config.options import named_values
from ..data.readers.tum import benchmark_camera
from ..errors import SequenceError
from ..recordings.excerpt import write_excerpt


@dataclass(frozen=True, kw_only=True)
class ExcerptOptions:
    """Write some frames of a recording to a new folder: images bit for bit, with their poses and
    intrinsics."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder or file of the recording."""
    out: Annotated[Path, tyro.conf.Positional]
    """New or empty folder."""
    frames: str
    """First frame, end (not included) and step, as A:B or A:B:STEP; each may be left out, such as
    100:200 or ::10."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value, such as poses=false."""


def run(options: ExcerptOptions) -> int:
    """The command. Exit status 0: the frames are written.

    Raises:
        SequenceError: the recording cannot be read, or it has none of these frames.
    """
    source = options.source.expanduser()
    out = options.out
    n_frames = write_excerpt(source, out, _slice(options.frames), **named_values(options.reader))
    camera = benchmark_camera(source)
    reader = f" --reader camera={camera}" if camera and not benchmark_camera(out) else ""
    print(f"{n_frames} frames of {source} in {out}\nNext: gsfusion-nb check {out}{reader}")
    return 0


def _slice(text: str) -> slice:
    if not re.fullmatch(r"\d*:\d*(:[1-9]\d*)?", text):
        raise SequenceError(
            f"--frames must be A:B or A:B:STEP, such as 100:200 or ::10, got {text}"
        )
    return slice(*(int(part) if part else None for part in text.split(":")))
