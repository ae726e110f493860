"""What the operations say about one voxel."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from ...geometry import project, se3
from ...tsdf import tsdf_update
from ...tsdf.block_pool import BLOCK_VOXELS
from .moments import Moment, table
from .operations import Box, FusionRecord, Record, Voxel


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
    inside: bool
    """Whether that is in the image."""
    z_m: float
    """Of its centre in the camera frame."""
    depth_m: float
    """Measured at the pixel that contains ``uv``; 0: none, or outside the image."""
    sdf_m: float
    """Signed distance that the frame measures, metres, by the plain formula; NaN where there is
    none."""
    D: tuple[float, float]
    """In the volume, before and after the frame. 1 where not allocated. Of a block that is not in
    view the values of the last frame that is held in which it was."""
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
    def boxes(self) -> dict[str, list[Box]]:
        """The pixel on which it falls."""
        return {"pixel": [(int(self.uv[0]), int(self.uv[1]), 1, 1)] if self.inside else []}

    @property
    def verdict(self) -> str:
        """Whether the frame observes the voxel, and if not, why."""
        if self.observed:
            return "observed"
        if not self.allocated:
            return "its block is not in view, or not allocated"
        if self.depth_m <= 0:
            return "no depth there" if self.inside else "outside the image"
        return "not changed"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        rows = [("voxel", str(self.ijk)), ("centre m", " ".join(f"{x:.4f}" for x in self.centre_W))]
        rows += [
            ("projects to u, v", f"{self.uv[0]:.2f}, {self.uv[1]:.2f}"),
            ("z m", f"{self.z_m:.4f}"),
        ]
        rows += [
            ("depth measured m", f"{self.depth_m:.4f}"),
            ("signed distance m", f"{self.sdf_m:.4f}"),
        ]
        rows += [
            ("D", f"{self.D[0]:.5f} → {self.D[1]:.5f}"),
            ("W", f"{self.W[0]:g} → {self.W[1]:g}"),
        ]
        return [*rows, ("", self.verdict)]

    def cells(self) -> list[str]:
        """Its row in the table of a story."""
        return [
            str(self.frame_index),
            f"{self.uv[0]:.1f}",
            f"{self.uv[1]:.1f}",
            f"{self.z_m:.3f}",
            f"{self.depth_m:.3f}",
            f"{self.sdf_m:.4f}",
            f"{self.D[0]:.5f}",
            f"{self.D[1]:.5f}",
            f"{self.W[0]:g}",
            f"{self.W[1]:g}",
            self.verdict,
        ]


def voxel_moment(record: Record, ijk: Voxel) -> VoxelFused | None:
    """What a record says about a voxel; ``None`` if nothing."""
    if not isinstance(record, FusionRecord):
        return None
    camera = record.frame.camera
    config = record.config
    frame = record.frame
    centre = (torch.tensor(ijk, dtype=torch.float64) + 0.5) * config.voxel_size_m
    xyz_C = se3.apply(se3.inverse(frame.T_WC.cpu().double()), centre[None])[0]
    x, y, z = xyz_C.tolist()
    u, v = project(camera, xyz_C).tolist()
    in_view = z > 0 and 0 <= u < camera.width and 0 <= v < camera.height
    depth_m = float(frame.depth_m[int(v), int(u)]) if in_view else 0.0
    sdf_m = depth_m - z if depth_m > 0 and depth_m >= config.near_m else float("nan")
    if config.sdf == "ray":
        sdf_m *= (x * x + y * y + z * z) ** 0.5 / z
    block = torch.tensor(
        [c // BLOCK_VOXELS for c in ijk],
        dtype=record.coords.dtype,
        device=record.coords.device,
    )
    at = (record.coords == block).all(1).nonzero()[:, 0]
    D = (1.0, 1.0)
    W = (0.0, 0.0)
    if len(at):
        i, j, k = (c % BLOCK_VOXELS for c in ijk)
        D0, D1, W0, W1 = (
            float(column[at[0], 64 * i + 8 * j + k]) for column in (*record.D, *record.W)
        )
        D = (D0, D1)
        W = (W0, W1)
    return VoxelFused(
        serial=record.serial,
        frame_index=record.frame_index,
        camera=camera,
        image=frame.colour,
        ijk=ijk,
        centre_W=tuple(centre.tolist()),
        allocated=len(at) > 0,
        uv=(u, v),
        inside=in_view,
        z_m=z,
        depth_m=depth_m,
        sdf_m=sdf_m,
        D=D,
        W=W,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelTrace:
    """What every fused frame did to one voxel, in order. ``print(...)`` shows a table."""

    ijk: Voxel
    """Integer coordinates."""
    moments: tuple[VoxelFused, ...]
    n_dropped: int
    """Operations of the whole trace that are no longer held."""

    def __str__(self) -> str:
        heads = (
            "frame",
            "u",
            "v",
            "z m",
            "depth m",
            "sdf m",
            "D before",
            "D after",
            "W before",
            "W after",
            "",
        )
        return "\n".join([f"voxel {self.ijk}", table(heads, [m.cells() for m in self.moments])])
