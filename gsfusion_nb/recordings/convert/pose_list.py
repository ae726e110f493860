"""Lists of poses without times: one per frame, by its place, by its name or by its number."""

import re
from collections import Counter
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import shown
from ...data.recorded.files import images_in
from ...data.recorded.pose_headers import check_direction
from ...data.recorded.poses import matrices, read_lines
from ...errors import SequenceError
from ...files import parsing, read_text
from .depth_files import read_array
from .named_poses import first_lines, is_number, read_named_poses
from .recording import ConvertOptions, Recording
from .trajectory import (
    ARKIT_SUFFIX,
    NOTE_ON_ORDER,
    check_order,
    columns_of_header,
    frame_key,
    names_in,
    read_numbers,
)

_LAST_ROW = re.compile(r"(-?0(\.0*)?(e[+-]00)? ){3}1(\.0*)?(e\+00)?")
"""Of a matrix after the name of an image; rows of EuRoC have as many columns."""
_PER_FRAME = {4: "4x4 numbers", 7: "tx ty tz qx qy qz qw", 12: "3x4 numbers", 16: "4x4 numbers"}


_SEPARATORS = str.maketrans(",[];", "    ")


def poses_per_frame(
    path: Path, recording: Recording, options: ConvertOptions
) -> tuple[dict[Any, Float[Tensor, "4 4"]], list[str]] | None:
    """Camera-to-world poses, float64, by the place of the frame or by ``frame_key`` of its image,
    and notes; None for a file with times.

    Rows of a file hold 16 or 12 numbers of a matrix, "tx ty tz qx qy qz qw", or the name of the
    image and 16 or those seven numbers; a matrix may take four rows. A folder has a file with a
    matrix for each image.

    Raises:
        SequenceError: another number of poses than of frames, of which neither the numbers of the
            images nor the options say whose they are, a matrix whose last row is not 0 0 0 1, or a
            quaternion whose length is not 1.
    """
    if path.suffix == ARKIT_SUFFIX:
        return None
    what = "one pose per frame: " + ", ".join(dict.fromkeys(_PER_FRAME.values()))
    names: list[str] = []
    columns = None
    named_poses = (
        None if path.is_dir() or path.suffix == ".npy" else _read_named(path, recording, options)
    )
    if named_poses is not None:
        return named_poses
    if path.is_dir():
        files = images_in(path, (".txt", ".npy"))
        files = [f for f in files if "pose" in f.name] or files
        values = {f.name: _numbers_of(f, what) for f in files if f.stat().st_size}
        names = [*values]
        rows = [*values.values()]
    elif path.suffix == ".npy":
        array = read_array(path, what)
        rows = array.reshape(len(array), -1).tolist()
    else:
        rows, columns = _rows_of_text(path, what, options)
        if all(len(row) == 17 and _LAST_ROW.fullmatch(" ".join(row[-4:])) for row in rows):
            names = [row[0] for row in rows]
            rows = [row[1:] for row in rows]
            _check_each_once([frame_key(Path(name).stem) for name in names], names, path)
        if {len(row) for row in rows} - set(_PER_FRAME):
            return None
    with parsing(path, what):
        table = torch.tensor(
            [[float(value) for value in row] for row in rows],
            dtype=torch.float64,
        )
        if table.shape[1] == 7:
            if columns is None and options.pose_quaternions == "wxyz":
                columns = [0, 1, 2, 4, 5, 6, 3]
                how = []
            else:
                how = [] if columns or options.pose_quaternions == "xyzw" else [NOTE_ON_ORDER]
            table = table if columns is None else table[:, columns]
            poses = matrices(_checked_quaternions(table, path))
        else:
            poses = table.reshape(-1, 3 if table.shape[1] == 12 else 4, 4)
            last_row = torch.eye(4).double()[3:].expand(len(poses), 1, 4)
            check_last_rows(poses, path)
            poses = torch.cat([poses[:, :3], last_row], 1)
            how = []
    if names:
        return _by_name([frame_key(Path(name).stem) for name in names], poses, recording, how)
    if len(poses) == recording.n_frames:
        return dict(enumerate(poses)), how
    rows_of, note = _rows_of_frames(path, len(poses), recording, options)
    return {place: poses[row] for place, row in rows_of.items()}, [note, *how]


def _read_named(
    path: Path, recording: Recording, options: ConvertOptions
) -> tuple[dict[Any, Float[Tensor, "4 4"]], list[str]] | None:
    """Poses of a file that names the images, and notes; None for another file."""
    named = read_named_poses(path, options.pose_quaternions)
    if named is None:
        return None
    keys = [frame_key(Path(name).stem) for name in named.names]
    _check_each_once(keys, named.names, path)
    poses = matrices(_checked_quaternions(named.rows, path))
    is_assumed = named.order_is_assumed and options.pose_quaternions == "auto"
    return _by_name(keys, poses, recording, [NOTE_ON_ORDER] * is_assumed)


def _check_each_once(keys: list[Any], names: list[str], path: Path) -> None:
    counts = Counter(keys)
    repeated = next((n for n, key in zip(names, keys, strict=True) if counts[key] > 1), None)
    if repeated is not None:
        raise SequenceError(f"{path} holds two poses of {repeated}; expected one per image")


def _by_name(
    keys: list[Any],
    poses: Float[Tensor, "N 4 4"],
    recording: Recording,
    notes: list[str],
) -> tuple[dict[Any, Float[Tensor, "4 4"]], list[str]]:
    """Poses by ``frame_key`` of the images. Where poses and images are as many, and one kind is
    numbered from 1 and the other from 0, the first pose goes to the first image, and a note says
    so."""
    of_images = [frame_key(Path(frame.source).stem) for frame in recording.frames()]
    shift = _shift_of_numbers(keys, of_images)
    if shift:
        first = "1" if shift < 0 else "0"
        keys = [(key[0] + shift,) for key in keys]
        notes = [
            f"the numbers of the poses count from {first} and those of the images do not, so the "
            "first pose goes to the first image",
            *notes,
        ]
    return dict(zip(keys, poses, strict=True)), notes


def _shift_of_numbers(keys: list[Any], of_images: list[Any]) -> int:
    """1 or -1 where numbers of poses are those of the images less or plus one; else 0."""
    are_numbers = all(isinstance(key, tuple) and len(key) == 1 for key in (*keys, *of_images))
    if not are_numbers or not keys or len(keys) != len(of_images):
        return 0
    ours = sorted(key[0] for key in keys)
    theirs = sorted(key[0] for key in of_images)
    if {ours[0], theirs[0]} != {0, 1}:
        return 0
    shift = theirs[0] - ours[0]
    return shift if [n + shift for n in ours] == theirs else 0


def _rows_of_text(
    path: Path, what: str, options: ConvertOptions
) -> tuple[list[list[str]], list[int] | None]:
    """Words of the rows of a text file without its header, and the columns of tx ty tz qx qy qz qw
    where a header names these seven and no others.

    Raises:
        SequenceError: a first row that is neither numbers nor such a header, nor a name and
            numbers.
    """
    lines = read_lines(path, what)
    header = next(
        (
            line
            for line in first_lines(path)
            if columns_of_header(line) and len(names_in(line)) == 7
        ),
        None,
    )
    columns = None
    if header is not None:
        columns = (columns_of_header(header) or [])[1:]
        check_order([0, *(c + 1 for c in columns)], options.pose_quaternions, path)
        lines = [(n, line) for n, line in lines if line != header.strip()]
    rows = [line.translate(_SEPARATORS).split() for _, line in lines]
    is_header = len(rows) > 1 and not any(is_number(word) for word in rows[0])
    if is_header and columns_of_header(lines[0][1]) is None:
        raise SequenceError(
            f"{path} line {lines[0][0]} names columns that are not known, {shown(lines[0][1])}; "
            "known: x y z qx qy qz qw, also after a time or the name of an image; or no header, "
            f"and {what}"
        )
    return rows, columns


def _rows_of_frames(
    path: Path, n_poses: int, recording: Recording, options: ConvertOptions
) -> tuple[dict[int, int], str]:
    """Place of a frame -> place of its pose, where there are more or fewer poses than frames, and a
    note.

    Raises:
        SequenceError: neither the frames that are converted nor the numbers of the images say it.
    """
    n_frames = recording.n_frames
    frames = range(options.start, options.stop or n_frames, options.every)
    if len(frames) == n_poses and frames != range(n_frames):
        advice = (
            f"{path}: {n_poses} poses, as many as frames are converted, so each goes to one of "
            "these in order"
        )
        return {place: row for row, place in enumerate(frames)}, advice
    numbers = frame_numbers([Path(frame.source).stem for frame in recording.frames()])
    rows = None if numbers is None else _rows_by_number(numbers, n_poses)
    if rows is not None and numbers is not None:
        advice = (
            f"{path}: {n_poses} poses for {n_frames} frames, so each image has the pose of its "
            f"number, image {numbers[0]} that of row {rows[0]}, counted from 0"
        )
        return dict(enumerate(rows)), advice
    every = n_frames // n_poses
    regular = (
        f"; of every {every}th frame: --every {every}"
        if every > 1 and n_frames % n_poses == 0
        else ""
    )
    raise SequenceError(
        f"{path} holds {n_poses} poses; expected {n_frames}, one per frame, and neither names nor "
        "numbers say whose these are; if they are those of the first frames: --stop "
        f"{n_poses}{regular}; else put the name of its image before each pose; --poses none tracks "
        "the camera later"
    )


def _rows_by_number(numbers: list[int], n_poses: int) -> list[int] | None:
    """Place of the pose of each image where a file holds those of more images: that of its number.

    Args:
        numbers: Of the images, in order, counted from 0, or from 1 where only this fits.
        n_poses: Poses in the file, from the first image of the recording on.

    Returns:
        The places, or None: there are fewer poses than images, or the numbers do not fit.
    """
    if n_poses <= len(numbers) or len(set(numbers)) < len(numbers):
        return None
    if max(numbers) < n_poses:
        return numbers
    return [n - 1 for n in numbers] if min(numbers) >= 1 and max(numbers) == n_poses else None


def frame_numbers(stems: list[str]) -> list[int] | None:
    """The number in the name of each image, of several the one that is not the same in all names;
    None without one."""
    keys = [frame_key(stem) for stem in stems]
    if (
        not keys
        or not all(isinstance(key, tuple) for key in keys)
        or len({len(key) for key in keys}) != 1
    ):
        return None
    varying = [column for column in zip(*keys, strict=True) if len(set(column)) == len(keys)]
    return [int(n) for n in varying[0]] if len(varying) == 1 else None


def _checked_quaternions(rows: Float[Tensor, "N 7"], path: Path) -> Float[Tensor, "N 7"]:
    """Rows "tx ty tz qx qy qz qw". Raises ``SequenceError`` where the last four are no unit
    quaternion."""
    length = rows[:, 3:].norm(dim=1)
    wrong = ((length - 1).abs() > 1e-2) & torch.isfinite(length)
    if bool(wrong.any()):
        i = int(wrong.nonzero()[0])
        raise SequenceError(
            f"{path}: pose {i} must be tx ty tz qx qy qz qw with a quaternion of length 1, got one "
            f"of length {float(length[i]):.3g}; ARKitScenes' times and axes are read from a file "
            f"that ends in {ARKIT_SUFFIX}"
        )
    return rows


def check_last_rows(poses: Float[Tensor, "N R 4"], source: Path | str) -> None:
    """Raises ``SequenceError`` where the last of four rows is not 0 0 0 1: a matrix that is stored
    column by column has its position there."""
    if poses.shape[1] < 4:
        return
    last = poses[:, 3]
    wrong = ((last - last.new_tensor([0.0, 0.0, 0.0, 1.0])).abs() > 1e-6) & torch.isfinite(last)
    if bool(wrong.any()):
        i = int(wrong.any(1).nonzero()[0])
        row = " ".join(f"{value:g}" for value in last[i].tolist())
        raise SequenceError(
            f"{source}: pose {i} must have the last row 0 0 0 1, got {row}; matrices are read row "
            "by row: transpose those that are stored column by column"
        )


def _numbers_of(path: Path, what: str) -> list[float]:
    if path.suffix == ".npy":
        return read_array(path, what).ravel().tolist()
    for line in read_text(path, what).splitlines():
        check_direction(line, path)
    return read_numbers(path, what)
