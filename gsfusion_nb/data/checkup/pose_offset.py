"""How much later or earlier than its pose each picture was taken, from the pictures and the poses alone.

Two pictures a few frames apart, the depth of the first, and direct image alignment give how the camera turned from one
to the other. If the pictures are delta seconds late, that differs from what the poses say by delta times the change of
the angular velocity between the two times. So delta follows by least squares over many pairs. Errors of single poses do
not follow the velocity, and average out.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...errors import SequenceError
from ...geometry import se3
from ...types import Camera
from ..adjust.pose_path import PosePath, times_of
from ..sequence import Sequence
from .reprojection import relative_poses
from .sample import FrameFacts, Sample, read_sample

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
_STEPS = 4
_SIGMA = (0.03, 0.03, 0.03, 0.03, 0.03, 0.03)
"""How far a pair's poses may be off, metres and radians: it holds what the picture does not show."""
_SURE = 3.0
"""An offset is used if it is this many times its standard error."""
_FEWEST_PAIRS = 10


@dataclass(frozen=True, kw_only=True)
class PoseOffset:
    """A time offset between poses and pictures."""

    offset_s: float
    """Pictures were taken this much later than their poses, seconds."""
    error_s: float
    """Its standard error, from the scatter between pairs of frames; infinite where it cannot be known."""
    pairs: int
    """Pairs of frames compared."""

    @property
    def is_sure(self) -> bool:
        """Whether the offset is more than the scatter of the pairs."""
        return abs(self.offset_s) > _SURE * self.error_s

    def __str__(self) -> str:
        if self.pairs < _FEWEST_PAIRS:
            return f"a time offset of the poses cannot be known from {self.pairs} pairs of frames; none is applied"
        known = f"{1000 * abs(self.offset_s):.1f} ± {1000 * self.error_s:.1f} ms"
        if not self.is_sure:
            return f"poses and pictures have the same time as far as can be known ({known}); no offset is applied"
        return f"pictures were taken {known} {'after' if self.offset_s > 0 else 'before'} their poses; poses follow"


def estimate_pose_offset(sequence: Sequence, *, frames: int = FRAMES) -> PoseOffset:
    """Estimate how much later than their poses the pictures of a sequence were taken.

    Args:
        sequence: With poses, times and depth.
        frames: About how many are read, in windows of consecutive ones.

    Raises:
        SequenceError: The sequence has no times or no poses.
    """
    times = times_of(sequence)
    if times is None or not getattr(sequence, "has_poses", True):
        raise SequenceError(
            f"{sequence.name} has no {'times' if times is None else 'poses'}, so the offset between poses and pictures "
            "cannot be estimated; set data.repair.pose_offset_s to 0"
        )
    sample = read_sample(sequence, frames=frames)
    path, there = PosePath(times, sample.stored_poses), sample.by_place
    pairs = [(f, there[f.place + gap]) for gap in _GAPS for f in sample.frames if f.place + gap in there]
    if len(pairs) < _FEWEST_PAIRS:
        return PoseOffset(offset_s=0.0, error_s=float("inf"), pairs=len(pairs))
    t_a, t_b = (times[[pair[k].place for pair in pairs]] for k in (0, 1))
    T_ba = relative_poses(path.at(t_a), path.at(t_b))
    for blur in _BLUR:
        T_ba = aligned(sample, pairs, T_ba, blur)
    stretch = torch.tensor([a.place // _TOGETHER for a, _ in pairs])
    offset_s, error_s = 0.0, float("inf")
    for _ in range(_STEPS):
        step, error_s = _regressed(path, T_ba, (t_a + offset_s, t_b + offset_s), stretch)
        offset_s += max(-path.step_s, min(path.step_s, step))
    return PoseOffset(offset_s=offset_s, error_s=error_s, pairs=len(pairs))


def _regressed(
    path: PosePath, T_ba: Float[Tensor, "P 4 4"], times_s: tuple[Tensor, Tensor], stretch: Int[Tensor, " P"]
) -> tuple[float, float]:
    """The time by which the path's turns should move to be those of the pictures, and its standard error."""

    def turns(T: Float[Tensor, "P 4 4"], T_from: Float[Tensor, "P 4 4"]) -> Float[Tensor, "P 3"]:
        return se3.log(T @ se3.inverse(T_from))[:, 3:]

    h = 0.05 * path.step_s
    here, after, before = (relative_poses(*(path.at(t + d) for t in times_s)) for d in (0.0, h, -h))
    known = torch.isfinite(here + after + before).all(dim=(1, 2))
    if int(known.sum()) < _FEWEST_PAIRS:
        return 0.0, float("inf")
    e, J = turns(T_ba[known], here[known]), turns(after[known], before[known]) / (2 * h)
    w = torch.ones_like(e[:, :1])
    for _ in range(_STEPS):  # pairs that could not be aligned count little
        step = float((w * J * e).sum() / (w * J * J).sum().clamp_min(1e-12))
        off = (e - step * J).norm(dim=1, keepdim=True)
        w = 1 / (off / (2 * off.median().clamp_min(1e-9))).clamp_min(1.0) ** 2
    g = (w * J * (e - step * J)).sum(1)
    together = g.new_zeros(int(stretch.max()) + 1).index_add(0, stretch[known], g)
    return step, float(together.square().sum().sqrt() / (w * J * J).sum().clamp_min(1e-12))


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
    camera, smooth = sample.depth_camera, {f.place: _blurred(f, blur) for pair in pairs for f in pair}
    v, u = (x.reshape(-1) for x in _points(camera))
    uv = torch.stack([u, v], -1) + 0.5
    directions = torch.stack(
        [(uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy, torch.ones(len(u))], -1
    )
    points = directions * torch.stack([a.depth_m[v, u] for a, _ in pairs])[..., None]
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


def _points(camera: Camera) -> tuple[Tensor, Tensor]:
    """Rows and columns of the pixels that are compared."""
    every = max(1, camera.width // _ACROSS)
    sides = (torch.arange(every // 2, size, every) for size in (camera.height, camera.width))
    rows, columns = torch.meshgrid(*sides, indexing="ij")
    return rows, columns


def _blurred(f: FrameFacts, blur: float) -> Float[Tensor, "h w"]:
    import cv2
    import numpy as np

    sigma_px = max(0.7, blur * f.grey.shape[1])
    return torch.from_numpy(np.asarray(cv2.GaussianBlur(f.grey.astype(np.float32), (0, 0), sigma_px)))


def _sampled(
    images: Float[Tensor, "P C h w"], uv: Float[Tensor, "P N 2"], camera: Camera
) -> tuple[Float[Tensor, "P N C"], Bool[Tensor, "P N"]]:
    """Values of images at pixels of the depth camera, bilinear, and whether they are inside."""
    place = 2 * uv / torch.tensor([camera.width, camera.height]) - 1
    found = torch.nn.functional.grid_sample(images, place[:, None].float(), align_corners=False, padding_mode="border")
    return found[:, :, 0].mT, (place.abs() < 0.98).all(-1)
