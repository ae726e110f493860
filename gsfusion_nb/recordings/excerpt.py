"""``gsfusion-nb excerpt``: a part of a recording as a recording.

Images in folders are copied bit for bit, with what belongs to them: lists and poses keep the lines of the chosen
frames, other files are whole. What is not a folder of images is written in the plain layout, as ``convert`` does.
"""

import contextlib
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from ..config.values import named_values, parse_options
from ..data.open import detect_layout, open_sequence
from ..data.readers.tum import benchmark_camera
from ..data.recorded.recorded_sequence import RecordedSequence
from ..data.sequence import BadFrameError, SequenceError
from ..files import atomic_folder, noting_files, parsing, read_object, read_text
from .convert.formats import FORMATS, detect_format
from .convert.recording import ConvertOptions, read_array
from .convert.run import convert

_BY_PLACE = ("open3d",)
"""Formats that count images and poses from the first image: without it they would not fit."""
_PER_IMAGE = (7, 12, 16, 17)
"""Columns of a file with one pose per image: a position and a quaternion, or a matrix, also after a name."""


@dataclass(frozen=True, kw_only=True)
class ExcerptOptions:
    """Write some frames of a recording to a new folder: images bit for bit, with their poses and intrinsics."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder or file of the recording."""
    out: Annotated[Path, tyro.conf.Positional]
    """New or empty folder."""
    frames: str
    """First frame, end (not included) and step, as A:B or A:B:STEP; each may be left out, such as 100:200 or ::10."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value, such as poses=false."""


def excerpt_command(arguments: list[str]) -> str:
    """Cut as the arguments of ``gsfusion-nb excerpt`` say; a sentence on what was written.

    Raises:
        SequenceError: the recording cannot be read, or it has none of these frames.
    """
    options = parse_options(ExcerptOptions, prog="gsfusion-nb excerpt", arguments=arguments)
    chosen = _slice(options.frames)
    source, out = options.source.expanduser(), options.out
    n = write_excerpt(source, out, chosen, **named_values(options.reader))
    camera = benchmark_camera(source)
    reader = f" --reader camera={camera}" if camera and not benchmark_camera(out) else ""
    return f"{n} frames of {source} in {out}\nNext: gsfusion-nb check {out}{reader}"


def _slice(text: str) -> slice:
    if not re.fullmatch(r"\d*:\d*(:[1-9]\d*)?", text):
        raise SequenceError(f"--frames must be A:B or A:B:STEP, such as 100:200 or ::10, got {text}")
    return slice(*(int(part) if part else None for part in text.split(":")))


def write_excerpt(source: Path, out: Path, chosen: slice, **reader: Any) -> int:
    """Write the chosen frames of a recording to a new folder.

    Args:
        source: Folder or file of the recording.
        out: New or empty folder.
        chosen: Which frames, counted from 0 in the order of the recording.
        reader: Options of the layout's reader.

    Returns:
        The number of frames.

    Raises:
        SequenceError: the recording cannot be read, or it has none of these frames. FileExistsError: ``out`` is in use.
    """
    try:
        layout = detect_layout(source) if source.is_dir() else ""
    except SequenceError:
        layout = ""
    format = "" if layout else detect_format(source)
    if format in _BY_PLACE or (format and not source.is_dir()):
        options = ConvertOptions(start=chosen.start or 0, stop=chosen.stop or 0, every=chosen.step or 1)
        return convert(source, out, format=format, options=options).frames
    shared, images = _files_of_layout(source, layout, reader) if layout else _files_of_format(source, format)
    places = range(len(images))[chosen]
    if not places:
        raise SequenceError(f"{source} has {len(images)} frames; --frames chooses none of them")
    wanted, every = {f for place in places for f in images[place]}, {f for files in images for f in files}
    names = {f.name for f in wanted}, {f.name for f in every}
    with atomic_folder(out, out.with_name(f".{out.name}.partial")) as folder:
        for file in sorted(wanted | {*shared} - every):
            target = folder / (file.relative_to(source) if file.is_relative_to(source) else file.name)
            target.parent.mkdir(parents=True, exist_ok=True)
            if file in wanted or layout == "replica":
                shutil.copyfile(file, target)
            else:
                _write_part(file, target, *names, len(images), places)
    return len(places)


def _files_of_layout(source: Path, layout: str, reader: dict[str, Any]) -> tuple[list[Path], list[list[Path]]]:
    """Files of the whole recording, and those of each frame."""
    sequence = open_sequence(source, format=layout, **reader).source
    assert isinstance(sequence, RecordedSequence)
    images = [[*pair] for pair in zip(sequence.rgb_files, sequence.depth_files, strict=True)]
    if layout == "seven_scenes":
        for files, pose in zip(images, sequence.pose_sources, strict=True):
            files.append(Path(pose))
    return [*sequence.read_from], images


def _files_of_format(source: Path, format: str) -> tuple[list[Path], list[list[Path]]]:
    """Files of the whole recording, and those of each frame."""
    with noting_files() as shared, parsing(source, f"a recording in the format {format}"):
        recording = FORMATS[format].read(source, ConvertOptions(depth_scale=1000.0))
    frames, images = recording.frames(), []
    while True:
        with noting_files() as files, contextlib.suppress(BadFrameError):
            frame = next(frames, None)
            if frame is None:
                break
            frame.load()
        images.append(files)
    poses = Path(recording.poses_file)
    if recording.poses_file:
        shared += poses.iterdir() if poses.is_dir() else [poses]
    return shared, images


def _write_part(file: Path, target: Path, kept: set[str], all_names: set[str], n: int, places: Sequence[int]) -> None:
    """Copy a file; of a list of images or of one pose per frame only the lines of the kept frames."""
    if file.suffix == ".npy":
        with parsing(file, "a NumPy array"):
            array = read_array(file, "a NumPy array")
        if array.ndim > 1 and len(array) == n:
            np.save(target, array[list(places)])
            return
    elif file.suffix == ".json":
        values = read_object(file, "a JSON object")
        part = _named_part(values, kept, all_names)
        if part != values:
            target.write_text(json.dumps(part, indent=1), encoding="utf-8")
            return
    elif file.suffix in (".txt", ".csv"):
        lines = read_text(file, "lines of text").splitlines(keepends=True)
        rows = [i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
        names = {i: {Path(word).name for word in lines[i].split()} & all_names for i in rows}
        widths = {len(lines[i].split()) for i in rows}
        if any(names.values()):
            drop = {i for i in rows if not names[i] & kept}
        elif len(rows) == n and widths <= set(_PER_IMAGE):
            drop = set(rows) - {rows[place] for place in places}
        else:
            drop = set()
        if drop:
            target.write_text("".join(line for i, line in enumerate(lines) if i not in drop), encoding="utf-8")
            return
    shutil.copyfile(file, target)


def _named_part(values: Any, kept: set[str], all_names: set[str]) -> Any:
    """JSON values without the entries of lists that name an image which is not kept."""
    if isinstance(values, dict):
        return {key: _named_part(value, kept, all_names) for key, value in values.items()}
    if not isinstance(values, list):
        return values
    texts = [
        {Path(text).name for text in (v.values() if isinstance(v, dict) else [v]) if isinstance(text, str)}
        for v in values
    ]
    return [
        _named_part(v, kept, all_names) for v, t in zip(values, texts, strict=True) if not t & all_names or t & kept
    ]
