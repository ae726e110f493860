"""Converting a recording into the plain ``folder`` layout, one frame at a time."""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

from ...checks import check_name
from ...files import atomic_folder, parsing
from ...progress import ProgressDisplay
from .conversion import Conversion, ConvertReport
from .depth_motion import measured_unit
from .formats import FORMATS, detect_format
from .recording import ConvertOptions, RecordedFrame, Recording


def convert(
    source: str | Path,
    out: str | Path,
    *,
    format: str = "auto",
    options: ConvertOptions | None = None,
    progress: bool = False,
) -> ConvertReport:
    """Write a recording in another format as a ``folder`` sequence
    (``gsfusion_nb.data.readers.folder``).

    Frames are read and written one by one, and ``OUT`` appears when all is done: after an error, or
    Ctrl-C, nothing is left. Colour images that need no change are copied. Frames without pose, with
    damaged images or without depth are left out and counted.

    Args:
        source: File or folder of the recording.
        out: New or empty folder.
        format: One of ``known_formats()``; "auto" recognises it.
        options: Options of reading and writing.
        progress: Show a progress bar.

    Raises:
        SequenceError: the recording cannot be read, needs an option that is not given, or no frame
            of it is usable.
        FileExistsError: ``out`` is a file, or a folder that is not empty.
        KeyError: unknown format.
    """
    options = options or ConvertOptions()
    path = Path(source).expanduser()
    out = Path(out)
    check_name("format", format, ("auto", *FORMATS))
    with atomic_folder(out, out.with_name(f".{out.name}.partial")) as folder:
        name = detect_format(path) if format == "auto" else format
        what = f"a recording in the format {name}"
        with parsing(path, what):
            recording = _read(name, path, options)
        conversion = Conversion(recording, options, folder)
        with ProgressDisplay(
            "converting", total=recording.n_frames, unit="frame", visible=progress
        ) as display:
            frames = display.over(_read_on(recording, what))
            for place, frame in itertools.islice(
                enumerate(frames), options.start, options.stop or None, options.every
            ):
                conversion.add(place, frame)
        return conversion.finish(name, out)


def _read(name: str, path: Path, options: ConvertOptions) -> Recording:
    """The recording in a format, with the unit of its depth measured where the files do not tell
    it.

    Raises:
        OptionNeeded: neither the files nor the camera's motion tell it.
    """
    recording = FORMATS[name].read(path, options)
    unit = recording.unit
    if unit is None or not unit.is_guess:
        return recording
    estimate = measured_unit(recording, options)
    if estimate is None and unit.question is not None:
        raise unit.question
    if estimate is None:
        return dataclasses.replace(recording, notes=(*recording.notes, unit.sentence))
    if estimate.scale != recording.depth_scale:
        recording = FORMATS[name].read(
            path, dataclasses.replace(options, depth_scale=estimate.scale)
        )
    return dataclasses.replace(recording, notes=(*recording.notes, estimate.sentence))


def _read_on(recording: Recording, what: str) -> Iterator[RecordedFrame]:
    """The frames; whatever a damaged file leads to becomes one sentence."""
    with parsing(recording.name, what):
        yield from recording.frames()
