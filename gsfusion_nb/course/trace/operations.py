"""What a trace holds of each operation, and what that says about one Gaussian or one voxel.

A record holds references to the tensors that the program made, and copies of those that it changes
afterwards. A moment is its part that concerns what is followed: numbers with names, a picture with
marks, and the line of code.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...config import TsdfConfig
from ...gaussians import GaussianModel
from ...geometry import project, se3
from ...optim import adam_update
from ...render import ScreenGaussians
from ...tsdf import tsdf_update
from ...tsdf.block_pool import BLOCK_VOXELS
from ...types import Camera, Frame, Seeds
from ..source_lines import source_lines
from .identity import Birth, Event, when

Voxel = tuple[int, int, int]
Box = tuple[int, int, int, int]
"""First column, first row, width, height; pixels of the image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Operation:
    """When it was."""

    serial: int
    """Number of the operation, rising."""
    frame_index: int | None
    """The frame that was being mapped; ``None`` in the passes after the scan."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AdamColumn:
    """One parameter in one step of Adam: of all Gaussians, [R, ...] each, or of one: xyz_W [3], sh
    [K, 3], ..."""

    before: Tensor
    gradient: Tensor
    """dL/d of the parameter."""
    m: tuple[Tensor, Tensor]
    """Running mean of the gradient, before and after."""
    v: tuple[Tensor, Tensor]
    """Running mean of its square, before and after."""
    after: Tensor
    lr: float | Tensor
    """Learning rate, in units of the parameter: one number, or one for each SH coefficient."""

    def of_row(self, r: int) -> "AdamColumn":
        """The step of one Gaussian."""
        value0, gradient, value1, m0, m1, v0, v1 = (
            x[r].detach().cpu().clone()
            for x in (self.before, self.gradient, self.after, *self.m, *self.v)
        )
        return AdamColumn(
            before=value0,
            gradient=gradient,
            after=value1,
            m=(m0, m1),
            v=(v0, v1),
            lr=self.lr,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class StepRecord(Operation):
    """One optimisation step on one view: rendering, gradient, Adam."""

    stage: str
    """"frame", "keyframe" (another view), or "passes"."""
    view_index: int
    camera: Camera
    ids: Int[Tensor, " R"]
    """Identity of each Gaussian that was rendered."""
    rows: Int[Tensor, " R"]
    """Its row in the map."""
    screen: ScreenGaussians
    rgb: Float[Tensor, "H W 3"]
    loss: Float[Tensor, ""]
    adam: dict[str, AdamColumn]
    """Parameter -> its step."""
    t: int | Int[Tensor, " R"] | None
    """Step number of the bias correction; ``None``: no correction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FusionRecord(Operation):
    """One frame fused into the volume: the blocks that it may change, D and W before and after."""

    frame: Frame
    config: TsdfConfig
    coords: Int[Tensor, "B 3"]
    D: tuple[Float[Tensor, "B 512"], Float[Tensor, "B 512"]]
    W: tuple[Float[Tensor, "B 512"], Float[Tensor, "B 512"]]


@dataclass(frozen=True, kw_only=True, eq=False)
class SeedingRecord(Operation):
    """One question to the seeding rule."""

    frame: Frame
    cells: Any
    """The quadtree, if the rule asked for it."""
    seeds: Seeds


Record = StepRecord | FusionRecord | SeedingRecord


def memory_of(records: Iterable[Record]) -> int:
    """Memory of the tensors that records hold, bytes; one that several share is counted once."""
    storages = (t.untyped_storage() for t in tensors_of(records) if t.numel())
    return sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())


def tensors_of(values: Iterable[Any]) -> Iterator[Tensor]:
    """Every tensor in values that may hold others."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, dict):
            yield from tensors_of(value.values())
        elif isinstance(value, tuple):
            yield from tensors_of(value)
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from tensors_of(vars(value).values())


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment(Operation):
    """One operation as it concerns one voxel or Gaussian."""

    camera: Camera | None = None
    """Of ``image``."""
    image: Any = None
    """The picture that the operation was about [H, W, 3]; ``None`` if it is no longer held."""

    code: ClassVar[tuple[Callable[..., Any], str]]
    """Where the operation is: a function of the file, and a part of the line."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return when(self.frame_index)

    @property
    def boxes(self) -> dict[str, list[Box]]:
        """What the picture shows: "tile", "cell" or "pixel" -> its places."""
        return {}

    @property
    def ellipse(self) -> tuple[Tensor, Tensor] | None:
        """Centre [2] and conic [3] of the Gaussian in the picture."""
        return None

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        raise NotImplementedError

    def source_line(self) -> tuple[str, str]:
        """File with line number, and the line of code that did it."""
        _, code, path, number = source_lines({"": type(self).code}).rows[0]
        return f"{path}:{number}", code

    def __str__(self) -> str:
        place, code = self.source_line()
        width = max(len(name) for name, _ in self.lines())
        body = "\n".join(f"  {name:<{width}}  {value}" for name, value in self.lines())
        return f"{self.title}\n{body}\n  {place}: {code}"


def numbers(values: Tensor, digits: int = 4) -> str:
    """Values in one line."""
    return " ".join(f"{x:.{digits}g}" for x in values.flatten().tolist())


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Rows of text under their heads, aligned to the right."""
    lines = [list(heads), *(list(row) for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return "\n".join(
        "  ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True)) for line in lines
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class TilePlace:
    """Where a Gaussian is in the list of a tile, and what it does at the tile's pixels."""

    tile: tuple[int, int]
    """Column and row of the tile."""
    box: Box
    place: int
    """0: the nearest."""
    length: int
    """Gaussians in the list."""
    pixels: Int[Tensor, "P 2"]
    """(column, row) of the pixels with w above 0."""
    alpha: Float[Tensor, " P"]
    transmittance: Float[Tensor, " P"]
    weight: Float[Tensor, " P"]

    def __str__(self) -> str:
        words = f"place {self.place + 1} of {self.length}, {len(self.weight)} pixels"
        if not len(self.weight):
            return words
        best = int(self.weight.argmax())
        u, v = self.pixels[best].tolist()
        parts = (
            f"α {self.alpha[best]:.4f} × T {self.transmittance[best]:.4f} = w "
            f"{self.weight[best]:.4f}"
        )
        return f"{words}; most at ({u}, {v}): {parts}"


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianStep(Moment):
    """A Gaussian in one optimisation step."""

    code: ClassVar = (adam_update, "param.copy_(param - lr * m_hat / (v_hat.sqrt() + eps))")

    stage: str
    """"frame", "keyframe" or "passes"."""
    view_index: int
    """The frame whose picture was compared."""
    row: int
    """In the map."""
    loss: float
    """Of the view, before the step."""
    uv: Float[Tensor, " 2"]
    """Centre, pixels; without ``tiles`` it and the next four have no meaning."""
    conic: Float[Tensor, " 3"]
    """A, B, C, 1/px^2."""
    depth_m: float
    opacity: float
    rgb: Float[Tensor, " 3"]
    """Colour seen from the camera."""
    tiles: tuple[TilePlace, ...]
    """The tiles in whose lists it is; none if it was not drawn."""
    adam: dict[str, AdamColumn]
    """Parameter -> its step."""
    t: int | None
    """Step number of the bias correction; ``None``: no correction."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return (
            f"{super().title}, step {self.serial} on the view of frame {self.view_index} "
            f"({self.stage})"
        )

    @property
    def boxes(self) -> dict[str, list[Box]]:
        """Its tiles."""
        return {"tile": [tile.box for tile in self.tiles]}

    @property
    def ellipse(self) -> tuple[Tensor, Tensor] | None:
        """Centre [2] and conic [3], if it was drawn."""
        return (self.uv, self.conic) if self.tiles else None

    @property
    def n_pixels(self) -> int:
        """Pixels that it colours."""
        return sum(len(tile.weight) for tile in self.tiles)

    @property
    def weight(self) -> float:
        """Sum of its weights over the picture: how many pixels it makes alone."""
        return sum((float(tile.weight.sum()) for tile in self.tiles), 0.0)

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        rows = [("row", str(self.row)), ("loss of the view", f"{self.loss:.5f}")]
        if self.tiles:
            rows += [("centre u, v px", numbers(self.uv)), ("depth m", f"{self.depth_m:.4f}")]
            rows += [("conic 1/px²", numbers(self.conic)), ("opacity", f"{self.opacity:.4f}")]
            rows += [("colour", numbers(self.rgb, 3))]
        rows += [(f"tile {tile.tile}", str(tile)) for tile in self.tiles]
        rows += [("sum of weights", f"{self.weight:.4f} over {self.n_pixels} pixels")]
        for name, a in self.adam.items():
            label, n = ("sh 0", 3) if name == "sh" else (name, a.after.numel())
            gradient, m, v, old, new = (
                x.flatten()[:n] for x in (a.gradient, a.m[1], a.v[1], a.before, a.after)
            )
            rows += [
                (f"{label}: dL/d", numbers(gradient)),
                ("   m, v after", f"{numbers(m)} | {numbers(v)}"),
            ]
            rows += [("   before → after", f"{numbers(old, 6)} → {numbers(new, 6)}")]
        return rows

    def cells(self) -> list[str]:
        """Its row in the table of a story."""
        a = self.adam["xyz_W"]
        depth, opacity = (
            (f"{self.depth_m:.3f}", f"{self.opacity:.3f}") if self.tiles else ("not drawn", "")
        )
        frame = "-" if self.frame_index is None else str(self.frame_index)
        moved_m = float((a.after - a.before).norm())
        return [
            str(self.serial),
            frame,
            str(self.view_index),
            self.stage,
            str(self.row),
            depth,
            str(self.n_pixels),
            f"{self.weight:.3f}",
            f"{float(a.gradient.norm()):.2e}",
            f"{1e3 * moved_m:.3f}",
            opacity,
        ]


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianSeeded(Moment):
    """A Gaussian when it was seeded."""

    code: ClassVar = (GaussianModel, 'new["xyz_W"][start:stop] = seeds.xyz_W')

    birth: Birth

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return f"{super().title}, born: {self.birth.cause}"

    @property
    def boxes(self) -> dict[str, list[Box]]:
        """Its pixel and its quadtree cell."""
        uv = self.birth.uv
        cell = self.birth.cell
        pixels = [] if uv is None else [(int(uv[0]), int(uv[1]), 1, 1)]
        return {"cell": [] if cell is None else [cell[:4]], "pixel": pixels}

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        return [
            ("number", str(self.birth.id)),
            ("birth", str(self.birth)),
            ("tag", str(self.birth.tag)),
        ]


def gaussian_moment(record: Record, i: int) -> GaussianStep | None:
    """What a record says about Gaussian number ``i``; ``None`` if nothing."""
    if not isinstance(record, StepRecord) or not len(at := (record.ids == i).nonzero()[:, 0]):
        return None
    r = int(at[0])
    s = record.screen
    return GaussianStep(
        serial=record.serial,
        frame_index=record.frame_index,
        camera=record.camera,
        image=record.rgb,
        stage=record.stage,
        view_index=record.view_index,
        row=int(record.rows[r]),
        loss=float(record.loss),
        uv=s.uv[r].cpu().clone(),
        conic=s.conic[r].cpu().clone(),
        depth_m=float(s.depth_m[r]),
        opacity=float(s.opacity[r]),
        rgb=s.rgb[r].cpu().clone(),
        tiles=tuple(_in_tile(s, record.camera, tile, place) for tile, place in s.tiles_with(r)),
        adam={name: column.of_row(r) for name, column in record.adam.items()},
        t=int(record.t[r]) if isinstance(record.t, Tensor) else record.t,
    )


def _in_tile(screen: ScreenGaussians, camera: Camera, tile: int, place: int) -> TilePlace:
    x, y = screen.pixels_of(tile, camera)
    blend = screen.blend(tile, x, y)
    row = tile // screen.tiles.tiles_x
    column = tile % screen.tiles.tiles_x
    alpha, T, w = (a[place].cpu() for a in (blend.alpha, blend.transmittance, blend.weight))
    pixels = torch.stack([x, y], dim=1).cpu()
    has_colour = w > 0
    x0, y0 = pixels[0].tolist()
    x1, y1 = pixels[-1].tolist()
    return TilePlace(
        tile=(column, row),
        box=(x0, y0, x1 - x0 + 1, y1 - y0 + 1),
        place=place,
        length=len(blend.gaussian),
        pixels=pixels[has_colour],
        alpha=alpha[has_colour],
        transmittance=T[has_colour],
        weight=w[has_colour],
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianTrace:
    """Everything that is known of one Gaussian, in order. ``print(t)`` shows a table,
    ``print(t.steps[0])`` a step."""

    id: int
    """Number of the Gaussian, from its birth to its end."""
    row: int | None
    """Its row now; ``None`` if it has left the map."""
    birth: Birth
    moments: tuple[Moment, ...]
    events: tuple[Event, ...]
    n_dropped: int
    """Operations of the whole trace that are no longer held; what they did is known only to those
    who asked before."""

    @property
    def steps(self) -> tuple[GaussianStep, ...]:
        """Its optimisation steps."""
        return tuple(m for m in self.moments if isinstance(m, GaussianStep))

    def __str__(self) -> str:
        place = "no longer in the map" if self.row is None else f"row {self.row} now"
        lines = [f"Gaussian {self.id}, {place}", f"  born: {self.birth}"]
        lines += [f"  {event}" for event in self.events]
        if self.n_dropped:
            lines.append(
                f"  {self.n_dropped} operations are no longer held: give the trace more memory, or "
                "ask earlier"
            )
        heads = (
            "step",
            "frame",
            "view",
            "stage",
            "row",
            "depth m",
            "pixels",
            "Σw",
            "|dL/dxyz|",
            "moved mm",
            "opacity",
        )
        rows = [step.cells() for step in self.steps]
        return "\n".join([*lines, table(heads, rows) if rows else "  no optimisation step is held"])


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
