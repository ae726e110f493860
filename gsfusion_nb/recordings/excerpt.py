"""``gsfusion-nb excerpt``: a part of a recording as a recording.

Images in folders are copied bit for bit, with what belongs to them: lists and poses keep the lines
of the chosen frames, other files are whole. What is not a folder of images is written in the plain
layout, as ``convert`` does.
"""

import contextlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..data.adjust.repair import as_read
from ..data.open import open_sequence
from ..data.recorded.recorded_sequence import RecordedSequence
from ..errors import BadFrameError, SequenceError
from ..files import atomic_folder, noting_files, parsing, read_object, read_text
from .convert.depth_files import read_array
from .convert.formats import FORMATS, detect_format, readable_layout
from .convert.recording import ConvertOptions
from .convert.run import convert

_BY_PLACE = ("open3d",)
"""Formats that count images and poses from the first image: without it they would not fit."""
_PER_IMAGE = (7, 12, 16, 17)
"""Columns of a file with one pose per image: a position and a quaternion, or a matrix, also after a
name."""


def write_excerpt(source: Path, out: Path, frame_range: slice, **reader: Any) -> int:
    """Write the chosen frames of a recording to a new folder.

    Args:
        source: Folder or file of the recording.
        out: New or empty folder.
        frame_range: Which frames, counted from 0 in the order of the recording.
        reader: Options of the layout's reader.

    Returns:
        The number of frames.

    Raises:
        SequenceError: the recording cannot be read, or it has none of these frames.
            FileExistsError: ``out`` is in use.
    """
    layout = readable_layout(source)
    format = "" if layout else detect_format(source)
    if format in _BY_PLACE or (format and not source.is_dir()):
        options = ConvertOptions(
            start=frame_range.start or 0, stop=frame_range.stop or 0, every=frame_range.step or 1
        )
        return convert(source, out, format=format, options=options).frames
    shared_files, images = (
        _files_of_layout(source, layout, reader) if layout else _files_of_format(source, format)
    )
    places = range(len(images))[frame_range]
    if not places:
        raise SequenceError(f"{source} has {len(images)} frames; --frames chooses none of them")
    image_files = {f for place in places for f in images[place]}
    every = {f for files in images for f in files}
    parts = _Parts(
        {f.name for f in image_files},
        {f.name for f in every},
        len(images),
        places,
    )
    with atomic_folder(out, out.with_name(f".{out.name}.partial")) as folder:
        for file in sorted(image_files | {*shared_files} - every):
            target = folder / (
                file.relative_to(source) if file.is_relative_to(source) else file.name
            )
            target.parent.mkdir(parents=True, exist_ok=True)
            if file in image_files or layout == "replica" or not parts.write(file, target):
                shutil.copyfile(file, target)
    return len(places)


def _files_of_layout(
    source: Path, layout: str, reader: dict[str, Any]
) -> tuple[list[Path], list[list[Path]]]:
    """Files of the whole recording, and those of each frame."""
    sequence = as_read(open_sequence(source, format=layout, **reader).source)
    assert isinstance(sequence, RecordedSequence)
    return [*sequence.read_from], [
        [*pair] for pair in zip(sequence.rgb_files, sequence.depth_files, strict=True)
    ]


def _files_of_format(
    source: Path,
    format: str,
) -> tuple[list[Path], list[list[Path]]]:
    """Files of the whole recording, and those of each frame."""
    with noting_files() as shared_files, parsing(source, f"a recording in the format {format}"):
        recording = FORMATS[format].read(source, ConvertOptions(depth_scale=1000.0))
    frames = recording.frames()
    images = []
    for _ in range(recording.n_frames):
        with noting_files() as files, contextlib.suppress(BadFrameError):
            next(frames).load()
        images.append(files)
    poses = Path(recording.poses_file)
    if recording.poses_file:
        shared_files += poses.iterdir() if poses.is_dir() else [poses]
    return shared_files, images


@dataclass(frozen=True)
class _Parts:
    """Writes the part of a list, or of a file with one pose per frame, that belongs to the kept
    frames."""

    kept: set[str]
    """Names of their images."""
    images: set[str]
    """Names of all images."""
    n_frames: int
    places: Sequence[int]

    def write(self, file: Path, target: Path) -> bool:
        """Whether the file is one of these, and was written."""
        if file.suffix == ".npy":
            array = read_array(file, "a NumPy array")
            if array.ndim > 1 and len(array) == self.n_frames:
                np.save(target, array[list(self.places)])
                return True
        if file.name == "train_test_lists.json":
            lists = read_object(file, "lists of images")
            part = {
                name: [image for image in images if image in self.kept]
                for name, images in lists.items()
            }
            return bool(target.write_text(json.dumps(part), encoding="utf-8"))
        if file.suffix not in (".txt", ".csv"):
            return False
        lines = read_text(file, "lines of text").splitlines(keepends=True)
        rows = {
            i: line.split()
            for i, line in enumerate(lines)
            if line.strip() and not line.lstrip().startswith("#")
        }
        names_in_row = {
            i: {Path(word).name for word in words} & self.images for i, words in rows.items()
        }
        drop = {i for i in rows if any(names_in_row.values()) and not names_in_row[i] & self.kept}
        if len(rows) == self.n_frames and {len(words) for words in rows.values()} <= set(
            _PER_IMAGE
        ):
            drop = {*rows} - {[*rows][place] for place in self.places}
        return bool(
            target.write_text(
                "".join(x for i, x in enumerate(lines) if i not in drop), encoding="utf-8"
            )
        )
