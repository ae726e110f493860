"""Trajectories: poses with times, interpolated at the frames' times, as other programs write
them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import check_pose, shown
from ...data.recorded.pose_headers import check_direction, with_nan
from ...data.recorded.poses import (
    check_decimal_points,
    checked_rows,
    matrices,
    read_rows,
)
from ...data.recorded.stamps import PER_SECOND, date_unit, judge_stamps
from ...data.recorded.stamps import time_unit as find_time_unit
from ...errors import SequenceError, refusing
from ...files import parsing, read_text
from ...geometry import quaternion, se3
from ...geometry.pose_path import pose_at


def frame_key(name: str) -> tuple[int, ...] | str:
    """What the names of one frame's files have in common: the numbers in them, or the name where
    there are none."""
    return tuple(int(n) for n in re.findall(r"\d+", name)) or name


ARKIT_SUFFIX = ".traj"
"""Of ARKitScenes: time, rotation as axis times angle in radians, and translation, all
world-to-camera."""


def _rows_of_arkit(rows: Float[Tensor, "N 7"]) -> Float[Tensor, "N 8"]:
    """Rows t tx ty tz qx qy qz qw of the camera-to-world poses."""
    angle = rows[:, 1:4].norm(dim=1, keepdim=True)
    half_sinc = 0.5 * torch.sinc(0.5 * angle / torch.pi)
    quat_CW = torch.cat(
        [torch.cos(0.5 * angle), half_sinc * rows[:, 1:4]],
        1,
    )
    R_WC = quaternion.to_matrix(quat_CW).transpose(1, 2)
    t_WC = -(R_WC @ rows[:, 4:, None])[..., 0]
    quat_WC = quat_CW * quat_CW.new_tensor([1.0, -1.0, -1.0, -1.0])
    return torch.cat(
        [rows[:, :1], t_WC, quat_WC[:, [1, 2, 3, 0]]],
        1,
    )


_TUM = [0, 1, 2, 3, 4, 5, 6, 7]
_W_FIRST = [0, 1, 2, 3, 5, 6, 7, 4]
"""Columns of time, position and quaternion xyzw, where w is the last and where it is the first."""
_EUROC_COLUMNS = 17
"""time, position, quaternion, velocity and two biases: an EuRoC ground truth without its header."""


@dataclass(frozen=True, eq=False)
class RecordedTrajectory:
    """Poses of a camera at increasing times, interpolated between them."""

    path: str
    stamps_s: Float[Tensor, " N"]
    T_world_body: Float[Tensor, "N 4 4"]
    """Poses at these times, metres, float64."""
    T_body_cam: Float[Tensor, "4 4"]
    """From the camera's frame to that of the body whose poses these are."""
    max_gap_s: float
    notes: tuple[str, ...] = ()
    time_of_frame: Mapping[Any, float] = field(default_factory=dict)
    """``frame_key`` of an image -> time of its pose, seconds, where the file says which image a
    pose belongs to."""
    counts_frames: bool = False
    """The times only number the frames."""

    def pose_at(self, time_s: float) -> Float[Tensor, "4 4"] | None:
        """Camera-to-world pose, or None outside the recorded time and in a gap longer than
        ``max_gap_s``."""
        T = pose_at(self.stamps_s, self.T_world_body, time_s, max_gap_s=self.max_gap_s)
        return None if T is None else T @ self.T_body_cam


NOTE_ON_ORDER = "quaternions taken as x y z w; if w comes first: --pose-quaternions wxyz"


def read_trajectory(
    path: Path,
    *,
    time_unit: str = "auto",
    quaternions: str = "auto",
    max_gap_s: float = 0.2,
    T_body_cam: Float[Tensor, "4 4"] | None = None,
    frame_time_s: float | None = None,
) -> RecordedTrajectory:
    """Read poses ``T_world_body`` with times.

    Known: TUM text and ORB-SLAM3 ("t tx ty tz qx qy qz qw", seconds or nanoseconds), OKVIS2 csv
    (header, nanoseconds, xyzw), EuRoC csv (header, nanoseconds, wxyz), StrayScanner's odometry.csv,
    whose column "frame" numbers the images, and the world-to-camera poses of ARKitScenes (files
    ending in .traj). A header decides on the order of the columns. Rows with NaN or infinities are
    left out: tracking was lost.

    Args:
        path: The file.
        time_unit: Unit of its times; "auto" takes the unit in which they are dates of today, or in
            which they span ``frame_time_s``, or else the one in which the steps are those of a
            camera.
        quaternions: Their order where no header says it: "xyzw", "wxyz", or "auto" for xyzw and a
            note.
        max_gap_s: Largest gap to interpolate over, seconds.
        T_body_cam: From the camera's frame to the body's; the identity if the poses are those of
            the camera.
        frame_time_s: When the first frame was taken, seconds; None: unknown.

    Raises:
        SequenceError: no such file, no rows, a row that is not numeric, times that go back, two
            poses at one time that are far apart, or a quaternion whose length is not 1.
    """
    if path.suffix == ARKIT_SUFFIX:
        rows = _rows_of_arkit(
            read_rows(path, 7, "time, axis times angle and translation, 7 numbers")
        )
        frames = {}
        is_assumed = False
    else:
        rows, frames, is_assumed = _table(path, quaternions)
    table, notes = checked_rows(rows, path, ordered=True)
    if is_assumed and quaternions == "auto":
        notes.append(f"{path}: {NOTE_ON_ORDER}")
    if not len(table):
        raise SequenceError(f"{path} holds no finite pose; expected rows 't tx ty tz qx qy qz qw'")
    stamps = judge_stamps(table[:, 0].tolist())
    counts_frames = (
        time_unit == "auto" and frame_time_s is None and stamps.counts_frames and not frames
    )
    unit = time_unit
    if time_unit == "auto":
        unit = _unit_of(table[:, 0].tolist(), frame_time_s)
    time_of_frame = {key: time / PER_SECOND[unit] for key, time in frames.items()}
    if counts_frames:
        unit = "s"
        time_of_frame = {(int(t),): t for t in table[:, 0].tolist()}
        notes.append(
            f"{path}: {len(table)} poses, whose times number the frames: each goes to the image of "
            "its number"
        )
    elif frames:
        notes.append(
            f"{path}: {len(table)} poses, times read as {unit}; its column of frames says whose "
            "they are"
        )
    else:
        notes.append(f"{path}: {len(table)} poses, times read as {unit}")
    return RecordedTrajectory(
        path=str(path),
        stamps_s=(table[:, 0] / PER_SECOND[unit]).contiguous(),
        T_world_body=matrices(table[:, 1:]),
        T_body_cam=torch.eye(4, dtype=torch.float64) if T_body_cam is None else T_body_cam,
        max_gap_s=max_gap_s,
        notes=tuple(notes),
        time_of_frame=time_of_frame,
        counts_frames=counts_frames,
    )


def _unit_of(times: list[float], frame_time_s: float | None) -> str:
    """Unit of increasing times: that of their dates, the only one in which they are about a frame's
    time, or that of their steps."""
    dated_unit = date_unit(times[-1])
    if dated_unit or frame_time_s is None:
        return dated_unit or find_time_unit(times)
    margin = 0.1 * (times[-1] - times[0])
    first = times[0] - margin
    last = times[-1] + margin
    spanning = [unit for unit, n in PER_SECOND.items() if first <= frame_time_s * n <= last]
    return spanning[0] if len(spanning) == 1 else find_time_unit(times)


def _table(path: Path, quaternions: str) -> tuple[Float[Tensor, "N 8"], dict[Any, float], bool]:
    """Rows t tx ty tz qx qy qz qw in the file's unit of time, float64; the time of each frame that
    they name; and whether the order of the quaternions is that of ``quaternions``, because neither
    a header nor EuRoC's format says it."""
    lines = with_nan(read_text(path, "rows 't tx ty tz qx qy qz qw'")).splitlines()
    columns = None
    frame_column = None
    is_assumed = False
    text = ""
    rows: list[list[float]] = []
    time_of_frame: dict[Any, float] = {}
    for number, line in enumerate(lines, 1):
        check_decimal_points(line, path)
        check_direction(line, path)
        words = [w for w in re.split(r"[,\s]+", line.strip()) if w]
        if (
            not words
            or line.lstrip().startswith(("#", "%"))
            or (not rows and words[0][:1].isalpha())
        ):
            if not line.lstrip().startswith(("#", "%")):
                text = text or line.strip()
            if columns is None:
                columns = columns_of_header(line)
                frame_column = _frame_column(line) if columns else None
                check_order(columns, quaternions, path)
            continue
        if columns is None:
            is_euroc = len(words) == _EUROC_COLUMNS
            is_assumed = not is_euroc
            columns = _W_FIRST if is_euroc or quaternions == "wxyz" else _TUM
        try:
            rows.append([float(words[c]) for c in columns])
            if frame_column is not None:
                time_of_frame[frame_key(Path(words[frame_column]).stem)] = rows[-1][0]
        except (ValueError, IndexError):
            raise SequenceError(
                f"{path} line {number} must hold a time, a position and a quaternion in at least 8 "
                f"numbers, got {shown(line.strip())}; a file that names images instead of times "
                "needs lines 'name tx ty tz qx qy qz qw', or a header such as "
                "'name,tx,ty,tz,qw,qx,qy,qz'"
            ) from None
    if not rows:
        content = f"holds no row of numbers, but {shown(text)}" if text else "is empty"
        raise SequenceError(
            f"{path} {content}; expected rows 't tx ty tz qx qy qz qw', or 'name tx ty tz qx qy qz "
            "qw' for the image of that name"
        )
    return torch.tensor(rows, dtype=torch.float64), time_of_frame, is_assumed


def check_order(columns: list[int] | None, quaternions: str, path: Path) -> None:
    """Raise ``SequenceError`` where the columns of a header have another order of quaternions than
    the user gives."""
    if columns is None or quaternions == "auto":
        return
    told = "wxyz" if columns[7] < columns[4] else "xyzw"
    if told != quaternions:
        raise SequenceError(
            f"{path}: its header says that quaternions are {told}, but --pose-quaternions "
            f"{quaternions}; leave out the option, or the header"
        )


def names_in(header: str) -> list[str]:
    """Names of the columns in a header, in small letters, without units in brackets or behind an
    underline."""
    text = re.sub(r"\[[^\]]*\]|\([^)]*\)", "", header.strip().lstrip("#%").lower())
    words = text.replace(".", "_").split("," if "," in text else None)
    return [re.sub(r"_(mm?|cm|inch|ft|s|ns|us|ms)$", "", word.strip()) for word in words]


def columns_of_header(line: str) -> list[int] | None:
    """Columns of time, position and quaternion xyzw that a header names, if it names them all; the
    first column counts as time."""
    names = names_in(line)
    patterns = [*(rf"(t|p|p_.*_|){a}" for a in "xyz"), *(rf"q(_|_.*_|){a}" for a in "xyzw")]
    columns = [
        next(
            (i for i, n in enumerate(names) if re.fullmatch(p, n)),
            None,
        )
        for p in patterns
    ]
    return None if None in columns else [0, *(i for i in columns if i is not None)]


def _frame_column(line: str) -> int | None:
    """The column in which a header says that the number or name of an image stands (StrayScanner,
    RTAB-Map)."""
    names = names_in(line)
    return next(
        (
            i
            for i, n in enumerate(names)
            if re.fullmatch(r"(frame|image|node)(_?(id|number|index|name))?|id", n)
        ),
        None,
    )


def camera_in_body(T_cam_body: str, T_body_cam: str) -> Float[Tensor, "4 4"] | None:
    """From the camera's frame to the body's, from the file that is given; None if there is none."""
    if not T_cam_body and not T_body_cam:
        return None
    path = Path(T_cam_body or T_body_cam)
    T = read_matrix(path)
    return se3.inverse(T) if T_cam_body else T


def read_matrix(path: Path) -> Float[Tensor, "4 4"]:
    """A rigid 4x4 matrix of 16 numbers, row-major, whatever the brackets and commas around them.
    float64."""
    T = torch.tensor(
        read_numbers(path, "16 row-major numbers of a rigid transform"), dtype=torch.float64
    )
    if T.numel() != 16:
        raise SequenceError(
            f"{path} must hold 16 row-major numbers of a rigid transform, got {T.numel()}"
        )
    with refusing(f"{path} is not a rigid transform: "):
        check_pose("the transform", T.reshape(4, 4))
    return T.reshape(4, 4)


def read_numbers(path: Path, what: str) -> list[float]:
    """All numbers of a text file; brackets, commas and ``#`` comments are ignored."""
    lines = [line.split("#")[0] for line in with_nan(read_text(path, what)).splitlines()]
    for line in lines:
        check_decimal_points(line, path)
    words = " ".join(lines).translate(str.maketrans("[](){},;", "        ")).split()
    with parsing(path, what):
        return [float(w) for w in words]
