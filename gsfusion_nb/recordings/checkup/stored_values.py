"""What files and values say: image sizes, pose matrices, time stamps, missing depth, codes for it, and its unit."""

import contextlib
import itertools
import math
import re
from collections import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...data.adjust.poses import raw_matrices
from ...data.recorded.images import read_depth, read_rgb
from ...data.recorded.poses import MAX_RIGIDITY_ERROR
from ...data.recorded.recorded_sequence import RecordedSequence
from ...data.sequence import BadFrameError, Sequence
from ..convert.depth_unit import USUAL, plausible_range
from .report import Finding
from .sample import FrameFacts, Sample

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
    expected = (source.camera.width, source.camera.height)
    if rgb_size is None or depth_size is None:
        return RepairConfig(), Finding("image size", "ok", "No pair of images could be read.")
    sizes = {"colour": rgb_size, "depth": depth_size, "the intrinsics": expected}
    numbers = {}
    for name, (width, height) in sizes.items():
        name = name.removeprefix("the ")
        numbers |= {f"{name}_width": float(width), f"{name}_height": float(height)}
    if len(set(sizes.values())) == 1:
        text = f"Colour, depth and intrinsics are all {expected[0]}x{expected[1]}."
        return RepairConfig(), Finding("image size", "ok", text, numbers)
    described = ", ".join(f"{name} {w}x{h}" for name, (w, h) in sizes.items())
    aspect = max(w / h for w, h in sizes.values()) / min(w / h for w, h in sizes.values())
    note = "" if aspect < 1.01 else " Their proportions differ too: one of them is cropped, so check the registration."
    repair = RepairConfig(fit_sizes=source.rectify is None)
    flags = repair.flags or "write intrinsics for the size of the images"
    return repair, Finding("image size", "wrong", f"The sizes differ: {described}.{note}", numbers, flags)


def pose_matrices(stored: Float[Tensor, "N 4 4"]) -> tuple[RepairConfig, Finding]:
    """Finding: are the matrices rigid, or do they become so when read by columns or with the nearest rotation?"""
    n, name = len(stored), "pose matrices"
    known = stored[torch.isfinite(stored).all(dim=(1, 2))]
    lost = n - len(known)
    if not len(known):
        return RepairConfig(), Finding(name, "wrong", f"None of the {n} poses is finite.")
    shares = _rigid_shares(known)
    best, as_stored = max(shares, key=lambda o: shares[o] - 0.01 * len(o.changes)), shares[RepairConfig()]
    scale = _scale(known)
    numbers = {"rigid_share": as_stored, "lost_share": lost / n, "scale": scale}
    text = f"{as_stored:.0%} of {n} poses are rigid" + (f", {lost} are missing (NaN or infinite)" if lost else "")
    if best == RepairConfig() and shares[best] == 1 and not lost:
        return best, Finding(name, "ok", f"{text}.", numbers)
    if best == RepairConfig():
        return best, Finding(name, "doubtful", f"{text}. Frames without a pose are left out of the map.", numbers)
    reasons = []
    if best.matrices == "column_major":
        reasons.append("all are when read by columns: the 16 numbers are stored column by column")
    if best.nearest_rotation:
        reasons.append(f"their rotations are scaled by {scale:.4g} or not quite orthogonal")
    return best, Finding(name, "wrong", f"{text}; {' and '.join(reasons)}.", numbers, best.flags)


_PIECES = "nothing if there are no pose jumps; otherwise map the pieces separately: --data.start, --data.stop"


def time_stamps(source: RecordedSequence) -> list[Finding]:
    """Finding: do times and file numbers increase without gaps?"""
    name, missing, times = "time stamps", _numbers_left_out(source), source.timestamps_s
    left_out = f"{missing} numbers are missing in the file names"
    if source.no_times:
        text = f"There are no times: {source.no_times}. Frames are taken in the order of their names"
        unknown = "the frame rate and gaps in time cannot be known."
        if missing:
            numbers = {"numbers_left_out": float(missing)}
            return [Finding(name, "doubtful", f"{text}; {left_out}, and {unknown}", numbers, _PIECES)]
        return [Finding(name, "unknown", f"{text}; {unknown}")]
    steps = [b - a for a, b in itertools.pairwise(times)]
    if not steps:
        return []
    usual, longest = sorted(steps)[len(steps) // 2], max(steps)
    backward = [i for i, dt in enumerate(steps) if dt <= 0]
    gaps = [i for i, dt in enumerate(steps) if usual > 0 and dt > _TIME_GAP * usual]
    numbers = {"usual_step_s": usual, "longest_step_s": longest}
    numbers |= {"gaps": float(len(gaps)), "not_increasing": float(len(backward))}
    if backward:
        text = f"Time does not increase after {len(backward)} of {len(times)} frames, first {backward[0]}."
        return [Finding(name, "wrong", text, numbers, "sort the frames by time in the recording's lists")]
    if gaps or missing:
        place = f", the longest {longest:.3g} s after frame {steps.index(longest)}" if gaps else ""
        parts = [f"{len(gaps)} gaps in time{place} (usual step {usual:.3g} s)"] if gaps else []
        text = "; ".join([*parts, *([left_out] if missing else [])])
        numbers["numbers_left_out"] = float(missing)
        return [Finding(name, "doubtful", f"{text}.", numbers, _PIECES)]
    rate = f"{1 / usual:.3g} frames per second" if usual > 0 else "one time for all"
    apart = (
        f"; colour and depth have times {1000 * source.stamps_apart_s:.1f} ms apart" if source.stamps_apart_s else ""
    )
    numbers["stamps_apart_s"] = source.stamps_apart_s
    return [Finding(name, "ok", f"Times increase without gaps, {rate}{apart}.", numbers)]


def _stored_sizes(source: RecordedSequence) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """(width, height) of the first colour and depth image that can be read."""

    def first(files: abc.Sequence[Path], read: Callable[[Path], Any]) -> tuple[int, int] | None:
        for path in files[:_TRIES]:
            with contextlib.suppress(BadFrameError):
                height, width = read(path).shape[:2]
                return width, height
        return None

    return first(source.rgb_files, read_rgb), first(source.depth_files, partial(read_depth, scale=source.depth_scale))


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


_CODE_SHARE = 5e-4
"""A value at the end of the range with this share of the valid pixels, far from all others, is a code."""
_CODE_GAP = 1.3
"""A code at the far end is at least this many times the 99th percentile of the other depths."""
_MANY_MISSING, _MOST_MISSING = 0.5, 0.85


@dataclass(frozen=True, kw_only=True)
class DepthCode:
    """A depth value that means "missing"."""

    value_m: float
    share: float
    """Share of all valid pixels."""
    high: bool
    """Whether it is at the far end of the range; else it is at the near end."""


def find_codes(frames: abc.Sequence[FrameFacts]) -> list[DepthCode]:
    """Values at either end of the range that many pixels have and that are far from all others."""
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in frames]) if frames else torch.zeros(0)
    found = []
    for high in (True, False):
        if len(values) < 1000:
            break
        end = values.max() if high else values.min()
        at_end = (values - end).abs() <= 1e-5 * end
        share = float(at_end.float().mean())
        others = values[~at_end]
        if share < _CODE_SHARE or not len(others):
            continue
        rest = _percentile(others, 0.99 if high else 0.01)
        if (float(end) > _CODE_GAP * rest) if high else (_CODE_GAP * float(end) < rest):
            found.append(DepthCode(value_m=float(end), share=share, high=high))
            values = others
    return found


def clear_codes(frames: abc.Sequence[FrameFacts], codes: abc.Sequence[DepthCode]) -> None:
    """Set pixels with a code to missing, in place."""
    for frame in frames:
        for code in codes:
            frame.depth_m[(frame.depth_m - code.value_m).abs() <= 1e-5 * code.value_m] = 0.0
        frame.missing = float((frame.depth_m <= 0).float().mean())


def code_finding(codes: abc.Sequence[DepthCode], depth_scale: float | None, repair: str) -> Finding:
    """Finding: are there codes besides 0?"""
    if not codes:
        return Finding("depth codes", "ok", 'No value but 0 stands for "missing".')
    parts = []
    for code in codes:
        stored = f"{code.value_m * depth_scale:.0f}, read as " if depth_scale else ""
        value = f"{stored}{code.value_m:.4g} m"
        parts.append(f"{code.share:.1%} of the pixels with depth hold {value}, far from all other depths")
    numbers = {"share": sum(c.share for c in codes), "value_m": codes[0].value_m}
    text = f'{"; ".join(parts)}: a code for "missing", not a distance.'
    return Finding("depth codes", "wrong", text, numbers, repair)


def missing_finding(frames: abc.Sequence[FrameFacts]) -> Finding:
    """Finding: how much depth is missing?"""
    shares = sorted(f.missing for f in frames)
    middle, most = shares[len(shares) // 2], shares[-1]
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in frames])
    near, median, far = (_percentile(values, q) for q in (0.01, 0.5, 0.99))
    numbers = {"missing_median": middle, "missing_most": most, "near_m": near, "median_m": median, "far_m": far}
    text = (
        f"{middle:.0%} of the pixels have no depth (at most {most:.0%} in a frame); depths {near:.2f} to {far:.2f} m, "
        f"median {median:.2f} m."
    )
    if middle <= _MANY_MISSING:
        return Finding("depth coverage", "ok", text, numbers)
    repair = (
        "maps will have holes; when recording, stay within the sensor's range and avoid sunlight, glass and black "
        "surfaces"
    )
    return Finding("depth coverage", "wrong" if middle > _MOST_MISSING else "doubtful", text, numbers, repair)


def _percentile(values: torch.Tensor, q: float) -> float:
    some = values[:: max(1, len(values) // 200_000)]
    return float(torch.quantile(some.double(), q)) if len(some) else float("nan")


def pose_finding() -> Finding:
    """Finding: there are no poses, so nothing that needs them is judged."""
    text = (
        "The recording has no poses. Their direction, axes, time and jumps, the intrinsics, and whether depth images "
        "agree, cannot be known; they are not judged here."
    )
    return Finding("poses", "unknown", text, repair="--tracking.poses tracked --reader poses=false")


def unit_finding(sample: Sample, base: Sequence) -> Finding:
    """Finding without poses: are the depths those of a hand-held camera in the unit as read?"""
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in sample.frames]).numpy()
    low, middle, high = (float(np.percentile(values, q)) if len(values) else float("nan") for q in (1, 50, 95))
    text = f"as read, depths are {low:.2f} to {high:.2f} m, median {middle:.2f} m"
    scale = base.depth_scale if isinstance(base, RecordedSequence) else 1.0
    stored = values * scale
    if plausible_range(scale, stored):
        text = f"The unit of depth cannot be known without poses; {text}, which is plausible."
        return Finding("depth scale", "unknown", text, {"factor": 1.0})
    text = f"The unit of depth is not plausible for a hand-held camera: {text}"
    others = [s for s in USUAL if s != scale and plausible_range(s, stored)]
    if not others:
        repair = "give the unit in which depth is stored"
        return Finding("depth scale", "doubtful", f"{text}.", {"factor": 1.0}, repair)
    factor = scale / others[0]
    text += f"; with {others[0]:g} units a metre the median is {middle * factor:.2f} m."
    return Finding("depth scale", "doubtful", text, {"factor": factor}, f"--data.repair.depth-factor {factor:g}")
