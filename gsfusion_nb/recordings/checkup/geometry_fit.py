"""How well depth images predict each other under small corrections of scale, time, focal length, principal point."""

import math
from collections import abc
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...config import RepairConfig
from ...data.adjust.depth_agreement import AGREES, relative_poses
from ...data.adjust.poses import pose_between, reread_poses
from ...types import Camera
from .sample import Sample

PosesAtShift = Callable[[float], Float[Tensor, "F 4 4"]]
"""Shift in frames -> poses of all frames used, camera-to-world; NaN if there is none."""


@dataclass(frozen=True, kw_only=True)
class CalibrationCorrection:
    """Changes that are applied before points are moved from frame to frame. Zeros change nothing."""

    log_scale: float = 0.0
    """Logarithm of a factor on depth."""
    log_focal: float = 0.0
    """Logarithm of a factor on both focal lengths."""
    log_aspect: float = 0.0
    """Logarithm of a factor on fx; fy is divided by the same factor."""
    cx_px: float = 0.0
    cy_px: float = 0.0
    """Added to the principal point, pixels of the full image."""
    shift_frames: float = 0.0
    """Poses are taken this many frames later."""
    ray: bool = False
    """Whether depth is the length of the ray."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitData:
    """Pixels of the first frames and depth of the second frames of P pairs."""

    uv_a: Float[Tensor, "P N 2"]
    """Pixel centres in the subsampled depth camera."""
    depth_a: Float[Tensor, "P N"]
    """Metres, 0 = missing."""
    depth_b: Float[Tensor, "P H W"]
    camera: Camera
    """Camera of the subsampled depth images."""
    thinning: float
    """Full pixels per subsampled pixel."""
    rows: tuple[list[int], list[int]]
    """Rows of ``path`` for the first and the second frame of each pair."""
    path: PosesAtShift

    @staticmethod
    def of(
        sample: Sample, pairs: abc.Sequence[tuple[int, int]], interpretation: RepairConfig, *, points: int = 800
    ) -> "FitData":
        """Data of the pairs with poses and depth scale interpreted by ``interpretation``."""
        camera = sample.depth_camera
        step = max(1, round(math.sqrt(camera.width * camera.height / points)))
        grid = torch.meshgrid(
            torch.arange(step // 2, camera.height, step), torch.arange(step // 2, camera.width, step), indexing="ij"
        )
        v, u = (g.reshape(-1) for g in grid)
        there = sample.by_place
        factor = interpretation.depth_factor
        frames = sorted({place for pair in pairs for place in pair})
        row = {place: i for i, place in enumerate(frames)}
        return FitData(
            uv_a=(torch.stack([u, v], -1) + 0.5).expand(len(pairs), -1, 2),
            depth_a=torch.stack([there[a].depth_m[v, u] for a, _ in pairs]) * factor,
            depth_b=torch.stack([there[b].depth_m for _, b in pairs]) * factor,
            camera=camera,
            thinning=sample.camera.width / camera.width,
            rows=([row[a] for a, _ in pairs], [row[b] for _, b in pairs]),
            path=_path(reread_poses(sample.stored_poses, interpretation), frames),
        )

    def corrected_camera(self, c: CalibrationCorrection) -> Camera:
        """The subsampled camera with a correction."""
        focal, aspect = math.exp(c.log_focal), math.exp(c.log_aspect)
        return replace(
            self.camera,
            fx=self.camera.fx * focal * aspect,
            fy=self.camera.fy * focal / aspect,
            cx=self.camera.cx + c.cx_px / self.thinning,
            cy=self.camera.cy + c.cy_px / self.thinning,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Reprojection:
    """Positions of the points of the first frames in the second ones."""

    uv_b: Float[Tensor, "P N 2"]
    """Pixels of the subsampled depth camera."""
    residual: Float[Tensor, "P N"]
    """Relative depth difference (predicted - measured) / measured; 0 where unknown."""
    known: Bool[Tensor, "P N"]


def reproject(data: FitData, c: CalibrationCorrection) -> Reprojection:
    """Move all points from frame to frame.

    The measured depth is interpolated between four pixels of one surface; points between two surfaces are not compared.
    """
    camera = data.corrected_camera(c)
    T = data.path(c.shift_frames).to(data.uv_a.dtype)
    T_ba = relative_poses(T[data.rows[0]], T[data.rows[1]])
    x = (data.uv_a[..., 0] - camera.cx) / camera.fx
    y = (data.uv_a[..., 1] - camera.cy) / camera.fy
    z = data.depth_a / (1 + x * x + y * y).sqrt() if c.ray else data.depth_a
    P = torch.stack([x * z, y * z, z], -1)
    Q = P @ T_ba[:, :3, :3].transpose(1, 2) + T_ba[:, None, :3, 3] * math.exp(-c.log_scale)
    ok = (data.depth_a > 0) & (Q[..., 2] > 1e-6) & torch.isfinite(Q).all(-1)
    Q = Q.where(ok[..., None], 1.0)
    xb, yb = Q[..., 0] / Q[..., 2], Q[..., 1] / Q[..., 2]
    uv_b = torch.stack([camera.fx * xb + camera.cx, camera.fy * yb + camera.cy], -1)
    measured, known = _interpolated(data.depth_b, uv_b[..., 0], uv_b[..., 1])
    if c.ray:
        measured = measured / (1 + xb * xb + yb * yb).sqrt()
    known = known & ok
    residual = ((Q[..., 2] - measured) / measured.where(known, 1.0)).where(known, 0.0)
    return Reprojection(uv_b=uv_b, residual=residual, known=known)


def cost(data: FitData, c: CalibrationCorrection, tolerance: float) -> float:
    """Mean of min(|residual| / tolerance, 1) over the points that fall on a valid depth; 1 if none does."""
    found = reproject(data, c)
    each = (found.residual.abs() / tolerance).clamp(max=1.0) * found.known
    return (float(each.sum()) + 1e-9) / (float(found.known.sum()) + 1e-9)


def agreeing(data: FitData, c: CalibrationCorrection) -> tuple[float, float]:
    """Share of the first frames' points that agree within 3 per cent, and the median depth difference in metres."""
    found = reproject(data, c)
    r = found.residual.abs()
    share = float(((r < AGREES) & found.known).sum() / (data.depth_a > 0).sum().clamp_min(1))
    error = (r * data.depth_a)[found.known]
    return share, float(error.median()) * math.exp(c.log_scale) if len(error) else float("nan")


def median_error(data: FitData, c: CalibrationCorrection) -> float:
    """Median |relative depth difference| over the points that fall on a valid depth."""
    found = reproject(data, c)
    return float(found.residual[found.known].abs().median()) if bool(found.known.any()) else float("nan")


def _path(poses: Float[Tensor, "L 4 4"], frames: list[int]) -> PosesAtShift:
    """Function that returns the poses of ``frames`` at any shift; results are cached."""
    known: dict[float, Float[Tensor, "F 4 4"]] = {}

    def shifted(shift: float) -> Float[Tensor, "F 4 4"]:
        shift = round(shift, 3)
        if shift not in known:
            whole = math.floor(shift)
            first, second = (_rows(poses, [f + whole + k for f in frames]) for k in (0, 1))
            known[shift] = first if shift == whole else pose_between(first, second, shift - whole)
        return known[shift]

    return shifted


def _rows(poses: Float[Tensor, "L 4 4"], places: list[int]) -> Float[Tensor, "F 4 4"]:
    """Poses at ``places``; NaN outside."""
    at = torch.tensor(places)
    inside = (at >= 0) & (at < len(poses))
    return poses[at.clamp(0, len(poses) - 1)].where(inside[:, None, None], torch.nan)


def _interpolated(
    depth: Float[Tensor, "P H W"], u: Float[Tensor, "P N"], v: Float[Tensor, "P N"]
) -> tuple[Float[Tensor, "P N"], Bool[Tensor, "P N"]]:
    """Depth between pixel centres, bilinear in 1 / z (exact on planes); whether the four pixels are on one surface."""
    n, h, w = depth.shape
    x, y = u - 0.5, v - 0.5
    known = (x >= 0) & (y >= 0) & (x <= w - 1.001) & (y <= h - 1.001)
    x, y = x.where(known, 0.0), y.where(known, 0.0)
    i, j = x.floor().long(), y.floor().long()
    fx, fy = x - i, y - j
    at = torch.arange(n)[:, None] * (h * w) + j * w + i
    flat = depth.reshape(-1)
    corners = torch.stack([flat[at], flat[at + 1], flat[at + w], flat[at + w + 1]])
    near, far = corners.amin(0), corners.amax(0)
    known = known & (near > 0) & (far < 1.05 * near)
    inverse = 1 / corners.where(known, 1.0)
    top = inverse[0] + fx * (inverse[1] - inverse[0])
    bottom = inverse[2] + fx * (inverse[3] - inverse[2])
    return 1 / (top + fy * (bottom - top)), known
