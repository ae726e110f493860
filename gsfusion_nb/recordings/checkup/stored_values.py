"""What files and values say: image sizes, pose matrices, time stamps, missing depth, codes for it,
and its unit."""

import contextlib
import itertools
import math
from collections import abc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig, TsdfConfig
from ...data.adjust.depth_range import DepthRange
from ...data.adjust.poses import raw_matrices
from ...data.lens import same_proportions
from ...data.recorded.images import read_depth, read_rgb
from ...data.recorded.poses import MAX_RIGIDITY_ERROR
from ...data.recorded.recorded_sequence import RecordedSequence
from ...data.sequence import Sequence
from ...errors import BadFrameError
from ..convert.depth_unit import USUAL, plausible_range
from .report import Finding
from .sample import FrameFacts, Sample

_TRIES = 5
_TIME_GAP = 5.0
"""A gap in time is reported if it is this many times the usual step."""


def examine_files(
    source: RecordedSequence, initial: RepairConfig
) -> tuple[RepairConfig, list[Finding]]:
    """Findings on sizes, matrices and times, and what must be repaired before frames can be read.

    Errors that ``initial`` already repairs are not reported.
    """
    repair, size = image_size(source)
    if initial.fit_sizes:
        repair = RepairConfig()
        size = replace(size, verdict="ok", repair="")
    if not source.has_poses:
        return repair, [size, *time_stamps(source)]
    matrices, poses = pose_matrices(raw_matrices(source.poses, initial))
    return replace(repair, **matrices.changes), [size, poses, *time_stamps(source)]  # pyright: ignore[reportArgumentType]


def image_size(source: RecordedSequence) -> tuple[RepairConfig, Finding]:
    """Finding: do colour, depth and intrinsics have the same size?"""
    rgb_size, depth_size = _stored_sizes(source)
    camera_size = (source.camera.width, source.camera.height)
    if rgb_size is None or depth_size is None:
        return RepairConfig(), Finding("image size", "ok", "No pair of images could be read.")
    sizes = {"colour": rgb_size, "depth": depth_size, "the intrinsics": camera_size}
    if len(set(sizes.values())) == 1:
        return RepairConfig(), Finding(
            "image size", "ok", f"All have {camera_size[0]}x{camera_size[1]} pixels."
        )
    text = f"The sizes differ: {', '.join(f'{name} {w}x{h}' for name, (w, h) in sizes.items())}."
    if not all(same_proportions(size, camera_size) for size in sizes.values()):
        flags = (
            "write colour, depth and intrinsics of one view (gsfusion-nb convert registers depth)"
        )
        text += " They have other proportions, so they are not one view at several resolutions."
        return RepairConfig(), Finding("image size", "wrong", text, repair=flags)
    repair = RepairConfig(fit_sizes=source.rectification is None)
    flags = repair.flags or "write intrinsics for the size of the images"
    return repair, Finding("image size", "wrong", text, repair=flags)


def pose_matrices(T_stored: Float[Tensor, "N 4 4"]) -> tuple[RepairConfig, Finding]:
    """Finding: are the matrices rigid, or do they become so when read by columns or with the
    nearest rotation?"""
    n = len(T_stored)
    name = "pose matrices"
    finite = T_stored[torch.isfinite(T_stored).all(dim=(1, 2))]
    n_lost = n - len(finite)
    if not len(finite):
        return RepairConfig(), Finding(name, "wrong", f"None of the {n} poses is finite.")
    columns = finite[:, 3, :3].abs().max() > 1e-6 > finite[:, :3, 3].abs().max()
    repair = RepairConfig(matrices="column_major" if columns else "row_major")
    R = raw_matrices(finite, repair)[:, :3, :3]
    determinant = torch.linalg.det(R)
    size = determinant.clamp_min(1e-12) ** (1 / 3)
    rigid = (_off_rotation(R) <= MAX_RIGIDITY_ERROR) & (determinant > 0)
    is_nearly_rigid = (_off_rotation(R / size[:, None, None]) < 0.2) & (determinant > 0)
    if not rigid.all() and is_nearly_rigid.all():
        repair = replace(repair, nearest_rotation=True)
    text = f"{float(rigid.float().mean()):.0%} of {n} poses are rigid" + (
        f", {n_lost} are missing" if n_lost else ""
    )
    if repair.changes:
        words = {
            "matrices": "stored column by column",
            "nearest_rotation": "scaled or rough rotations",
        }
        reasons = " and ".join(words[change] for change in repair.changes)
        return repair, Finding(name, "wrong", f"{text}; they are {reasons}.", repair.flags)
    if rigid.all() and not n_lost:
        return repair, Finding(name, "ok", f"{text}.")
    return repair, Finding(
        name, "doubtful", f"{text}. Frames without a pose are left out of the map."
    )


def _off_rotation(R: Float[Tensor, "N 3 3"]) -> Float[Tensor, " N"]:
    """Largest entry of R R^T - I."""
    return (R @ R.mT - torch.eye(3, dtype=R.dtype)).abs().amax(dim=(1, 2))


def time_stamps(source: RecordedSequence) -> list[Finding]:
    """Finding: do times increase without gaps?"""
    name = "time stamps"
    times = source.timestamps_s
    if source.no_times:
        return [Finding(name, "unknown", f"There are no times: {source.no_times}.")]
    steps = [b - a for a, b in itertools.pairwise(times)]
    if not steps:
        return []
    usual = sorted(steps)[len(steps) // 2]
    longest = max(steps)
    backward_steps = [i for i, dt in enumerate(steps) if dt <= 0]
    gaps = sum(usual > 0 and dt > _TIME_GAP * usual for dt in steps)
    if backward_steps:
        text = (
            f"Time does not increase after {len(backward_steps)} of {len(times)} frames, first "
            f"{backward_steps[0]}."
        )
        return [Finding(name, "wrong", text, "sort the frames by time in the recording's lists")]
    if gaps:
        place = f"the longest {longest:.3g} s after frame {steps.index(longest)}"
        text = f"{gaps} gaps in time, {place} (usual step {usual:.3g} s)."
        repair = (
            "nothing if there are no pose jumps; otherwise map the pieces separately: "
            "--data.start, --data.stop"
        )
        return [Finding(name, "doubtful", text, repair)]
    doubt = source.doubtful_times
    if doubt is not None:
        text = f"Times increase without gaps; {doubt.sentence}."
        return [Finding(name, "doubtful", text, doubt.remedy)]
    return [Finding(name, "ok", f"Times increase without gaps, one frame in {usual:.3g} s.")]


def _stored_sizes(
    source: RecordedSequence,
) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """(width, height) of the first colour and depth image that can be read."""

    def first(
        files: abc.Sequence[Path],
        read: Callable[[Path], Any],
    ) -> tuple[int, int] | None:
        for path in files[:_TRIES]:
            with contextlib.suppress(BadFrameError):
                height, width = read(path).shape[:2]
                return width, height
        return None

    return first(source.rgb_files, read_rgb), first(
        source.depth_files, partial(read_depth, scale=source.depth_scale)
    )


_CODE_SHARE = 5e-4
"""A value at the end of the range with this share of the valid pixels, far from all others, is a
code."""
_CODE_GAP = 1.3
"""A code at the far end is at least this many times the 99th percentile of the other depths."""
_MANY_MISSING = 0.5
_MOST_MISSING = 0.85
_SMALLEST_SCENE = 0.1
_LARGEST_SCENE = 2.0
"""A scene smaller or larger than the default range by such a factor needs voxels of another
size."""
DepthCode = tuple[float, bool]


def clear_codes(
    frames: abc.Sequence[FrameFacts], depth_scale: float | None
) -> tuple[list[DepthCode], Finding]:
    """Find values at either end of the range that many pixels have and that are far from all
    others: they mean "missing", and are set to missing in place.

    Returns:
        Each code in metres, with whether it is at the far end, and the finding.
    """
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in frames])
    codes: list[DepthCode] = []
    total = 0.0
    for high in (True, False):
        if len(values) < 1000:
            break
        end = float(values.max() if high else values.min())
        at_end = (values - end).abs() <= 1e-5 * end
        share = float(at_end.float().mean())
        others = values[~at_end]
        if share < _CODE_SHARE or not len(others):
            continue
        rest = _percentile(others, 0.99 if high else 0.01)
        if end > _CODE_GAP * rest if high else _CODE_GAP * end < rest:
            codes.append((end, high))
            values = others
            total = total + share
    for frame in frames:
        for value_m, _ in codes:
            is_code = (frame.depth_m - value_m).abs() <= 1e-5 * value_m
            frame.depth_m[is_code] = 0.0
            frame.missing += float(is_code.float().mean())
    if not codes:
        return codes, Finding("depth codes", "ok", 'No value but 0 stands for "missing".')
    codes_text = " and ".join(
        f"{v * depth_scale:.0f}" if depth_scale else f"{v:.4g} m" for v, _ in codes
    )
    text = (
        f"{total:.1%} of the pixels with depth hold {codes_text}: "
        'a code for "missing", not a distance.'
    )
    return codes, Finding("depth codes", "wrong", text)


def missing_finding(frames: abc.Sequence[FrameFacts], depth_factor: float = 1.0) -> Finding:
    """Finding: how much depth is missing, or outside of the range that is mapped after depth is
    multiplied by ``depth_factor``?"""
    shares = sorted(f.missing for f in frames)
    middle = shares[len(shares) // 2]
    most = shares[-1]
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in frames])
    near_m, median, far_m = (_percentile(values, q) for q in (0.01, 0.5, 0.99))
    text = (
        f"{middle:.0%} of the pixels have no depth (at most {most:.0%} in a frame); depths "
        f"{near_m:.2f} to {far_m:.2f} m, median {median:.2f} m."
    )
    range_finding = _range_finding(values * depth_factor, text)
    if range_finding is not None:
        return range_finding
    if middle <= _MANY_MISSING:
        return Finding("depth coverage", "ok", text)
    repair = (
        "stay within the sensor's range when recording; sunlight, glass and black surfaces "
        "give no depth"
    )
    return Finding(
        "depth coverage", "wrong" if middle > _MOST_MISSING else "doubtful", text, repair
    )


def _range_finding(depths_m: torch.Tensor, text: str) -> Finding | None:
    """A finding where much of the depth is outside of the range that is mapped by default; ``text``
    is its beginning."""
    tsdf = TsdfConfig()
    outside = DepthRange(near_m=tsdf.near_m, far_m=tsdf.far_m).outside(depths_m)
    if not outside.is_much:
        return None
    text = f"{text} By default, {outside.sentence}."
    ratio = outside.last_m / tsdf.far_m
    repair = f"map with {outside.flags}"
    if not _SMALLEST_SCENE < ratio < _LARGEST_SCENE:
        repair += f" --tsdf.voxel-size-m {max(0.001, ratio * tsdf.voxel_size_m):.1g}"
    return Finding("depth coverage", "doubtful", text, repair)


def _percentile(values: torch.Tensor, q: float) -> float:
    some = values[:: max(1, len(values) // 200_000)]
    return float(torch.quantile(some.double(), q)) if len(some) else float("nan")


def unit_finding(sample: Sample, base: Sequence) -> tuple[RepairConfig, Finding]:
    """Finding without poses: are the depths those of a hand-held camera in the unit as read?"""
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in sample.frames]).numpy()
    scale = base.depth_scale if isinstance(base, RecordedSequence) else 1.0
    stored_values = values * scale
    middle = float(np.median(values)) if len(values) else math.nan
    text = f"as read, the median depth is {middle:.2f} m"
    if plausible_range(scale, stored_values):
        text = f"The unit of depth cannot be known without poses; {text}, which is plausible."
        return RepairConfig(), Finding("depth scale", "unknown", text)
    text = f"The unit of depth is not plausible for a hand-held camera: {text}."
    factor = next(
        (scale / s for s in USUAL if s != scale and plausible_range(s, stored_values)),
        1.0,
    )
    repair = RepairConfig(depth_factor=factor)
    return repair, Finding(
        "depth scale", "doubtful", text, repair.flags or "give the unit in which depth is stored"
    )
