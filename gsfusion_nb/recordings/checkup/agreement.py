"""How well depth images predict each other under small corrections of scale, time, focal length and
principal point."""

import math
from collections import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...data.adjust.depth_agreement import AGREES, relative_poses
from ...data.adjust.poses import reread_poses
from ...data.adjust.reprojection import Reprojection, reproject_depth
from ...geometry import pixel_grid
from ...geometry.pose_path import pose_between
from ...types import Camera
from .sample import Sample

PosesAtShift = Callable[[float], Float[Tensor, "F 4 4"]]
"""Shift in frames -> poses of all frames used, camera-to-world; NaN if there is none."""


@dataclass(frozen=True, kw_only=True)
class CalibrationCorrection:
    """Changes that are applied before points are moved from frame to frame. Zeros change
    nothing."""

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
    ray: float = 0.0
    """1: depth is the length of the ray."""


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
        sample: Sample,
        pairs: abc.Sequence[tuple[int, int]],
        interpretation: RepairConfig,
        *,
        points: int = 800,
    ) -> "FitData":
        """Data of the pairs with poses and depth scale interpreted by ``interpretation``."""
        camera = sample.depth_camera
        step = max(1, round(math.sqrt(camera.width * camera.height / points)))
        uv = pixel_grid(camera)[step // 2 :: step, step // 2 :: step].reshape(-1, 2)
        u, v = uv.long().unbind(-1)
        by_place = sample.by_place
        factor = interpretation.depth_factor
        frames = sorted({place for pair in pairs for place in pair})
        row = {place: i for i, place in enumerate(frames)}
        return FitData(
            uv_a=uv.expand(len(pairs), -1, 2),
            depth_a=torch.stack([by_place[a].depth_m[v, u] for a, _ in pairs]) * factor,
            depth_b=torch.stack([by_place[b].depth_m for _, b in pairs]) * factor,
            camera=camera,
            thinning=sample.camera.width / camera.width,
            rows=([row[a] for a, _ in pairs], [row[b] for _, b in pairs]),
            path=_poses_at_shift(reread_poses(sample.stored_poses, interpretation), frames),
        )

    def corrected_camera(self, c: CalibrationCorrection) -> Camera:
        """The subsampled camera with a correction."""
        focal = math.exp(c.log_focal)
        aspect = math.exp(c.log_aspect)
        return replace(
            self.camera,
            fx=self.camera.fx * focal * aspect,
            fy=self.camera.fy * focal / aspect,
            cx=self.camera.cx + c.cx_px / self.thinning,
            cy=self.camera.cy + c.cy_px / self.thinning,
        )


def reproject(data: FitData, c: CalibrationCorrection) -> Reprojection:
    """Move all points of the first frames into the second frames of the pairs, under a
    correction."""
    camera = data.corrected_camera(c)
    T = data.path(c.shift_frames).to(data.uv_a.dtype)
    T_ba = relative_poses(T[data.rows[0]], T[data.rows[1]])
    T_ba[:, :3, 3] *= math.exp(-c.log_scale)
    return reproject_depth(
        camera,
        data.uv_a,
        data.depth_a,
        data.depth_b,
        T_ba,
        is_ray=bool(c.ray),
    )


class Agreement(NamedTuple):
    """How well frames agree."""

    share: float
    """Share of the first frames' points that agree with the second ones within 3 per cent."""
    median_m: float
    """Median depth difference, metres."""


def agreement(data: FitData, c: CalibrationCorrection) -> Agreement:
    """How well the pairs agree under a correction."""
    _, residual, is_measured = reproject(data, c)
    r = residual.abs()
    has_pose = torch.isfinite(data.path(c.shift_frames)).all(dim=(1, 2))
    has_depth = (has_pose[data.rows[0]] & has_pose[data.rows[1]])[:, None] & (data.depth_a > 0)
    share = float(((r < AGREES) & is_measured).sum() / has_depth.sum().clamp_min(1))
    error = (r * data.depth_a)[is_measured]
    return Agreement(
        share,
        float(error.median()) * math.exp(c.log_scale) if len(error) else math.nan,
    )


def median_error(data: FitData, c: CalibrationCorrection) -> float:
    """Median |relative depth difference| over the points that fall on a valid depth."""
    _, residual, is_measured = reproject(data, c)
    return float(residual[is_measured].abs().median()) if bool(is_measured.any()) else math.nan


def _poses_at_shift(poses: Float[Tensor, "L 4 4"], frames: list[int]) -> PosesAtShift:
    """Function that returns the poses of ``frames`` at any shift; results are cached."""
    poses_of: dict[float, Float[Tensor, "F 4 4"]] = {}

    def shifted(shift: float) -> Float[Tensor, "F 4 4"]:
        shift = round(shift, 3)
        if shift not in poses_of:
            whole = math.floor(shift)
            first, second = (_poses_at(poses, [f + whole + k for f in frames]) for k in (0, 1))
            poses_of[shift] = (
                first if shift == whole else pose_between(first, second, shift - whole)
            )
        return poses_of[shift]

    return shifted


def _poses_at(
    poses: Float[Tensor, "L 4 4"],
    places: list[int],
) -> Float[Tensor, "F 4 4"]:
    """Poses at ``places``; NaN outside."""
    at = torch.tensor(places)
    is_inside = (at >= 0) & (at < len(poses))
    return poses[at.clamp(0, len(poses) - 1)].where(is_inside[:, None, None], torch.nan)
