"""Checks on the files before frames are read: image sizes, pose matrices, time stamps."""

import itertools
import math
import re
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...data.adjust.poses import raw_matrices
from ...data.recorded.images import read_depth, read_rgb
from ...data.recorded.poses import MAX_RIGIDITY_ERROR
from ...data.recorded.recorded_sequence import RecordedSequence
from ...data.sequence import BadFrameError
from .findings import Finding

_TRIES = 5
_TIME_GAP = 5.0
"""A gap in time is reported if it is this many times the usual step."""


def examine_files(source: RecordedSequence, given: RepairConfig) -> tuple[RepairConfig, list[Finding]]:
    """Findings on sizes, matrices and times, and what must be repaired before frames can be read.

    Errors that ``given`` already repairs are not reported.
    """
    repair, size = image_size(source)
    if given.fit_sizes:
        repair, size = RepairConfig(), replace(size, verdict="ok", repair="")
    if not source.has_poses:
        return repair, [size, *time_stamps(source)]
    matrices, poses = pose_matrices(raw_matrices(source.poses, given))
    return replace(repair, **matrices.changes), [size, poses, *time_stamps(source)]  # pyright: ignore[reportArgumentType]


def image_size(source: RecordedSequence) -> tuple[RepairConfig, Finding]:
    """Finding: do colour, depth and intrinsics have the same size?"""
    rgb_size, depth_size = _stored_sizes(source)
    expected = source.stored_size or (source.camera.width, source.camera.height)
    if rgb_size is None or depth_size is None:
        return RepairConfig(), Finding(name="image size", verdict="ok", sentence="No pair of images could be read.")
    sizes = {"colour": rgb_size, "depth": depth_size, "the intrinsics": expected}
    numbers = {
        f"{name.removeprefix('the ')}_{side}": float(v)
        for name, s in sizes.items()
        for side, v in zip(("width", "height"), s, strict=True)
    }
    if len(set(sizes.values())) == 1:
        return RepairConfig(), Finding(
            name="image size",
            verdict="ok",
            numbers=numbers,
            sentence=f"Colour, depth and intrinsics are all {expected[0]}x{expected[1]}.",
        )
    described = ", ".join(f"{name} {w}x{h}" for name, (w, h) in sizes.items())
    fits = source.rectify is None
    aspect = max(w / h for w, h in sizes.values()) / min(w / h for w, h in sizes.values())
    note = "" if aspect < 1.01 else " Their proportions differ too: one of them is cropped, so check the registration."
    repair = RepairConfig(fit_sizes=True) if fits else RepairConfig()
    return repair, Finding(
        name="image size",
        verdict="wrong",
        numbers=numbers,
        repair=repair.flags or "write intrinsics for the size of the images",
        sentence=f"The sizes differ: {described}.{note}",
    )


def pose_matrices(stored: Float[Tensor, "N 4 4"]) -> tuple[RepairConfig, Finding]:
    """Finding: are the matrices rigid, or do they become so when read by columns or with the nearest rotation?"""
    n = len(stored)
    known = stored[torch.isfinite(stored).all(dim=(1, 2))]
    lost = n - len(known)
    if not len(known):
        return RepairConfig(), Finding(
            name="pose matrices", verdict="wrong", sentence=f"None of the {n} poses is finite."
        )
    shares = _rigid_shares(known)
    best, as_stored = max(shares, key=lambda o: shares[o] - 0.01 * len(o.changes)), shares[RepairConfig()]
    scale = _scale(known)
    numbers = {"rigid_share": as_stored, "lost_share": lost / n, "scale": scale}
    text = f"{as_stored:.0%} of {n} poses are rigid" + (f", {lost} are missing (NaN or infinite)" if lost else "")
    if best == RepairConfig():
        bad = shares[best] < 1 or lost
        return best, Finding(
            name="pose matrices",
            verdict="doubtful" if bad else "ok",
            numbers=numbers,
            sentence=f"{text}." + (" Frames without a pose are left out of the map." if bad else ""),
        )
    reasons = []
    if best.matrices == "column_major":
        reasons.append("all are when read by columns: the 16 numbers are stored column by column")
    if best.nearest_rotation:
        reasons.append(f"their rotations are scaled by {scale:.4g} or not quite orthogonal")
    return best, Finding(
        name="pose matrices",
        verdict="wrong",
        numbers=numbers,
        repair=best.flags,
        sentence=f"{text}; {' and '.join(reasons)}.",
    )


def time_stamps(source: RecordedSequence) -> list[Finding]:
    """Finding: do times and file numbers increase without gaps?"""
    if source.no_times:
        return [_without_times(source)]
    times = source.timestamps_s
    steps = [b - a for a, b in itertools.pairwise(times)]
    if not steps:
        return []
    usual = sorted(steps)[len(steps) // 2]
    backward = [i for i, dt in enumerate(steps) if dt <= 0]
    gaps = [i for i, dt in enumerate(steps) if usual > 0 and dt > _TIME_GAP * usual]
    numbers = {
        "usual_step_s": usual,
        "longest_step_s": max(steps),
        "gaps": float(len(gaps)),
        "not_increasing": float(len(backward)),
    }
    if backward:
        return [
            Finding(
                name="time stamps",
                verdict="wrong",
                numbers=numbers,
                repair="sort the frames by time in the recording's lists",
                sentence=f"Time does not increase after {len(backward)} of {len(times)} frames, first {backward[0]}.",
            )
        ]
    missing = _numbers_left_out(source)
    if gaps or missing:
        place = f", the longest {max(steps):.3g} s after frame {steps.index(max(steps))}" if gaps else ""
        text = f"{len(gaps)} gaps in time{place} (usual step {usual:.3g} s)" if gaps else ""
        text += f"{'; ' if text else ''}{missing} numbers are missing in the file names" if missing else ""
        return [
            Finding(
                name="time stamps",
                verdict="doubtful",
                numbers=numbers | {"numbers_left_out": float(missing)},
                repair=(
                    "nothing if there are no pose jumps; otherwise map the pieces separately: --data.start, --data.stop"
                ),
                sentence=f"{text}.",
            )
        ]
    rate = f"{1 / usual:.3g} frames per second" if usual > 0 else "one time for all"
    apart = (
        f"; colour and depth have times {1000 * source.stamps_apart_s:.1f} ms apart" if source.stamps_apart_s else ""
    )
    text = f"Times increase without gaps, {rate}{apart}."
    numbers["stamps_apart_s"] = source.stamps_apart_s
    return [Finding(name="time stamps", verdict="ok", numbers=numbers, sentence=text)]


def _without_times(source: RecordedSequence) -> Finding:
    """Finding for a recording whose frames have an order, but no times."""
    missing = _numbers_left_out(source)
    text = f"There are no times: {source.no_times}. Frames are taken in the order of their names"
    unknown = "the frame rate and gaps in time cannot be known"
    if missing:
        return Finding(
            name="time stamps",
            verdict="doubtful",
            numbers={"numbers_left_out": float(missing)},
            repair="nothing if there are no pose jumps; otherwise map the pieces separately: --data.start, --data.stop",
            sentence=f"{text}; {missing} numbers are missing in the file names, and {unknown}.",
        )
    return Finding(name="time stamps", verdict="unknown", sentence=f"{text}; {unknown}.")


def _stored_sizes(source: RecordedSequence) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """(width, height) of the first colour and depth image that can be read."""
    found: list[tuple[int, int] | None] = []
    readers = (read_rgb, lambda path: read_depth(path, scale=source.depth_scale))
    for files, read in zip((source.rgb_files, source.depth_files), readers, strict=True):
        size = None
        for path in files[:_TRIES]:
            try:
                height, width = read(path).shape[:2]
            except BadFrameError:
                continue
            size = (width, height)
            break
        found.append(size)
    return found[0], found[1]


def _rigid_shares(stored: Float[Tensor, "N 4 4"]) -> dict[RepairConfig, float]:
    """Share of the matrices that are rigid when read in each of the possible ways, the way they are stored first."""
    shares = {}
    for nearest in (False, True):
        for matrices in ("row_major", "column_major"):
            option = RepairConfig(matrices=matrices, nearest_rotation=nearest)
            shares[option] = float(_rigid(raw_matrices(stored, option)).float().mean())
            if nearest:  # it always exists: accepted only for matrices that are rotations up to scale and noise
                as_read = raw_matrices(stored, RepairConfig(matrices=matrices))
                shares[option] *= float(_nearly_rotation(as_read).float().mean())
    return shares


def _rigid(T: Float[Tensor, "N 4 4"]) -> Tensor:
    R = T[:, :3, :3]
    error = (R @ R.transpose(1, 2) - torch.eye(3, dtype=T.dtype)).abs().amax(dim=(1, 2))
    bottom = (T[:, 3] - T.new_tensor([0.0, 0, 0, 1])).abs().amax(1)
    return (error <= MAX_RIGIDITY_ERROR) & (bottom <= MAX_RIGIDITY_ERROR) & (torch.linalg.det(R) > 0)


def _nearly_rotation(T: Float[Tensor, "N 4 4"]) -> Tensor:
    """Whether a matrix is orthogonal up to scale, within 0.2 per entry, not mirrored, with the bottom row of a pose."""
    R = T[:, :3, :3]
    determinant = torch.linalg.det(R)
    scale = determinant.clamp_min(1e-12) ** (1 / 3)
    R = R / scale[:, None, None]
    error = (R @ R.transpose(1, 2) - torch.eye(3, dtype=T.dtype)).abs().amax(dim=(1, 2))
    return (error < 0.2) & (determinant > 0) & (T[:, 3, :3].abs().amax(1) < 1e-6)


def _scale(T: Float[Tensor, "N 4 4"]) -> float:
    """Median scale of the rotations."""
    determinant = float(torch.linalg.det(T[:, :3, :3]).median())
    return math.copysign(abs(determinant) ** (1 / 3), determinant)


def _numbers_left_out(source: RecordedSequence) -> int:
    """Numbers missing among the colour files' names, in units of their usual step; 0 if the names are not numbers."""
    numbers = [re.search(r"(\d+)$", p.stem) for p in source.rgb_files]
    if not all(numbers) or len(numbers) < 3:
        return 0
    values = [int(m[1]) for m in numbers if m]
    if max(values) > 10**9:  # times, not frame numbers
        return 0
    steps = [b - a for a, b in itertools.pairwise(values)]
    usual = max(1, sorted(steps)[len(steps) // 2])
    return sum(max(0, round(s / usual) - 1) for s in steps)
