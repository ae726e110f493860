"""``gsfusion-nb excerpt``: a part of a recording as a recording, also in the layouts of other
trainers."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..checks import check_name
from ..config import DataConfig, from_dict
from ..config.options import named, named_values
from ..config.values import tree_of
from ..data import open_sequence
from ..data.readers.tum import benchmark_camera
from ..errors import ArgumentError, SequenceError
from ..recordings.baselines import LAYOUTS, write_for_baseline
from ..recordings.excerpt import write_excerpt


@dataclass(frozen=True, kw_only=True)
class ExcerptOptions:
    """Write some frames of a recording to a new folder: images bit for bit, with their poses and
    intrinsics. Or, with --layout, for nerfstudio or COLMAP, with the size and the held-out views of
    a run, so that baselines see the same."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder or file of the recording; with --layout also "room"."""
    out: Annotated[Path, tyro.conf.Positional]
    """New or empty folder."""
    frames: str = ":"
    """First frame, end (not included) and step, as A:B or A:B:STEP; each may be left out, such as
    100:200 or ::10. Default: all."""
    layout: str = named("own", lambda: ("own (as it is stored)", *LAYOUTS))
    """Layout of the new folder."""
    set: tuple[str, ...] = ()
    """Settings of what is read, with --layout: --set data.width=320 data.hold_out_every=8."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value, such as poses=false."""


def run(options: ExcerptOptions) -> int:
    """The command. Exit status 0: the frames are written.

    Raises:
        SequenceError: the recording cannot be read, or it has none of these frames.
    """
    source = options.source.expanduser()
    out = options.out
    if options.layout != "own":
        return _for_baseline(options, source)
    if options.set:
        raise ArgumentError("--set changes images; an excerpt in its own layout keeps them")
    n_frames = write_excerpt(source, out, _slice(options.frames), **named_values(options.reader))
    camera = benchmark_camera(source)
    reader = f" --reader camera={camera}" if camera and not benchmark_camera(out) else ""
    print(f"{n_frames} frames of {source} in {out}\nNext: gsfusion-nb check {out}{reader}")
    return 0


def _for_baseline(options: ExcerptOptions, source: Path) -> int:
    check_name("layout", options.layout, ("own", *LAYOUTS))
    frames = _slice(options.frames)
    values = {"data.start": frames.start, "data.stop": frames.stop, "data.stride": frames.step}
    values = {name: value for name, value in values.items() if value} | named_values(options.set)
    if others := [name for name in values if not name.startswith("data.")]:
        raise ArgumentError(f"--set takes settings of data here, got {', '.join(others)}")
    tree = tree_of({name.removeprefix("data."): value for name, value in values.items()}, ".")
    data = from_dict(DataConfig, tree)
    sequence = open_sequence(source, data=data, **named_values(options.reader))
    n_frames = write_for_baseline(sequence, options.out, options.layout)
    print(
        f"{n_frames} frames of {source} in {options.out}, {len(sequence.held_out)} of them held "
        f"out, {sequence.camera.width}x{sequence.camera.height}, in the layout of {options.layout}"
    )
    return 0


def _slice(text: str) -> slice:
    if not re.fullmatch(r"\d*:\d*(:[1-9]\d*)?", text):
        raise SequenceError(
            f"--frames must be A:B or A:B:STEP, such as 100:200 or ::10, got {text}"
        )
    return slice(*(int(part) if part else None for part in text.split(":")))
