"""What reads an input, and what nobody may accept without a word."""

import contextlib
import itertools
import json
import logging
import math
import re
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import alter
import torch

from gsfusion_nb.data import BadFrameError, SequenceError, open_sequence
from gsfusion_nb.errors import FORESEEN


class SilentAcceptance(Exception):
    """Something that is wrong was taken as right."""


class _Heard(logging.Handler):
    """Keeps what was said in the log: a warning that names the fault is not silent."""

    def __init__(self):
        super().__init__(logging.WARNING)
        self.sentences: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.sentences.append(record.getMessage())


HEARD = _Heard()


def _need(condition: bool, what: str) -> None:
    if not condition:
        raise SilentAcceptance(what)


def _check_times(times: list[float], notes: str = "") -> None:
    _need(all(math.isfinite(t) for t in times), "a time is not finite")
    said = notes + " ".join(HEARD.sentences)
    increasing = all(b > a for a, b in itertools.pairwise(times))
    _need(increasing or "time" in said, "times are equal or not in order")


def _check_frames(sequence: Any, at_most: int = 2) -> None:
    c = sequence.camera
    _need(
        all(math.isfinite(float(v)) for v in vars(c).values()) and min(c.fx, c.fy) > 0,
        f"the camera {c}",
    )
    error: BadFrameError | None = None
    for i in range(min(at_most, len(sequence))):
        try:
            frame = sequence[i]
        except BadFrameError as e:
            error = error or e
            continue
        T = frame.T_WC.double()
        _need(bool(torch.isfinite(T).all()), "a pose is not finite")
        gap = (T[:3, :3] @ T[:3, :3].T - torch.eye(3, dtype=torch.float64)).abs().max()
        _need(
            float(gap) < 2e-3 and float(torch.linalg.det(T[:3, :3])) > 0,
            "a pose is not rigid",
        )
        depth = frame.depth_m
        _need(
            bool(torch.isfinite(depth).all()) and float(depth.min()) >= 0,
            "depth is not finite or negative",
        )
    if error is not None:
        raise error


def sequence(path: Path) -> None:
    opened = open_sequence(path)
    source: Any = opened.source
    _check_times(list(getattr(source, "timestamps_s", ())))
    _check_frames(source)


def growing(path: Path) -> None:
    from gsfusion_nb.data.stream import GrowingFolder

    (path / "stop").touch()
    frames = GrowingFolder(path, poll_s=0.001, idle_s=0.01, patience_s=0.0)
    error = None
    while True:
        try:
            frame = next(frames)
        except StopIteration:
            break
        except BadFrameError as e:
            error = e
            continue
        _need(bool(torch.isfinite(frame.T_WC).all()), "a pose is not finite")
    if error is not None:
        raise error


def convert(path: Path) -> None:
    from gsfusion_nb.data import folder
    from gsfusion_nb.recordings import convert as converters

    out = path.parent / "converted-by-the-campaign"
    if out.is_relative_to(path) or out.exists():
        shutil.rmtree(out, ignore_errors=True)
    report = converters.convert(path, out)
    made = folder(out, poses=(out / "poses.txt").exists())
    rows = (out / "times.txt").read_text().splitlines()[1:]
    notes = " ".join([*report.notes, *report.examples, *report.dropped])
    _check_times(
        [float(row.split()[1]) for row in rows if not row.endswith("nan")],
        notes,
    )
    _check_frames(made)


def trajectory(path: Path) -> None:
    from gsfusion_nb.recordings.convert import read_trajectory

    made = read_trajectory(path)
    _check_times(made.stamps_s.tolist(), " ".join(made.notes))
    _need(bool(torch.isfinite(made.T_world_body).all()), "a pose is not finite")


def run_trajectory(path: Path) -> None:
    from gsfusion_nb.export import read_trajectory_tum

    times, poses = read_trajectory_tum(path)
    _check_times(times)
    _need(bool(torch.isfinite(poses).all()), "a pose is not finite")


def intrinsics(path: Path) -> None:
    from gsfusion_nb.recordings.convert.intrinsics import read_intrinsics

    model = read_intrinsics(str(path), (24, 18))
    values = [*map(float, vars(model.camera).values()), *model.distortion]
    _need(all(map(math.isfinite, values)), f"the camera {model}")


def matrix(path: Path) -> None:
    from gsfusion_nb.recordings.convert.trajectory import read_matrix

    _need(bool(torch.isfinite(read_matrix(path)).all()), "a matrix is not finite")


def gaussians(path: Path) -> None:
    from gsfusion_nb.export import read_gaussian_ply

    columns = vars(read_gaussian_ply(path))
    for name, column in columns.items():
        _need(bool(torch.isfinite(column).all()), f"{name} is not finite")
    _need(len({len(c) for c in columns.values()}) == 1, "columns of different lengths")


def mesh(path: Path) -> None:
    from gsfusion_nb.export import read_mesh_ply

    made = read_mesh_ply(path)
    _need(bool(torch.isfinite(made.vertices_W).all()), "a vertex is not finite")
    if made.faces.numel():
        low = int(made.faces.min())
        high = int(made.faces.max())
        _need(low >= 0 and high < len(made.vertices_W), "a face of a vertex that is not there")


def resume(path: Path) -> None:
    """Load a run, look at its maps, and let it go on."""
    from gsfusion_nb.backends import use_backend
    from gsfusion_nb.runs.resume import load_run

    with use_backend("numba"):
        run = load_run(path)
        _look_at(run.mapper)
        for steps in (run.online(), run.optimise()):
            _go_on(path, steps)


def _look_at(mapper: Any) -> None:
    """The maps and the keyframes have values that can be."""
    for name, table in mapper.files.maps().items():
        for column in table.values():
            finite = bool(torch.isfinite(column.float()).all())
            _need(
                finite or any("NaN" in note for note in mapper.notes),
                f"{name} is not finite",
            )
    states = getattr(mapper.gaussians, "state", torch.zeros(0))
    _need(
        bool(((states == 0) | (states == 1)).all()),
        "a state that there is not",
    )
    for keyframe in mapper.keyframes:
        _need(
            keyframe.rgb_u8.shape[:2] == (keyframe.camera.height, keyframe.camera.width),
            "a keyframe's size",
        )
        _need(bool(torch.isfinite(keyframe.T_WC).all()), "a keyframe's pose is not finite")


def _go_on(path: Path, steps: Iterable[Any]) -> None:
    """Take the first step."""
    try:
        next(iter(steps), None)
    except Exception as e:
        if not isinstance(e, FORESEEN):
            raise
        raise SequenceError(f"{path}: {e}") from e


def onto(path: Path) -> None:
    """Go on in the map of a run: load it, look at it, optimise it, and look for a place in it."""
    from gsfusion_nb.backends import use_backend
    from gsfusion_nb.runs.onto import mapper_onto, read_parent, settings_onto

    with use_backend("numba"):
        parent = read_parent(path)
        mapper = mapper_onto(parent, settings_onto(parent.config))
        _look_at(mapper)
        frame = open_sequence(**parent.document["source"], data=mapper.config.data).mapping[0]
        with contextlib.suppress(BadFrameError):  # too small to be located
            mapper.step(frame)
        _go_on(path, mapper.global_optimise(1))


ALTERATION = "alteration.json"
"""File beside an altered run that says what is wrong with it."""


def altered(path: Path) -> None:
    """A checkpoint with right checksums and one wrong thing."""
    _judge_alteration(path, resume)


def altered_tsdf(path: Path) -> None:
    """A TSDF with one wrong thing."""
    _judge_alteration(path, rescore)


def altered_onto(path: Path) -> None:
    """Places, or the state of a map, with one wrong thing."""
    _judge_alteration(path, onto)


def _judge_alteration(path: Path, read: Callable[[Path], None]) -> None:
    known = alter.Alteration.read(path.parent / ALTERATION)
    try:
        read(path)
    except SilentAcceptance as e:
        raise SilentAcceptance(f"{known}: {e}") from None
    except Exception as e:
        if known == alter.UNALTERED:
            raise AssertionError("what a run wrote was refused") from e
        raise
    _need(not known.wrong, f"taken as right: {known}")


def settings(path: Path) -> None:
    from gsfusion_nb.cli.run_settings import read_settings

    read_settings(path, rule=None)


def rescore(path: Path) -> None:
    from gsfusion_nb.backends import use_backend
    from gsfusion_nb.runs import rescore as score_again

    with use_backend("numba"):
        score_again(path)


def archive(path: Path) -> None:
    from gsfusion_nb.recordings.unpack import unpack

    folder = path.parent / "unpacked-by-the-campaign"
    unpack(path, folder)
    inside = {p.resolve() for p in folder.rglob("*")}
    _need(all(p.is_relative_to(folder.resolve()) for p in inside), "a member outside of the folder")
    shutil.rmtree(folder)


TARGETS: dict[str, Callable[[Path], None]] = {
    f.__name__: f
    for f in (
        sequence,
        growing,
        convert,
        trajectory,
        run_trajectory,
        intrinsics,
        matrix,
        gaussians,
        mesh,
    )
} | {
    f.__name__: f for f in (resume, settings, rescore, archive, altered, altered_tsdf, altered_onto)
}
CORRECTED = ("growing", "resume", "altered", "altered_tsdf", "altered_onto")
"""Targets that continue without a damaged file: a folder may still grow."""


def strict_json_fault(path: Path) -> str:
    """What is ambiguous in a JSON file, by other means than the toolkit's."""

    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(items)) != len(items):
            raise ValueError("equal keys")
        return dict(items)

    def constant(text: str) -> Any:
        raise ValueError(text)

    try:
        text = path.read_text(encoding="utf-8-sig")
        if re.search(r"(?<![\w.\"])-?\d{300}", text):
            return "a number of 300 digits"
        json.loads(text, object_pairs_hook=pairs, parse_constant=constant)
    except (ValueError, RecursionError, OSError) as e:
        return str(e)[:80]
    return ""
