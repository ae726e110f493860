"""One pixel through a run: what it measured, the voxels on its ray, its seed, the Gaussians that made its colour."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...render import composite
from ...seeding import apply_rule
from ...tsdf import tsdf_update
from .identity import origin_of
from .moment import Marks, Moment, box, common, numbers, pixel_index, table
from .of_voxel import VoxelFused, pixel_ray, voxel_moment, voxels_on_ray
from .records import FusionRecord, Record, SeedingRecord, StepRecord


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
    drawn: bool
    """False: the step used only other pixels of the view (RTG-SLAM)."""
    hit: int | None
    """Number of the disc that the ray hits (RTG-SLAM)."""
    hit_depth_m: float | None
    """Depth of that disc on the ray."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return f"{super().title}, step {self.serial} on the view of frame {self.view_index} ({self.stage})"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        if not self.drawn:
            return [("", "this step used only other pixels of the view")]
        out = [("rendered", numbers(self.rgb)), ("photographed", numbers(self.target))]
        out += [("dL/d colour", numbers(self.v_rgb))]
        out += [("sum of weights", f"{float(self.weight.sum()):.5f}, rendered alpha {self.rendered_alpha:.5f}")]
        if self.hit is not None:
            out.append(("disc hit", f"Gaussian {self.hit} at {self.hit_depth_m:.4f} m"))
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
    blend = s.blend(tile, *pixel_index(u, v, s.uv.device))
    drawn = s.tiles.pixels is None or bool(s.tiles.pixels[v, u])
    used = (blend.weight > 0).any(1) if drawn else torch.zeros_like(blend.gaussian, dtype=torch.bool)
    rows = blend.gaussian[used]
    alpha, T, w = (x[used].flatten().cpu().clone() for x in (blend.alpha, blend.transmittance, blend.weight))
    target = record.target[v, u].cpu().clone()
    hit = -1 if record.hit_index is None else int(record.hit_index[v, u])
    depth = record.disc_depth_m
    return PixelStep(
        **common(record), camera=record.camera, image=record.rgb,
        marks=Marks(pixel=(u, v), tiles=(box(tile, s.tiles.tile_px, s.tiles.tiles_x, record.camera),)),
        stage=record.stage, view_index=record.view_index, rgb=record.rgb[v, u].cpu().clone(),
        target=target / 255 if target.dtype.is_floating_point is False else target,
        rendered_alpha=float(record.alpha[v, u]), v_rgb=record.v_rgb[v, u].cpu().clone(),
        ids=record.ids[rows.to(record.ids.device)].cpu(), depth_m=s.depth_m[rows].cpu().clone(),
        colour=s.rgb[rows].cpu().clone(), alpha=alpha, transmittance=T, weight=w,
        drawn=drawn, hit=int(record.ids[hit]) if hit >= 0 else None,
        hit_depth_m=float(depth[v, u]) if hit >= 0 and depth is not None else None,
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
