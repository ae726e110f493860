"""Camera poses from text, checked rigid: one matrix per line or file, lines that name an image, and
rows with times."""

import re
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...checks import check_pose, shown
from ...errors import ArgumentError, BadFrameError, SequenceError, refusing
from ...files import read_text
from ...geometry import quaternion
from ...geometry.operands import check_place
from .pose_headers import check_direction, check_metres, with_nan

GL_TO_CV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""T GL_TO_CV is a camera-to-world pose in OpenCV axes, where T has OpenGL's (y up, z backward)."""
MAX_RIGIDITY_ERROR = 1e-3
"""Largest entry of R R^T - I that still counts as a rotation: poses printed with 4 decimals
pass."""
REPEATED_POSE_M = 0.02
REPEATED_POSE_DEG = 2.0
"""Two poses at one time that differ by no more are measurements of one pose, as in TUM's
freiburg2_desk (1.2 mm)."""


def read_rows(path: Path, columns: int, what: str) -> Float[Tensor, "N C"]:
    """Numbers of a text file, one row per line; empty lines and lines starting with ``#`` are
    skipped. float64. [N, C]

    NaN and infinities are kept: they mark a pose as lost.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no rows, a row of another length, or
            text that is not a number.
    """
    rows = []
    for number, words in read_words(path, what):
        if len(words) != columns:
            raise SequenceError(
                f"{path} line {number} must hold {columns} numbers ({what}), got {len(words)}"
            )
        try:
            rows.append([float(w) for w in words])
        except ValueError:
            raise SequenceError(
                f"{path} line {number} must hold {columns} numbers ({what}), got text"
            ) from None
    return torch.tensor(rows, dtype=torch.float64)


def read_words(
    path: Path,
    what: str,
) -> list[tuple[int, list[str]]]:
    """Line number and words of every line that is neither empty nor a ``#`` comment. At least one,
    or an error."""
    return [(number, line.replace(",", " ").split()) for number, line in read_lines(path, what)]


def read_lines(path: Path, what: str) -> list[tuple[int, str]]:
    """Line number and text of every line that is neither empty nor a ``#`` comment. At least one,
    or an error, and none may say that poses are world-to-camera."""
    lines = []
    for number, line in enumerate(with_nan(read_text(path, what)).splitlines(), 1):
        line = line.strip()
        check_direction(line, path)
        if line.strip(" ,") and not line.startswith("#"):
            lines.append((number, line))
    if not lines:
        raise SequenceError(f"{path} is empty; expected {what}")
    check_decimal_points(lines[0][1], path)
    return lines


_DECIMAL_COMMAS = re.compile(r"(-?\d+(,\d+(e[-+]?\d+)?)?[\s;]+){3,}-?\d+(,\d+(e[-+]?\d+)?)?")


def check_decimal_points(line: str, path: Path) -> None:
    """Raise ``SequenceError`` for a line of numbers with decimal commas: read as separators they
    double the numbers."""
    if "," in line and _DECIMAL_COMMAS.fullmatch(line.strip()):
        raise SequenceError(
            f"{path} has decimal commas, {shown(line[:40])}; write decimal points, 1.5 instead of "
            "1,5"
        )


def write_pose_lines(path: Path, T_WC: Float[Tensor, "N 4 4"]) -> None:
    """Write ``poses.txt`` or ``traj.txt``: 16 row-major numbers per line."""
    poses = T_WC.double().flatten(1).tolist()
    lines = (" ".join(f"{value:.9g}" for value in pose) for pose in poses)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def checked_pose(T_WC: Float[Tensor, "4 4"], source: str) -> Float[Tensor, "4 4"]:
    """``T_WC`` as float32 if it is a rigid transform.

    Raises:
        BadFrameError: NaN, infinite (ScanNet marks lost tracking with -inf), not rigid, or too far
            away to be mapped; names ``source``.
    """
    if not bool(torch.isfinite(T_WC).all()):
        raise BadFrameError(
            f"{source} has NaN or infinite entries; expected a camera-to-world pose (tracking was "
            "lost?)"
        )
    with refusing(f"{source} is not a rigid camera-to-world pose: ", BadFrameError):
        check_pose("the pose", T_WC, MAX_RIGIDITY_ERROR)
    with refusing(error=BadFrameError):
        check_place(source, T_WC)
    return T_WC.to(torch.float32)


def checked_rows(
    table: Float[Tensor, "N 8"], path: Path, *, ordered: bool = False
) -> tuple[Float[Tensor, "M 8"], list[str]]:
    """Rows ``t tx ty tz qx qy qz qw`` in order of time, each time once, and sentences on what was
    left out.

    Where several rows have one time, the first counts: published trajectories hold such rows.

    Raises:
        SequenceError: a quaternion whose length is not 1 within 1e-2, two poses at one time that
            are farther apart than ``REPEATED_POSE_M`` or ``REPEATED_POSE_DEG``, or, if they must be
            ``ordered``, times that go back.
    """
    finite = torch.isfinite(table).all(dim=1)
    n_lost = int((~finite).sum())
    notes = [f"{path}: {n_lost} of {len(table)} poses are NaN and count as lost"] if n_lost else []
    table = table[finite]
    steps_back = (table[1:, 0] < table[:-1, 0]).nonzero()
    if len(steps_back) and ordered:
        i = int(steps_back[0])
        raise SequenceError(
            f"{path}: the time {float(table[i + 1, 0]):.9g} comes after {float(table[i, 0]):.9g}; "
            "expected increasing times: sort the file by its first column, and split it if it "
            "holds several trajectories"
        )
    length = table[:, 4:].norm(dim=1)
    bad = ((length - 1).abs() > 1e-2).nonzero()
    if len(bad):
        t = float(table[int(bad[0]), 0])
        wrong = float(length[int(bad[0])])
        raise SequenceError(
            f"{path}: the pose at {t:.16g} must hold a unit quaternion, got one of length "
            f"{wrong:.3g}; expected the columns t tx ty tz qx qy qz qw"
        )
    table = table[table[:, 0].argsort(stable=True)]
    repeats = table[1:, 0] == table[:-1, 0]
    if bool(repeats.any()):
        notes.append(_note_on_repeats(table, repeats, path))
    first_of_its_time = torch.cat([torch.ones(1, dtype=torch.bool), ~repeats])
    return (table[first_of_its_time] if len(table) else table), notes


def _note_on_repeats(
    table: Float[Tensor, "N 8"],
    repeats: Bool[Tensor, " M"],
    path: Path,
) -> str:
    """A sentence on the rows that have the time of the row before.

    Raises:
        SequenceError: two poses at one time that cannot be measurements of one.
    """
    first_rows = table[:-1][repeats]
    second_rows = table[1:][repeats]
    moved_m = (second_rows[:, 1:4] - first_rows[:, 1:4]).norm(dim=1)
    same_turn = (second_rows[:, 4:] * first_rows[:, 4:]).sum(dim=1).abs().clamp(max=1.0)
    turned_deg = torch.rad2deg(2 * torch.acos(same_turn))
    is_apart = (moved_m > REPEATED_POSE_M) | (turned_deg > REPEATED_POSE_DEG)
    if bool(is_apart.any()):
        i = int(is_apart.nonzero()[0])
        raise SequenceError(
            f"{path} has two poses at the time {float(first_rows[i, 0]):.16g}, "
            f"{float(moved_m[i]):.3g} m and {float(turned_deg[i]):.3g} degrees apart; expected one "
            "at each time: split the file if it holds several trajectories"
        )
    rows = f"{len(first_rows)} rows have" if len(first_rows) > 1 else "1 row has"
    note = f"{path}: {rows} the time of another row, the first at {float(first_rows[0, 0]):.16g}"
    if bool((first_rows != second_rows).any()):
        largest = f"{1000 * float(moved_m.max()):.2g} mm and {float(turned_deg.max()):.2g} degrees"
        note += f"; their poses differ by at most {largest}, and the first of each time is taken"
    return note


def matrices(rows: Float[Tensor, "N 7"]) -> Float[Tensor, "N 4 4"]:
    """Matrices of rows ``tx ty tz qx qy qz qw``. [N, 4, 4]"""
    T = torch.eye(4, dtype=rows.dtype).repeat(len(rows), 1, 1)
    T[:, :3, :3] = quaternion.to_matrix(rows[:, [6, 3, 4, 5]])
    T[:, :3, 3] = rows[:, :3]
    return T


def no_poses(n: int) -> Float[Tensor, "n 4 4"]:
    """Identities, for a recording that came without poses; float64."""
    return torch.eye(4, dtype=torch.float64).expand(n, 4, 4).clone()


POSE_LINE = "16 row-major numbers of a camera-to-world pose, or the name of an image and these"
_SUFFIXES = (".jpg", ".jpeg", ".png")
_WORDS_WITH_NAME = 1 + 16
"""The name of an image, and the numbers of a 4x4 pose."""


def split_name(line: str) -> tuple[str | None, list[str]]:
    """Name of the image without its suffix, or ``None``, and the words after it."""
    words = line.replace(",", " ").split()
    if len(words) != _WORDS_WITH_NAME:
        return None, words
    name = words[0]
    for suffix in _SUFFIXES:
        if name.lower().endswith(suffix):
            name = name[: -len(suffix)]
            break
    return name, words[1:]


def parsed_pose(words: list[str]) -> Float[Tensor, "4 4"]:
    """The pose that 16 words give row by row, float64; whether it is rigid is not looked at. Raises
    ``ValueError`` if they are not 16 numbers."""
    values = [float(word) for word in words]
    if len(values) != 16:
        raise ArgumentError(f"expected 16 numbers, got {len(values)}")
    return torch.tensor(values, dtype=torch.float64).reshape(4, 4)


def image_key(name: str) -> str:
    """What names of one image have in common: "12" is "000012"."""
    return str(int(name)) if name.isdecimal() else name


def image_number(image: Path) -> int | None:
    """The whole number at the end of an image's name, or ``None``."""
    match = re.search(r"\d+$", image.stem)
    return None if match is None else int(match[0])


def poses_of_images(path: Path, images: list[Path]) -> Float[Tensor, "N 4 4"]:
    """The pose of each image in a finished ``poses.txt``; float64, not yet checked. [N, 4, 4]

    Lines that begin with a name belong to the image of that name. Lines of numbers alone belong to
    the images in order, one each.

    Raises:
        SequenceError: a line that is not 16 numbers, an image without line, two lines of one name,
            or, where lines go by order, another number of lines than of images.
    """
    lines = [(number, split_name(" ".join(words))) for number, words in read_words(path, POSE_LINE)]
    check_metres(read_text(path, POSE_LINE).splitlines(), path)
    names = []
    rows = []
    for number, (name, words) in lines:
        try:
            rows.append(parsed_pose(words))
        except ValueError:
            got = f"{len(words)} words" if len(words) != 16 else "text"
            raise SequenceError(
                f"{path} line {number} must hold 16 numbers ({POSE_LINE}), got {got}"
            ) from None
        names.append(name)
    table = torch.stack(rows)
    if any(name is not None for name in names):
        return table[_lines_by_name(path, names, images)]
    if len(rows) != len(images):
        raise SequenceError(
            f"{path} holds {len(rows)} poses; expected {len(images)}, one per image in "
            f"{images[0].parent}; if images are missing, put the name of its image before each pose"
        )
    return table


def _lines_by_name(
    path: Path,
    names: list[str | None],
    images: list[Path],
) -> list[int]:
    line_of: dict[str, int] = {}
    for i, name in enumerate(names):
        if name is None:
            raise SequenceError(
                f"{path}: pose {i} has no name, but others have; expected a name on each line"
            )
        if image_key(name) in line_of:
            raise SequenceError(f"{path} holds two poses of {name}; expected one per image")
        line_of[image_key(name)] = i
    lacking = [image for image in images if image_key(image.stem) not in line_of]
    if lacking:
        raise SequenceError(f"{path} has no pose of {lacking[0]}; expected one per image")
    return [line_of[image_key(image.stem)] for image in images]
