"""The pose of every frame: as recorded, or from a file, one per frame or interpolated at the frame's time."""

import contextlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import check_pose
from ...data.recorded.files import images_in
from ...data.recorded.poses import (
    check_decimal_points,
    checked_pose,
    checked_rows,
    interpolate_rows,
    matrices,
    read_rows,
    read_words,
)
from ...data.recorded.times import PER_SECOND, date_unit, judge_stamps
from ...data.recorded.times import time_unit as find_time_unit
from ...data.sequence import SequenceError
from ...files import parsing, read_text, refusing
from ...geometry import quaternion, se3
from .recording import ConvertOptions, OptionNeeded, RecordedFrame, Recording, read_array


class FramePoses:
    """Pose of each frame: the recorded one, or one from a file, by its place or at its time; scaled to metres and
    checked."""

    def __init__(self, recording: Recording, options: ConvertOptions):
        self.trajectory: Trajectory | None = None
        self._per_frame: dict[Any, Tensor] | None = None
        self.none = options.poses == "none"
        self._offset_s = options.time_offset_s
        self._recording = recording
        self.notes: list[str] = []
        file = "" if self.none else options.poses or recording.poses_file
        if file:
            self._T_body_cam = camera_in_body(options.T_cam_body, options.T_body_cam)
            per_frame = poses_per_frame(Path(file), recording, options)
            self._per_frame = None if per_frame is None else per_frame[0]
            self.notes += [] if per_frame is None else per_frame[1]
        if file and self._per_frame is not None:
            self.notes.append(f"{file}: one pose per frame, taken as camera-to-world, OpenCV axes, metres")
        elif file:
            self.trajectory = read_trajectory(
                Path(file),
                time_unit=options.pose_time_unit,
                max_gap_s=options.max_gap_s,
                T_body_cam=self._T_body_cam,
                frame_time_s=_first_time(recording),
            )
            self.notes += self.trajectory.notes
        elif not self.none and not recording.has_poses:
            raise OptionNeeded(
                f"{recording.name} holds no poses; give a trajectory with --poses FILE (TUM, OKVIS2, ORB-SLAM3, "
                "EuRoC, or one pose per frame), or --poses none to track the camera later",
                option="poses",
                question="Which file holds the poses? none: they are estimated by tracking the camera",
            )
        self._scale = 1.0 if self.none else self._metres_per_unit(options)

    @property
    def by_place(self) -> bool:
        """Whether a pose is that of a colour image and of its depth, whenever they were taken."""
        return self._per_frame is not None

    def timed(self, frame: RecordedFrame) -> RecordedFrame:
        """The frame with the time that the trajectory gives for its number, where the recording has no times."""
        trajectory = self.trajectory
        if trajectory is None or frame.time_s is not None or trajectory.counts_frames:
            return frame
        return replace(frame, time_s=trajectory.time_of_frame.get(frame_key(Path(frame.source).stem)))

    def of(self, place: int, frame: RecordedFrame) -> tuple[Float[Tensor, "4 4"] | None, str]:
        """Pose of the frame at a place of the recording, or None and why there is none; float64, metres."""
        if self._per_frame is not None:
            T, reason = self._per_frame.get(place), "no pose of its name"
            T = self._per_frame.get(frame_key(Path(frame.source).stem)) if T is None else T
            T = T if T is None or self._T_body_cam is None else T @ self._T_body_cam
        elif self.trajectory is not None:
            T, reason = self._of_trajectory(self.trajectory, frame)
        else:
            T, reason = frame.T_WC, "no pose"
        if T is None:
            return None, reason
        if not bool(torch.isfinite(T).all()):
            return None, "tracking was lost (pose is NaN or infinite)"
        T = T.double().clone()
        T[:3, 3] *= self._scale
        checked_pose(T, f"the pose of {frame.source}")
        return T, ""

    def _of_trajectory(self, trajectory: "Trajectory", frame: RecordedFrame) -> tuple[Float[Tensor, "4 4"] | None, str]:
        """The pose at the time of a frame, or, where the frame has no time, of its number."""
        if frame.time_s is not None:
            return trajectory.pose_at(frame.time_s + self._offset_s), "the trajectory has no pose around its time"
        if not trajectory.time_of_frame:
            raise SequenceError(
                f"{trajectory.path} gives poses by time, but {frame.source} has none; expected image names or "
                "lists with times; --poses none tracks the camera later"
            )
        time_s = trajectory.time_of_frame.get(frame_key(Path(frame.source).stem))
        return None if time_s is None else trajectory.pose_at(time_s), "the trajectory has no pose of its number"

    def _metres_per_unit(self, options: ConvertOptions) -> float:
        if options.scale:
            self.notes.append(f"positions were multiplied by {options.scale:g} (--scale)")
            return options.scale
        if self.trajectory is not None or not self._recording.up_to_scale:
            return 1.0
        scale, sentence = 1.0, "nothing to measure it on"
        if self._recording.measured_scale is not None:
            scale, sentence = self._recording.measured_scale()
        self.notes.append(
            f"these poses have no unit of length; one unit is taken as {scale:.6g} m ({sentence}; --scale)"
        )
        return scale


def _first_time(recording: Recording) -> float | None:
    """When the first frame was taken, seconds; None where the recording has no times."""
    with contextlib.suppress(SequenceError):
        return next((frame.time_s for frame in recording.frames()), None)
    return None


def frame_key(name: str) -> tuple[int, ...] | str:
    """What the names of one frame's files have in common: the numbers in them, or the name where there are none."""
    return tuple(int(n) for n in re.findall(r"\d+", name)) or name


_LAST_ROW = re.compile(r"(-?0(\.0*)?(e[+-]00)? ){3}1(\.0*)?(e\+00)?")
"""Of a matrix after the name of an image; rows of EuRoC have as many columns."""
_PER_FRAME = {4: "4x4 numbers", 7: "tx ty tz qx qy qz qw", 12: "3x4 numbers", 16: "4x4 numbers"}


def poses_per_frame(
    path: Path, recording: Recording, options: ConvertOptions
) -> tuple[dict[Any, Float[Tensor, "4 4"]], list[str]] | None:
    """Camera-to-world poses, float64, by the place of the frame or by ``frame_key`` of its image, and notes; None for a
    file with times.

    Rows of a file hold 16 or 12 numbers of a matrix, "tx ty tz qx qy qz qw", or the name of the image and 16 numbers; a
    matrix may take four rows. A folder has a file with a matrix for each image.

    Raises:
        SequenceError: another number of poses than of frames, of which neither the numbers of the images nor the
            options say whose they are, or a quaternion whose length is not 1.
    """
    if path.suffix == _ARKIT_SUFFIX:
        return None
    what = "one pose per frame: " + ", ".join(_PER_FRAME.values())
    names: list[str] = []
    if path.is_dir():
        files = images_in(path, (".txt", ".npy"))
        files = [f for f in files if "pose" in f.name] or files
        values = {f.name: _numbers_of(f, what) for f in files if f.stat().st_size}
        names, rows = [*values], [*values.values()]
    elif path.suffix == ".npy":
        array = read_array(path, what)
        rows = array.reshape(len(array), -1).tolist()
    else:
        rows = [words for _, words in read_words(path, what)]
        if all(len(row) == 17 and _LAST_ROW.fullmatch(" ".join(row[-4:])) for row in rows):
            names, rows = [row[0] for row in rows], [row[1:] for row in rows]
        if {len(row) for row in rows} - set(_PER_FRAME):
            return None
    with parsing(path, what):
        table = torch.tensor([[float(value) for value in row] for row in rows], dtype=torch.float64)
        if table.shape[1] == 7:
            poses = matrices(_checked_quaternions(table, path))
        else:
            poses = table.reshape(-1, 3 if table.shape[1] == 12 else 4, 4)
            poses = torch.cat([poses[:, :3], torch.eye(4).double()[3:].expand(len(poses), 1, 4)], 1)
    if names:
        return {frame_key(Path(name).stem): pose for name, pose in zip(names, poses, strict=True)}, []
    if len(poses) == recording.n_frames:
        return dict(enumerate(poses)), []
    rows_of, note = _rows_of_frames(path, len(poses), recording, options)
    return {place: poses[row] for place, row in rows_of.items()}, [note]


def _rows_of_frames(
    path: Path, n_poses: int, recording: Recording, options: ConvertOptions
) -> tuple[dict[int, int], str]:
    """Place of a frame -> place of its pose, where there are more or fewer poses than frames, and a note.

    Raises:
        SequenceError: neither the frames that are converted nor the numbers of the images say it.
    """
    n_frames = recording.n_frames
    converted = range(options.start, options.stop or n_frames, options.every)
    if len(converted) == n_poses and converted != range(n_frames):
        told = f"{path}: {n_poses} poses, as many as frames are converted, so each goes to one of these in order"
        return {place: row for row, place in enumerate(converted)}, told
    numbers = frame_numbers([Path(frame.source).stem for frame in recording.frames()])
    rows = None if numbers is None else _rows_by_number(numbers, n_poses)
    if rows is not None and numbers is not None:
        told = (
            f"{path}: {n_poses} poses for {n_frames} frames, so each image has the pose of its number, image "
            f"{numbers[0]} that of row {rows[0]}, counted from 0"
        )
        return dict(enumerate(rows)), told
    every = n_frames // n_poses
    regular = f"; of every {every}th frame: --every {every}" if every > 1 and n_frames % n_poses == 0 else ""
    raise SequenceError(
        f"{path} holds {n_poses} poses; expected {n_frames}, one per frame, and neither names nor numbers say whose "
        f"these are; if they are those of the first frames: --stop {n_poses}{regular}; else put the name of its image "
        "before each pose; --poses none tracks the camera later"
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
    """The number in the name of each image, of several the one that is not the same in all names; None without one."""
    keys = [frame_key(stem) for stem in stems]
    if not keys or not all(isinstance(key, tuple) for key in keys) or len({len(key) for key in keys}) != 1:
        return None
    varying = [column for column in zip(*keys, strict=True) if len(set(column)) == len(keys)]
    return [int(n) for n in varying[0]] if len(varying) == 1 else None


def _checked_quaternions(rows: Float[Tensor, "N 7"], path: Path) -> Float[Tensor, "N 7"]:
    """Rows "tx ty tz qx qy qz qw". Raises ``SequenceError`` where the last four are no unit quaternion."""
    length = rows[:, 3:].norm(dim=1)
    wrong = ((length - 1).abs() > 1e-2) & torch.isfinite(length)
    if bool(wrong.any()):
        i = int(wrong.nonzero()[0])
        raise SequenceError(
            f"{path}: pose {i} must be tx ty tz qx qy qz qw with a quaternion of length 1, got one of length "
            f"{float(length[i]):.3g}; ARKitScenes' times and axes are read from a file that ends in {_ARKIT_SUFFIX}"
        )
    return rows


_ARKIT_SUFFIX = ".traj"
"""Of ARKitScenes: time, rotation as axis times angle in radians, and translation, all world-to-camera."""


def _rows_of_arkit(rows: Float[Tensor, "N 7"]) -> Float[Tensor, "N 8"]:
    """Rows t tx ty tz qx qy qz qw of the camera-to-world poses."""
    angle = rows[:, 1:4].norm(dim=1, keepdim=True)
    half_sinc = 0.5 * torch.sinc(0.5 * angle / torch.pi)
    quat_CW = torch.cat([torch.cos(0.5 * angle), half_sinc * rows[:, 1:4]], 1)
    R_WC = quaternion.to_matrix(quat_CW).transpose(1, 2)
    t_WC = -(R_WC @ rows[:, 4:, None])[..., 0]
    quat_WC = quat_CW * quat_CW.new_tensor([1.0, -1.0, -1.0, -1.0])
    return torch.cat([rows[:, :1], t_WC, quat_WC[:, [1, 2, 3, 0]]], 1)


def _numbers_of(path: Path, what: str) -> list[float]:
    return read_array(path, what).ravel().tolist() if path.suffix == ".npy" else read_numbers(path, what)


_TUM = [0, 1, 2, 3, 4, 5, 6, 7]
_EUROC = [0, 1, 2, 3, 5, 6, 7, 4]
"""Columns of time, position and quaternion xyzw."""
_EUROC_COLUMNS = 17
"""time, position, quaternion, velocity and two biases: an EuRoC ground truth without its header."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a camera at increasing times, interpolated between them."""

    path: str
    stamps_s: Float[Tensor, " N"]
    rows: Float[Tensor, "N 7"]
    """tx ty tz qx qy qz qw, metres."""
    T_body_cam: Float[Tensor, "4 4"]
    """From the camera's frame to that of the body whose poses these are."""
    max_gap_s: float
    notes: tuple[str, ...] = ()
    time_of_frame: Mapping[Any, float] = field(default_factory=dict)
    """``frame_key`` of an image -> time of its pose, seconds, where the file says which image a pose belongs to."""
    counts_frames: bool = False
    """The times only number the frames."""

    def pose_at(self, time_s: float) -> Float[Tensor, "4 4"] | None:
        """Camera-to-world pose, or None outside the recorded time and in a gap longer than ``max_gap_s``."""
        row = interpolate_rows(self.stamps_s, self.rows, time_s, max_gap_s=self.max_gap_s)
        return None if row is None else matrices(row[None])[0] @ self.T_body_cam


def read_trajectory(
    path: Path,
    *,
    time_unit: str = "auto",
    max_gap_s: float = 0.2,
    T_body_cam: Float[Tensor, "4 4"] | None = None,
    frame_time_s: float | None = None,
) -> Trajectory:
    """Read poses ``T_world_body`` with times.

    Known: TUM text and ORB-SLAM3 ("t tx ty tz qx qy qz qw", seconds or nanoseconds), OKVIS2 csv (header, nanoseconds,
    xyzw), EuRoC csv (header, nanoseconds, wxyz), StrayScanner's odometry.csv, whose column "frame" numbers the images,
    and the world-to-camera poses of ARKitScenes (files ending in .traj). A header decides on the order of the columns.
    Rows with NaN or infinities are left out: tracking was lost.

    Args:
        path: The file.
        time_unit: Unit of its times; "auto" takes the unit in which they are dates of today, or in which they span
            ``frame_time_s``, or else the one in which the steps are those of a camera.
        max_gap_s: Largest gap to interpolate over, seconds.
        T_body_cam: From the camera's frame to the body's; the identity if the poses are those of the camera.
        frame_time_s: When the first frame was taken, seconds; None: unknown.

    Raises:
        SequenceError: no such file, no rows, a row that is not numeric, times that go back, two poses at one time that
            are far apart, or a quaternion whose length is not 1.
    """
    if path.suffix == _ARKIT_SUFFIX:
        stored, frames = _rows_of_arkit(read_rows(path, 7, "time, axis times angle and translation, 7 numbers")), {}
    else:
        stored, frames = _table(path)
    table, notes = checked_rows(stored, path, ordered=True)
    if not len(table):
        raise SequenceError(f"{path} holds no finite pose; expected rows 't tx ty tz qx qy qz qw'")
    stamps = judge_stamps(table[:, 0].tolist())
    counts_frames = time_unit == "auto" and frame_time_s is None and stamps.counts_frames and not frames
    unit = time_unit
    if time_unit == "auto":
        unit = _unit_of(table[:, 0].tolist(), frame_time_s)
    time_of_frame = {key: time / PER_SECOND[unit] for key, time in frames.items()}
    if counts_frames:
        unit = "s"
        time_of_frame = {(int(t),): t for t in table[:, 0].tolist()}
        notes.append(f"{path}: {len(table)} poses, whose times number the frames: each goes to the image of its number")
    elif frames:
        notes.append(f"{path}: {len(table)} poses, times read as {unit}; its column of frames says whose they are")
    else:
        notes.append(f"{path}: {len(table)} poses, times read as {unit}")
    return Trajectory(
        path=str(path),
        stamps_s=(table[:, 0] / PER_SECOND[unit]).contiguous(),
        rows=table[:, 1:],
        T_body_cam=torch.eye(4, dtype=torch.float64) if T_body_cam is None else T_body_cam,
        max_gap_s=max_gap_s,
        notes=tuple(notes),
        time_of_frame=time_of_frame,
        counts_frames=counts_frames,
    )


def _unit_of(times: list[float], frame_time_s: float | None) -> str:
    """Unit of increasing times: that of their dates, the only one in which they are about a frame's time, or that of
    their steps."""
    dated = date_unit(times[-1])
    if dated or frame_time_s is None:
        return dated or find_time_unit(times)
    margin = 0.1 * (times[-1] - times[0])
    first = times[0] - margin
    last = times[-1] + margin
    spanning = [unit for unit, n in PER_SECOND.items() if first <= frame_time_s * n <= last]
    return spanning[0] if len(spanning) == 1 else find_time_unit(times)


def _table(path: Path) -> tuple[Float[Tensor, "N 8"], dict[Any, float]]:
    """Rows t tx ty tz qx qy qz qw in the file's unit of time, float64, and the time of each frame that they name."""
    lines = read_text(path, "rows 't tx ty tz qx qy qz qw'").splitlines()
    columns, frame_column = None, None
    rows: list[list[float]] = []
    time_of_frame: dict[Any, float] = {}
    for number, line in enumerate(lines, 1):
        check_decimal_points(line, path)
        words = [w for w in re.split(r"[,\s]+", line.strip()) if w]
        if not words or line.lstrip().startswith(("#", "%")) or (not rows and words[0][:1].isalpha()):
            if columns is None:
                columns = _columns_of_header(line)
                frame_column = _frame_column(line) if columns else None
            continue
        columns = columns or (_EUROC if len(words) == _EUROC_COLUMNS else _TUM)
        with parsing(f"{path} line {number}", "a time, a position and a quaternion in at least 8 numbers"):
            rows.append([float(words[c]) for c in columns])
            if frame_column is not None:
                time_of_frame[frame_key(Path(words[frame_column]).stem)] = rows[-1][0]
    if not rows:
        raise SequenceError(f"{path} is empty; expected rows 't tx ty tz qx qy qz qw'")
    return torch.tensor(rows, dtype=torch.float64), time_of_frame


def _names_in(header: str) -> list[str]:
    """Names of the columns in a header, in small letters, without units in brackets."""
    text = re.sub(r"\[[^\]]*\]", "", header.strip().lstrip("#%").lower()).replace(".", "_")
    return [n.strip() for n in (text.split(",") if "," in text else text.split())]


def _columns_of_header(line: str) -> list[int] | None:
    """Columns of time, position and quaternion xyzw that a header names, if it names them all."""
    names = _names_in(line)
    patterns = [*(rf"(t|p|p_.*_|){a}" for a in "xyz"), *(rf"q(_|_.*_|){a}" for a in "xyzw")]
    found = [next((i for i, n in enumerate(names) if re.fullmatch(p, n)), None) for p in patterns]
    return None if None in found else [0, *(i for i in found if i is not None)]


def _frame_column(line: str) -> int | None:
    """The column in which a header says that the number or name of an image stands (StrayScanner, RTAB-Map)."""
    names = _names_in(line)
    return next(
        (i for i, n in enumerate(names) if re.fullmatch(r"(frame|image|node)(_?(id|number|index|name))?|id", n)), None
    )


def camera_in_body(T_cam_body: str, T_body_cam: str) -> Float[Tensor, "4 4"] | None:
    """From the camera's frame to the body's, from the file that is given; None if there is none."""
    if not T_cam_body and not T_body_cam:
        return None
    path = Path(T_cam_body or T_body_cam)
    T = read_matrix(path)
    return se3.inverse(T) if T_cam_body else T


def read_matrix(path: Path) -> Float[Tensor, "4 4"]:
    """A rigid 4x4 matrix of 16 numbers, row-major, whatever the brackets and commas around them. float64."""
    T = torch.tensor(read_numbers(path, "16 row-major numbers of a rigid transform"), dtype=torch.float64)
    if T.numel() != 16:
        raise SequenceError(f"{path} must hold 16 row-major numbers of a rigid transform, got {T.numel()}")
    with refusing(f"{path} is not a rigid transform: "):
        check_pose("the transform", T.reshape(4, 4))
    return T.reshape(4, 4)


def read_numbers(path: Path, what: str) -> list[float]:
    """All numbers of a text file; brackets, commas and ``#`` comments are ignored."""
    lines = [line.split("#")[0] for line in read_text(path, what).splitlines()]
    for line in lines:
        check_decimal_points(line, path)
    words = " ".join(lines).translate(str.maketrans("[](){},;", "        ")).split()
    with parsing(path, what):
        return [float(w) for w in words]
