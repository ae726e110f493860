"""How much later or earlier than its pose each picture was taken, from the pictures and the poses alone.

Two pictures a few frames apart, the depth of the first, and direct image alignment give how the camera turned between
them. If the pictures are delta seconds late, that differs from what the poses say by e = delta J, where J is the change
of the poses' angular velocity between the two times. Least squares of e over J would be wrong: errors of single poses
are in e and in J, and where the camera turns evenly there is nothing else in J. So both are weighed by Z, the same
change as the pictures show it, in which no pose has a part (instrumental variables):

    delta = sum(Z e) / sum(Z J)

Its error comes from the scatter between stretches of the recording. Where the camera hardly changes its turning, the
denominator is not surely different from zero, and delta cannot be known.
"""

import itertools
import math
from collections import abc
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...data.adjust.depth_agreement import relative_poses
from ...data.adjust.poses import PosePath, times_of
from ...data.sequence import Sequence
from ...files import SequenceError
from ...geometry import pixel_grid, rays, se3
from ...types import Camera
from .sample import FrameFacts, Sample, read_sample
from .sample import places as places_to_read

FRAMES = 124
"""Frames that are read: four windows."""
_GAPS = (1, 2, 4)
"""Frames between the two of a pair."""
_TOGETHER = 8
"""So many frames after each other err together; the scatter is that between such stretches."""
_ACROSS = 36
"""About so many points of a row of pixels are compared."""
_BLUR = (0.012, 0.006, 0.003)
"""The pictures are blurred, less and less, so that a match is found from far; in widths of the picture."""
_APART_S = 1 / 15
"""The change of the velocity in the pictures is that between the pairs about so long before and after."""
_STEPS = 4
_PATH_ERROR = 0.01
"""What the path between two poses leaves unknown, in steps between poses."""
_TWO_SIGMA = 0.97725
"""Probability below two standard deviations."""
_VAGUE_STEPS = 1.0
"""Standard error from which on nothing is known, in steps between poses."""
_SIGMA = (0.03, 0.03, 0.03, 0.03, 0.03, 0.03)
"""How far a pair's poses may be off, metres and radians: it holds what the picture does not show."""
_SURE = 2.0
"""An offset is used if it is this many times its error: none is then outside what holds 95 of 100."""
_FEWEST_PAIRS = 10


@dataclass(frozen=True, kw_only=True)
class PoseOffset:
    """A time offset between poses and pictures."""

    offset_s: float
    """Pictures were taken this much later than their poses, seconds."""
    error_s: float
    """Half of what holds the true offset in 95 of 100 recordings, from the scatter between stretches of this one;
    infinite where the offset cannot be known, which is then given as 0."""
    pairs: int
    """Pairs of frames compared."""

    @property
    def is_sure(self) -> bool:
        """Whether the offset is more than the scatter of the pairs."""
        return abs(self.offset_s) > _SURE * self.error_s

    def __str__(self) -> str:
        if self.pairs < _FEWEST_PAIRS:
            return f"a time offset of the poses cannot be known from {self.pairs} pairs of frames"
        if not math.isfinite(self.error_s):
            return (
                "a time offset of the poses cannot be known from this recording: the camera turns too evenly or too "
                "little, or its poses scatter too much"
            )
        known = f"{1000 * abs(self.offset_s):.1f} ± {1000 * self.error_s:.1f} ms"
        if not self.is_sure:
            return f"poses and pictures have the same time as far as can be known ({known})"
        return (
            f"pictures were taken {known} {'after' if self.offset_s > 0 else 'before'} their poses: "
            f"--data.repair.pose-offset-s {self.offset_s:.4f}"
        )


def estimate_pose_offset(sequence: Sequence, *, frames: int = FRAMES) -> PoseOffset:
    """Estimate how much later than their poses the pictures of a sequence were taken.

    Args:
        sequence: With poses, times and depth. Of an opened one only the frames to map are read: neither those held out,
            nor those beyond its range.
        frames: About how many are read, in windows of consecutive ones.

    Raises:
        SequenceError: The sequence has no times or no poses.
    """
    sequence = getattr(sequence, "mapping", sequence)
    times = times_of(sequence)
    if times is None or not getattr(getattr(sequence, "source", sequence), "has_poses", True):
        raise SequenceError(
            f"{sequence.name} has no {'times' if times is None else 'poses'}, so the offset between poses and pictures "
            "cannot be estimated"
        )
    turns = _in_turn(getattr(sequence, "positions", range(len(sequence))))
    wanted = set(places_to_read(turns[-1] + 1, frames))
    sample = read_sample(sequence, at=[place for place, turn in enumerate(turns) if turn in wanted])
    path, there = PosePath(times, sample.stored_poses), {turns[f.place]: f for f in sample.frames}
    at_turn = times.new_full((turns[-1] + 1,), torch.nan).index_copy(0, torch.tensor(turns), times)
    places = torch.tensor([(turn, turn + gap) for gap in _GAPS for turn in there if turn + gap in there])
    if len(places) < _FEWEST_PAIRS:
        return PoseOffset(offset_s=0.0, error_s=float("inf"), pairs=len(places))
    pairs = [(there[a], there[b]) for a, b in places.tolist()]
    T_ba = relative_poses(*(path.at(at_turn[places[:, k]]) for k in (0, 1)))
    for blur in _BLUR:
        T_ba = aligned(sample, pairs, T_ba, blur)
    return offset_of_turns(path, at_turn, places, T_ba)


def _in_turn(positions: abc.Sequence[int]) -> list[int]:
    """Numbers of frames from 0 on, counted in the step between them; a number is left out where a frame is."""
    step = math.gcd(*(b - a for a, b in itertools.pairwise(positions))) or 1
    return [(p - positions[0]) // step for p in positions]


def offset_of_turns(
    path: PosePath, times: Float[Tensor, " L"], places: Int[Tensor, "P 2"], T_ba: Float[Tensor, "P 4 4"]
) -> PoseOffset:
    """The offset at which the path turns as the pictures do.

    Args:
        path: Of the poses.
        times: Of the frames, seconds; NaN for frames that are not read.
        places: First and second frame of each pair.
        T_ba: The motion from the first to the second, from the pictures; float64.
    """
    (t_a, t_b), stretch = times[places.T], places[:, 0] // _TOGETHER
    Z = _turning(times, places, T_ba)
    offset_s, error_s = 0.0, math.inf
    for _ in range(_STEPS):
        step, error_s = _step(path, T_ba, Z, (t_a + offset_s, t_b + offset_s), stretch)
        offset_s += max(-path.step_s, min(path.step_s, step))
    error_s = math.hypot(error_s, _PATH_ERROR * path.step_s)
    if not error_s < _VAGUE_STEPS * path.step_s:
        offset_s, error_s = 0.0, math.inf
    return PoseOffset(offset_s=offset_s, error_s=error_s, pairs=len(places))


def _turns(T_ba: Float[Tensor, "P 4 4"]) -> Float[Tensor, "P 3"]:
    return se3.log(T_ba)[:, 3:]


def _turning(
    times: Float[Tensor, " L"], places: Int[Tensor, "P 2"], T_ba: Float[Tensor, "P 4 4"]
) -> Float[Tensor, "P 3"]:
    """By how much the turn of each pair changes in a second, from the pairs before and after it; NaN without these."""
    apart = max(1, round(_APART_S / float(times.diff().nanmedian())))
    there = {pair: i for i, pair in enumerate(map(tuple, places.tolist()))}
    turns, Z = _turns(T_ba), torch.full((len(places), 3), torch.nan, dtype=torch.float64)
    for (a, b), i in there.items():
        before, after = there.get((a - apart, b - apart)), there.get((a + apart, b + apart))
        if before is not None and after is not None:
            Z[i] = (turns[after] - turns[before]) / (times[a + apart] - times[a - apart])
    return Z


def _step(
    path: PosePath,
    T_ba: Float[Tensor, "P 4 4"],
    Z: Float[Tensor, "P 3"],
    times_s: tuple[Tensor, Tensor],
    stretch: Int[Tensor, " P"],
) -> tuple[float, float]:
    """The time by which the path's turns should move to be those of the pictures, and its standard error."""
    h = 0.05 * path.step_s
    here, after, before = (relative_poses(*(path.at(t + d) for t in times_s)) for d in (0.0, h, -h))
    known = torch.isfinite(here + after + before).all(dim=(1, 2)) & torch.isfinite(Z).all(1)
    if int(known.sum()) < _FEWEST_PAIRS:
        return 0.0, math.inf
    from_path = se3.inverse(here[known])
    e = _turns(T_ba[known] @ from_path)
    J, Z = (_turns(after[known] @ from_path) - _turns(before[known] @ from_path)) / (2 * h), Z[known]
    w = torch.ones_like(e[:, :1])
    for _ in range(_STEPS):  # pairs that could not be aligned count little
        step = float((w * Z * e).sum() / (w * Z * J).sum())
        off = (e - step * J).norm(dim=1, keepdim=True)
        w = 1 / (off / (2 * off.median().clamp_min(1e-9))).clamp_min(1.0) ** 2
    products = torch.stack([(w * Z * other).sum(1) for other in (e, J, Z)], 1)
    _, places = stretch[known].unique(return_inverse=True)
    sums = products.new_zeros(int(places.max()) + 1, 3).index_add(0, places, products)
    # the noise of a sum grows with the root of its sum of Z Z: divided by it, all stretches are equally noisy
    return ratio_of_means(sums[:, :2] / sums[:, 2:].sqrt().clamp_min(1e-9))


def ratio_of_means(values: Float[Tensor, "N 2"]) -> tuple[float, float]:
    """Mean of the first column divided by that of the second, r = y / x, and its standard error.

    The error is that of the mean of y - r x, divided by x and widened by Student's t of N - 1 degrees of freedom, so
    that two of it hold 95 %. It grows without limit where by the same t the mean of x may be zero: then every ratio is
    possible (Fieller 1954).

    Args:
        values: Independent pairs (y, x).
    """
    from scipy.special import stdtrit

    n = len(values)
    if n < 2:
        return 0.0, math.inf
    y, x = values.mean(0).tolist()
    t = float(stdtrit(n - 1, _TWO_SIGMA))
    surely = x * x - t * t * float(values[:, 1].var()) / n
    if x <= 0 or surely <= 0:
        return 0.0, math.inf
    left = values[:, 0] - y / x * values[:, 1]
    return y / x, t / 2 * float(left.std()) / math.sqrt(n * surely)


def aligned(
    sample: Sample, pairs: list[tuple[FrameFacts, FrameFacts]], T_ba: Float[Tensor, "P 4 4"], blur: float
) -> Float[Tensor, "P 4 4"]:
    """Motions from the first to the second frame of each pair by which their pictures fit; a few Gauss-Newton steps.

    Args:
        sample: The frames' camera.
        pairs: First and second frames.
        T_ba: The motions so far, float64.
        blur: Standard deviation of the blur of the pictures, in widths.
    """
    camera, smooth = sample.depth_camera, {}
    for f in itertools.chain(*pairs):
        grey, sigma_px = f.grey.astype(np.float32), max(0.7, blur * f.grey.shape[1])
        smooth[f.place] = torch.from_numpy(np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma_px)))
    every = max(1, camera.width // _ACROSS)
    uv = pixel_grid(camera)[every // 2 :: every, every // 2 :: every].reshape(-1, 2)
    u, v = uv.long().unbind(-1)
    points = rays(camera, uv) * torch.stack([a.depth_m[v, u] for a, _ in pairs])[..., None]
    first = torch.stack([smooth[a.place] for a, _ in pairs])[:, None]
    grey_a = _sampled(first, uv.expand(len(pairs), -1, 2), camera)[0][..., 0]
    second = torch.stack([smooth[b.place] for _, b in pairs])
    du, dv = torch.zeros_like(second), torch.zeros_like(second)
    du[:, :, 1:-1] = (second[:, :, 2:] - second[:, :, :-2]) / 2 * (second.shape[2] / camera.width)
    dv[:, 1:-1] = (second[:, 2:] - second[:, :-2]) / 2 * (second.shape[1] / camera.height)
    images, weight = torch.stack([second, du, dv], 1), torch.tensor(_SIGMA, dtype=torch.float64) ** -2
    T_start, moved = T_ba, torch.zeros(len(pairs), 6, dtype=torch.float64)
    for _ in range(_STEPS):
        H, g = _normal_equations(points, T_ba, grey_a, images, camera)
        xi = -torch.linalg.solve(H + weight.diag(), (g + weight * moved)[..., None])[..., 0]
        T_ba = se3.exp(xi) @ T_ba
        moved = se3.log(T_ba @ se3.inverse(T_start)).where(torch.isfinite(T_ba).all(dim=(1, 2))[:, None], 0.0)
    return T_ba


def _normal_equations(
    points: Float[Tensor, "P N 3"],
    T_ba: Float[Tensor, "P 4 4"],
    grey_a: Float[Tensor, "P N"],
    images: Float[Tensor, "P 3 h w"],
    camera: Camera,
) -> tuple[Float[Tensor, "P 6 6"], Float[Tensor, "P 6"]]:
    """Of the differences of grey levels, without each pair's ratio of brightness; occluded points count little."""
    T = T_ba.to(points.dtype)
    X = points @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
    ok = (points[..., 2] > 0) & (X[..., 2] > 0.05) & torch.isfinite(X).all(-1)
    X = X.where(ok[..., None], 1.0)
    x, y, inverse = X[..., 0] / X[..., 2], X[..., 1] / X[..., 2], 1 / X[..., 2]
    values, inside = _sampled(images, torch.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], -1), camera)
    known = ok & inside
    n = known.sum(1, keepdim=True).clamp_min(1)
    mean_a, mean_b = (z.where(known, 0.0).sum(1, keepdim=True) / n for z in (grey_a, values[..., 0]))
    ratio = mean_a / mean_b.clamp_min(1.0)
    r = (ratio * values[..., 0] - grey_a).where(known, 0.0)
    a, b = camera.fx * ratio * values[..., 1], camera.fy * ratio * values[..., 2]
    along = a * x + b * y
    J = torch.stack([a * inverse, b * inverse, -along * inverse, -along * y - b, along * x + a, b * x - a * y], dim=-1)
    J = J.where(known[..., None], 0.0)
    scale = r.abs().where(known, torch.nan).nanmedian(dim=1, keepdim=True).values.nan_to_num(1.0).clamp_min(1.0)
    w = 1 / ((1 + (r / (2 * scale)) ** 2) * scale**2)
    H, g = J.mT @ (w[..., None] * J), (J * (w * r)[..., None]).sum(1)
    return H.double(), g.double()


def _sampled(
    images: Float[Tensor, "P C h w"], uv: Float[Tensor, "P N 2"], camera: Camera
) -> tuple[Float[Tensor, "P N C"], Bool[Tensor, "P N"]]:
    """Values of images at pixels of the depth camera, bilinear, and whether they are inside."""
    place = 2 * uv / torch.tensor([camera.width, camera.height]) - 1
    found = torch.nn.functional.grid_sample(images, place[:, None].float(), align_corners=False, padding_mode="border")
    return found[:, :, 0].mT, (place.abs() < 0.98).all(-1)
