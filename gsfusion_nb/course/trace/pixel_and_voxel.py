"""One pixel through a run: what it measured, the voxels on its ray, its seed, the Gaussians that made its colour; and
one voxel through the frames that were fused."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...geometry import project, se3
from ...render import composite
from ...seeding import apply_rule
from ...tsdf import tsdf_update
from ...tsdf.block_pool import BLOCK_VOXELS
from .gaussian import Marks, Moment, box, common, numbers, table
from .identity import origin_of
from .records import FusionRecord, Record, SeedingRecord, StepRecord

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


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelFused(Moment):
    """The ray of a pixel when its frame was fused."""

    code: ClassVar = (tsdf_update, "D_k = (D * (W_k - 1.0) + d) / W_k")

    depth_m: float
    """Measured, metres; 0: none."""
    rgb: Float[Tensor, " 3"]
    """Photographed."""
    origin_W: tuple[float, float, float]
    ray_W: tuple[float, float, float]
    """Direction with z = 1 in the camera frame: a point on the ray is origin + depth * direction. World frame."""
    voxels: tuple[VoxelFused, ...]
    """Those on the ray within the truncation distance of the measured depth, nearest first."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return f"{super().title} fused: {len(self.voxels)} voxels on the ray"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        out = [("depth measured m", f"{self.depth_m:.4f}"), ("colour", numbers(self.rgb, 3))]
        out += [("ray from m", numbers(self.origin_W)), ("ray towards", numbers(self.ray_W))]
        return out + [
            (f"voxel {v.ijk}", f"z {v.z_m:.3f}  D {v.D[0]:.3f} → {v.D[1]:.3f}  W {v.W[0]:g} → {v.W[1]:g}")
            for v in self.voxels
        ]


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelSeeded(Moment):
    """A pixel when the seeding rule looked at its frame."""

    code: ClassVar = (apply_rule, "seeds = cast(")

    rule: str
    cell: tuple[int, int, int, int, int] | None
    """Quadtree leaf that holds the pixel: first column, first row, width, height, level."""
    seeds: tuple[int, ...]
    """Places, among this frame's seeds, of those whose centre is in the leaf (without a quadtree: in the pixel)."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return f"{super().title}, rule {self.rule}: {len(self.seeds)} new Gaussians here"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        cell = "none" if self.cell is None else "{2} x {3} px at ({0}, {1}), level {4}".format(*self.cell)
        return [("rule", self.rule), ("quadtree cell", cell), ("seeds of the frame", str(self.seeds))]


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelStep(Moment):
    """A pixel in one optimisation step: the K Gaussians that made it, nearest first, and its gradient."""

    code: ClassVar = (composite, "return w, w.T @ c")

    stage: str
    """"frame", "keyframe" or "passes"."""
    view_index: int
    """The frame whose pixel it is."""
    rgb: Float[Tensor, " 3"]
    """Rendered, before the step."""
    target: Float[Tensor, " 3"]
    """Photographed, 0..1."""
    rendered_alpha: float
    """Of the rendered picture."""
    v_rgb: Float[Tensor, " 3"]
    """dL/d of the rendered colour."""
    ids: Int[Tensor, " K"]
    """Number of each Gaussian."""
    depth_m: Float[Tensor, " K"]
    colour: Float[Tensor, "K 3"]
    alpha: Float[Tensor, " K"]
    transmittance: Float[Tensor, " K"]
    """T_k, the light left in front of each."""
    weight: Float[Tensor, " K"]
    """w_k = alpha_k T_k."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return f"{super().title}, step {self.serial} on the view of frame {self.view_index} ({self.stage})"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        out = [("rendered", numbers(self.rgb)), ("photographed", numbers(self.target))]
        out += [("dL/d colour", numbers(self.v_rgb))]
        out += [("sum of weights", f"{float(self.weight.sum()):.5f}, rendered alpha {self.rendered_alpha:.5f}")]
        for k in range(min(len(self.ids), 12)):
            words = (
                f"z {self.depth_m[k]:.3f}  α {self.alpha[k]:.4f}  T {self.transmittance[k]:.4f}  "
                f"w {self.weight[k]:.4f}  c {numbers(self.colour[k], 3)}"
            )
            out.append((f"Gaussian {int(self.ids[k])}", words))
        return out if len(self.ids) <= 12 else [*out, ("", f"and {len(self.ids) - 12} more")]


def pixel_moment(record: Record, u: int, v: int) -> Moment | None:
    """What a record says about a pixel; ``None`` if nothing."""
    camera = getattr(record, "camera", None) or getattr(getattr(record, "frame", None), "camera", None)
    if camera is None or not (0 <= u < camera.width and 0 <= v < camera.height):
        return None
    if isinstance(record, FusionRecord):
        return _fused(record, u, v)
    if isinstance(record, SeedingRecord):
        return _seeded(record, u, v)
    return _step(record, u, v) if isinstance(record, StepRecord) else None


def _fused(record: FusionRecord, u: int, v: int) -> PixelFused:
    moments = [voxel_moment(record, ijk) for ijk in voxels_on_ray(record, u, v)]
    origin, ray = (tuple(x.tolist()) for x in pixel_ray(record, u, v))
    frame = record.frame
    return PixelFused(
        **common(record), camera=frame.camera, image=frame.colour, marks=Marks(pixel=(u, v)),
        depth_m=float(frame.depth_m[v, u]), rgb=frame.rgb[v, u].cpu().clone(), origin_W=origin, ray_W=ray,
        voxels=tuple(m for m in moments if m is not None),
    )  # fmt: skip


def _seeded(record: SeedingRecord, u: int, v: int) -> PixelSeeded:
    cells, cell = record.cells, None
    if cells is not None:
        inside = (cells.x0 <= u) & (u < cells.x0 + cells.width) & (cells.y0 <= v) & (v < cells.y0 + cells.height)
        k = int(inside.nonzero()[0, 0])
        x, y, w, h, level = (int(getattr(cells, name)[k]) for name in ("x0", "y0", "width", "height", "level"))
        cell = (x, y, w, h, level)
    x, y, w, h = cell[:4] if cell else (u, v, 1, 1)
    seeds: tuple[int, ...] = ()
    if len(record.seeds):
        at_u, at_v = origin_of(record, record.seeds)["uv"].unbind(1)
        here = (at_u >= x) & (at_u < x + w) & (at_v >= y) & (at_v < y + h)
        seeds = tuple(here.nonzero()[:, 0].tolist())
    marks = Marks(pixel=(u, v), cell=cell[:4] if cell else None)
    return PixelSeeded(
        **common(record), camera=record.frame.camera, image=record.frame.colour, marks=marks, rule=record.rule,
        cell=cell, seeds=seeds,
    )  # fmt: skip


def _step(record: StepRecord, u: int, v: int) -> PixelStep:
    s = record.screen
    tile = s.tile_of(u, v)
    blend = s.blend(tile, *torch.tensor([[u], [v]], device=s.uv.device))
    used = (blend.weight > 0).any(1)
    rows = blend.gaussian[used]
    alpha, T, w = (x[used].flatten().cpu().clone() for x in (blend.alpha, blend.transmittance, blend.weight))
    target = record.target[v, u].cpu().clone()
    return PixelStep(
        **common(record), camera=record.camera, image=record.rgb,
        marks=Marks(pixel=(u, v), tiles=(box(tile, s.tiles.tile_px, s.tiles.tiles_x, record.camera),)),
        stage=record.stage, view_index=record.view_index, rgb=record.rgb[v, u].cpu().clone(),
        target=target / 255 if target.dtype.is_floating_point is False else target,
        rendered_alpha=float(record.alpha[v, u]), v_rgb=record.v_rgb[v, u].cpu().clone(),
        ids=record.ids[rows.to(record.ids.device)].cpu(), depth_m=s.depth_m[rows].cpu().clone(),
        colour=s.rgb[rows].cpu().clone(), alpha=alpha, transmittance=T, weight=w,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelTrace:
    """Everything that is known of the pixel (u, v) of every view, in order. ``print(...)`` shows a table."""

    u: int
    """Column."""
    v: int
    """Row."""
    moments: tuple[Moment, ...]
    n_dropped: int
    """Operations of the whole trace that are no longer held."""

    @property
    def steps(self) -> tuple[PixelStep, ...]:
        """Its optimisation steps."""
        return tuple(m for m in self.moments if isinstance(m, PixelStep))

    def __len__(self) -> int:
        return len(self.moments)

    def __str__(self) -> str:
        out = [f"pixel ({self.u}, {self.v})"]
        out += [f"  {m.title}" for m in self.moments if not isinstance(m, PixelStep)]
        heads = ("step", "frame", "view", "stage", "Gaussians", "Σw", "rendered", "photographed", "dL/d colour")
        rows = [
            [
                str(s.serial), "-" if s.frame_index is None else str(s.frame_index), str(s.view_index), s.stage,
                str(len(s.ids)), f"{float(s.weight.sum()):.4f}", numbers(s.rgb, 3), numbers(s.target, 3),
                numbers(s.v_rgb, 2),
            ]
            for s in self.steps
        ]  # fmt: skip
        return "\n".join([*out, table(heads, rows)])
