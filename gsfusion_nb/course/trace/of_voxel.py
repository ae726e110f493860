"""One voxel through the frames that were fused."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ...constants import BLOCK_VOXELS
from ...geometry import project, se3
from ...tsdf import tsdf_update
from .moment import Marks, Moment, common, table
from .records import FusionRecord, Record

Voxel = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelFused(Moment):
    """A voxel in the fusion of one frame. D is in units of the truncation distance."""

    code: ClassVar = (tsdf_update, "D_k = (D * (W_k - 1.0) + d) / W_k")

    ijk: Voxel
    """Integer coordinates."""
    centre_W: tuple[float, float, float]
    """Metres."""
    allocated: bool
    """Whether its block is in the volume, and may be in view."""
    uv: tuple[float, float]
    """Projection of its centre, pixels."""
    z_m: float
    """Of its centre in the camera frame."""
    depth_m: float
    """Measured at the pixel that contains ``uv``; 0: none, or outside the image."""
    sdf_m: float
    """Signed distance that the frame measures, metres, by the plain formula; NaN where there is none."""
    D: tuple[float, float]
    """In the volume, before and after the frame. 1 where not allocated. Of a block that is not in view the values of
    the last frame that is held in which it was."""
    W: tuple[float, float]
    """Observation count, before and after."""

    @property
    def observed(self) -> bool:
        """Whether the frame changed the voxel, or confirmed it."""
        return self.W[0] != self.W[1] or self.D[0] != self.D[1]

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return f"{super().title} fused: {self.verdict}"

    @property
    def verdict(self) -> str:
        """Whether the frame observes the voxel, and if not, why."""
        if self.observed:
            return "observed"
        if not self.allocated:
            return "its block is not in view, or not allocated"
        if self.depth_m <= 0:
            return "outside the image" if self.sdf_m != self.sdf_m and self.marks.pixel is None else "no depth there"
        return "not changed"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        out = [("voxel", str(self.ijk)), ("centre m", " ".join(f"{x:.4f}" for x in self.centre_W))]
        out += [("projects to u, v", f"{self.uv[0]:.2f}, {self.uv[1]:.2f}"), ("z m", f"{self.z_m:.4f}")]
        out += [("depth measured m", f"{self.depth_m:.4f}"), ("signed distance m", f"{self.sdf_m:.4f}")]
        out += [("D", f"{self.D[0]:.5f} → {self.D[1]:.5f}"), ("W", f"{self.W[0]:g} → {self.W[1]:g}")]
        return [*out, ("", self.verdict)]


def voxel_values(record: FusionRecord, ijk: Voxel) -> tuple[float, float, float, float] | None:
    """D and W before, D and W after; ``None`` if its block was not in view."""
    block = torch.tensor([c // BLOCK_VOXELS for c in ijk], dtype=record.coords.dtype, device=record.coords.device)
    at = (record.coords == block).all(1).nonzero()[:, 0]
    if not len(at):
        return None
    x, y, z = (c % BLOCK_VOXELS for c in ijk)
    b, n = int(at[0]), 64 * x + 8 * y + z
    columns = (record.D_before, record.W_before, record.D_after, record.W_after)
    D0, W0, D1, W1 = (float(column[b, n]) for column in columns)
    return D0, W0, D1, W1


def voxel_moment(record: Record, ijk: Voxel) -> VoxelFused | None:
    """What a record says about a voxel; ``None`` if nothing."""
    if not isinstance(record, FusionRecord):
        return None
    frame, config, camera = record.frame, record.config, record.frame.camera
    centre = (torch.tensor(ijk, dtype=torch.float64) + 0.5) * config.voxel_size_m
    x, y, z = se3.apply(se3.inverse(frame.T_WC.cpu().double()), centre[None])[0].tolist()
    u, v = project(camera, torch.tensor([x, y, z], dtype=torch.float64)).tolist()
    inside = z > 0 and 0 <= u < camera.width and 0 <= v < camera.height
    depth_m = float(frame.depth_m[int(v), int(u)]) if inside else 0.0
    sdf_m = depth_m - z if depth_m > 0 and depth_m >= config.near_m else float("nan")
    if config.sdf == "ray":
        sdf_m *= (x * x + y * y + z * z) ** 0.5 / z
    values = voxel_values(record, ijk)
    D0, W0, D1, W1 = values or (1.0, 0.0, 1.0, 0.0)
    cx, cy, cz = centre.tolist()
    return VoxelFused(
        **common(record), camera=camera, image=frame.colour,
        marks=Marks(pixel=(int(u), int(v)) if inside else None),
        ijk=ijk, centre_W=(cx, cy, cz), allocated=values is not None, uv=(u, v), z_m=z, depth_m=depth_m, sdf_m=sdf_m,
        D=(D0, D1), W=(W0, W1),
    )  # fmt: skip


def voxels_on_ray(record: FusionRecord, u: int, v: int) -> list[Voxel]:
    """Voxels that the ray of a pixel passes from one truncation distance in front of the measured depth to one behind
    it, nearest first; none without depth."""
    config = record.config
    depth_m = float(record.frame.depth_m[v, u])
    if not depth_m > 0:
        return []
    origin_W, ray_W = pixel_ray(record, u, v)
    step_m = config.voxel_size_m / 20
    n = int(2 * config.truncation_m / step_m) + 1
    z = depth_m - config.truncation_m + step_m * torch.arange(n, dtype=torch.float64)
    ijk = torch.floor((origin_W + z[:, None] * ray_W) / config.voxel_size_m).long()
    new = torch.ones(n, dtype=torch.bool)
    new[1:] = (ijk[1:] != ijk[:-1]).any(1)
    return [(i, j, k) for i, j, k in ijk[new].tolist()]


def pixel_ray(record: FusionRecord, u: int, v: int) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Origin and direction (z = 1 in the camera frame) of the ray through a pixel's centre, world frame, float64."""
    camera, T_WC = record.frame.camera, record.frame.T_WC.cpu().double()
    x, y = (u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy
    return T_WC[:3, 3], T_WC[:3, :3] @ torch.tensor([x, y, 1.0], dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelTrace:
    """What every fused frame did to one voxel, in order. ``print(...)`` shows a table."""

    ijk: Voxel
    """Integer coordinates."""
    moments: tuple[VoxelFused, ...]
    n_dropped: int
    """Operations of the whole trace that are no longer held."""

    def __len__(self) -> int:
        return len(self.moments)

    def __str__(self) -> str:
        heads = ("frame", "u", "v", "z m", "depth m", "sdf m", "D before", "D after", "W before", "W after", "")
        rows = [
            [
                str(m.frame_index), f"{m.uv[0]:.1f}", f"{m.uv[1]:.1f}", f"{m.z_m:.3f}", f"{m.depth_m:.3f}",
                f"{m.sdf_m:.4f}", f"{m.D[0]:.5f}", f"{m.D[1]:.5f}", f"{m.W[0]:g}", f"{m.W[1]:g}", m.verdict,
            ]
            for m in self.moments
        ]  # fmt: skip
        return "\n".join([f"voxel {self.ijk}", table(heads, rows)])
