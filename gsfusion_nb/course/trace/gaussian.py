"""One operation as it concerns what is followed: numbers with names, a picture with marks, and the line of code.

And one Gaussian through the steps of a mapper.
"""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...gaussians import GaussianModel
from ...optim import adam_update
from ...types import Camera
from ..source_lines import source_lines
from .identity import Birth, Event
from .records import Record, SeedingRecord, StepRecord


@dataclass(frozen=True, kw_only=True)
class Marks:
    """What a picture of a moment shows, pixels of the image."""

    pixel: tuple[int, int] | None = None
    """(column, row)"""
    cell: tuple[int, int, int, int] | None = None
    """First column, first row, width, height."""
    tiles: tuple[tuple[int, int, int, int], ...] = ()
    """First column, first row, width, height of each."""
    ellipse: tuple[float, float, float, float, float] | None = None
    """u, v and the conic A, B, C."""
    dots: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """One operation as it concerns one pixel, voxel or Gaussian."""

    serial: int
    """Number of the operation, rising."""
    frame_index: int | None
    """The frame that was being mapped; ``None`` in the passes after the scan."""
    camera: Camera | None = None
    """Of ``image``."""
    image: Any = None
    """The picture that the operation was about [H, W, 3]; ``None`` if it is no longer held."""
    marks: Marks = Marks()

    code: ClassVar[tuple[Callable[..., Any], str]]
    """Where the operation is: a function of the file, and a part of the line."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return "after the scan" if self.frame_index is None else f"frame {self.frame_index}"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        raise NotImplementedError

    def source_line(self) -> tuple[str, str]:
        """File with line number, and the line of code that did it."""
        _, code, path, number = source_lines({"": type(self).code}).rows[0]
        return f"{path}:{number}", code

    def without_image(self) -> "Moment":
        """The same without the picture, which takes most of the memory."""
        return dataclasses.replace(self, image=None)

    def __str__(self) -> str:
        place, code = self.source_line()
        width = max(len(name) for name, _ in self.lines())
        body = "\n".join(f"  {name:<{width}}  {value}" for name, value in self.lines())
        return f"{self.title}\n{body}\n  {place}: {code}"


def numbers(values: Any, digits: int = 4) -> str:
    """Values in one line."""
    if isinstance(values, Tensor):
        values = values.detach().flatten().tolist()
    if not isinstance(values, Iterable):
        return f"{values:.{digits}g}"
    return " ".join(f"{float(v):.{digits}g}" for v in values)


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Rows of text under their heads, aligned to the right."""
    lines = [list(heads), *(list(row) for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return "\n".join("  ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True)) for line in lines)


def common(record: Record) -> dict[str, Any]:
    """The fields of a moment that come from its record."""
    return {"serial": record.serial, "frame_index": record.frame_index}


def where(ids: Tensor, i: int) -> int | None:
    """Place of number ``i``, or ``None``."""
    at = (ids == i).nonzero()[:, 0]
    return int(at[0]) if len(at) else None


def box(tile: int, tile_px: int, tiles_x: int, camera: Camera) -> tuple[int, int, int, int]:
    """First column, first row, width, height of a tile."""
    y, x = tile // tiles_x * tile_px, tile % tiles_x * tile_px
    return x, y, min(tile_px, camera.width - x), min(tile_px, camera.height - y)


@dataclass(frozen=True, kw_only=True, eq=False)
class TilePlace:
    """Where a Gaussian is in the list of a tile, and what it does at the tile's pixels."""

    tile: tuple[int, int]
    """Column and row of the tile."""
    place: int
    """0: the nearest."""
    length: int
    """Gaussians in the list."""
    pixels: Int[Tensor, "P 2"]
    """(column, row) of the pixels with w above 0."""
    alpha: Float[Tensor, " P"]
    transmittance: Float[Tensor, " P"]
    weight: Float[Tensor, " P"]


@dataclass(frozen=True, kw_only=True, eq=False)
class AdamRow:
    """One parameter of one Gaussian in one step of Adam; shapes as in the map: xyz_W [3], sh [K, 3], ..."""

    before: Tensor
    gradient: Tensor
    """dL/d of the parameter."""
    m: tuple[Tensor, Tensor]
    """Running mean of the gradient, before and after."""
    v: tuple[Tensor, Tensor]
    """Running mean of its square, before and after."""
    after: Tensor
    lr: float | Tensor
    """Learning rate, in units of the parameter."""


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
    drawn: bool
    """Whether it is in the list of a tile; if not, the projection is not known."""
    uv: Float[Tensor, " 2"]
    """Centre, pixels."""
    conic: Float[Tensor, " 3"]
    """A, B, C, 1/px^2."""
    depth_m: float
    opacity: float
    rgb: Float[Tensor, " 3"]
    """Colour seen from the camera."""
    tiles: tuple[TilePlace, ...]
    adam: dict[str, AdamRow]
    """Parameter -> its step."""
    t: int | None
    """Step number of the bias correction; ``None``: no correction."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return f"{super().title}, step {self.serial} on the view of frame {self.view_index} ({self.stage})"

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
        out = [("row", str(self.row)), ("loss of the view", f"{self.loss:.5f}")]
        if self.drawn:
            out += [("centre u, v px", numbers(self.uv)), ("depth m", f"{self.depth_m:.4f}")]
            out += [("conic 1/px²", numbers(self.conic)), ("opacity", f"{self.opacity:.4f}")]
            out += [("colour", numbers(self.rgb, 3))]
        for tile in self.tiles:
            best = int(tile.weight.argmax()) if len(tile.weight) else None
            words = f"place {tile.place + 1} of {tile.length}, {len(tile.weight)} pixels"
            if best is not None:
                u, v = tile.pixels[best].tolist()
                words += (
                    f"; most at ({u}, {v}): α {tile.alpha[best]:.4f} × T {tile.transmittance[best]:.4f} = "
                    f"w {tile.weight[best]:.4f}"
                )
            out.append((f"tile ({tile.tile[0]}, {tile.tile[1]})", words))
        out += [("sum of weights", f"{self.weight:.4f} over {self.n_pixels} pixels")]
        for name, a in self.adam.items():
            dc = slice(0, 3) if name == "sh" else slice(None)
            parts = [x.flatten()[dc] for x in (a.gradient, a.m[1], a.v[1], a.before, a.after)]
            label = "sh 0" if name == "sh" else name
            out += [
                (f"{label}: dL/d", numbers(parts[0])),
                ("   m, v after", f"{numbers(parts[1])} | {numbers(parts[2])}"),
            ]
            out += [("   before → after", f"{numbers(parts[3], 6)} → {numbers(parts[4], 6)}")]
        return out


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianSeeded(Moment):
    """A Gaussian when it was seeded."""

    code: ClassVar = (GaussianModel, 'new["xyz_W"][start:stop] = seeds.xyz_W')

    birth: Birth

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return f"{super().title}, born: {self.birth.cause}"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        return [("number", str(self.birth.id)), ("birth", str(self.birth)), ("tag", str(self.birth.tag))]


def seeded(record: SeedingRecord | None, birth: Birth) -> GaussianSeeded:
    """The moment of a birth; with the picture, if its record is still held."""
    marks = Marks(
        pixel=None if birth.uv is None else (int(birth.uv[0]), int(birth.uv[1])),
        cell=None if birth.cell is None else birth.cell[:4],
    )
    frame = None if record is None else record.frame
    return GaussianSeeded(
        serial=-1 if record is None else record.serial, frame_index=birth.frame_index, birth=birth, marks=marks,
        camera=None if frame is None else frame.camera, image=None if frame is None else frame.colour,
    )  # fmt: skip


def gaussian_moment(record: Record, i: int) -> GaussianStep | None:
    """What a record says about Gaussian number ``i``; ``None`` if nothing."""
    if not isinstance(record, StepRecord):
        return None
    r = where(record.ids, i)
    if r is None:
        return None
    s, camera = record.screen, record.camera
    lists = s.tiles_with(r)
    places = tuple(_place(record, r, tile, place) for tile, place in lists)
    A, B, C = s.conic[r].tolist()
    u, v = s.uv[r].tolist()
    size = s.tiles
    marks = Marks(
        ellipse=(u, v, A, B, C), tiles=tuple(box(tile, size.tile_px, size.tiles_x, camera) for tile, _ in lists)
    )
    return GaussianStep(
        **common(record), camera=camera, image=record.rgb, marks=marks if lists else Marks(),
        stage=record.stage, view_index=record.view_index, row=int(record.rows[r]),
        loss=float(record.loss), drawn=bool(lists), uv=s.uv[r].cpu().clone(), conic=s.conic[r].cpu().clone(),
        depth_m=float(s.depth_m[r]), opacity=float(s.opacity[r]), rgb=s.rgb[r].cpu().clone(), tiles=places,
        adam=_adam(record, r), t=int(record.t[r]) if isinstance(record.t, Tensor) else record.t,
    )  # fmt: skip


def _adam(record: StepRecord, r: int) -> dict[str, AdamRow]:
    out = {}
    for name, column in record.adam.items():
        c = {key: value[r].detach().cpu().clone() for key, value in vars(column).items()}
        rate = record.rates[name]
        out[name] = AdamRow(
            before=c["before"], gradient=c["gradient"], m=(c["m_before"], c["m_after"]),
            v=(c["v_before"], c["v_after"]), after=c["after"],
            lr=rate.cpu().clone() if isinstance(rate, Tensor) else rate,
        )  # fmt: skip
    return out


def _place(record: StepRecord, r: int, tile: int, place: int) -> TilePlace:
    s = record.screen
    x, y = s.pixels_of(tile, record.camera)
    blend = s.blend(tile, x, y)
    alpha, T, w = blend.alpha[place], blend.transmittance[place], blend.weight[place]
    coloured = w > 0
    return TilePlace(
        tile=(tile % s.tiles.tiles_x, tile // s.tiles.tiles_x), place=place, length=len(blend.gaussian),
        pixels=torch.stack([x[coloured], y[coloured]], dim=1).cpu(), alpha=alpha[coloured].cpu().clone(),
        transmittance=T[coloured].cpu().clone(), weight=w[coloured].cpu().clone(),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianTrace:
    """Everything that is known of one Gaussian, in order. ``print(t)`` shows a table, ``print(t.steps[0])`` a step."""

    id: int
    """Number of the Gaussian, from its birth to its end."""
    row: int | None
    """Its row now; ``None`` if it has left the map."""
    birth: Birth
    moments: tuple[Moment, ...]
    events: tuple[Event, ...]
    n_dropped: int
    """Operations of the whole trace that are no longer held; what they did is known only to those who asked before."""

    @property
    def steps(self) -> tuple[GaussianStep, ...]:
        """Its optimisation steps."""
        return tuple(m for m in self.moments if isinstance(m, GaussianStep))

    def __len__(self) -> int:
        return len(self.moments)

    def __str__(self) -> str:
        now = "no longer in the map" if self.row is None else f"row {self.row} now"
        out = [f"Gaussian {self.id}, {now}", f"  born: {self.birth}"]
        out += [f"  {event}" for event in self.events]
        heads = ("step", "frame", "view", "stage", "row", "depth m", "pixels", "Σw", "|dL/dxyz|", "moved mm", "opacity")
        rows = [_row_of(step) for step in self.steps]
        if self.n_dropped:
            out.append(f"  {self.n_dropped} operations are no longer held: give the trace more memory, or ask earlier")
        return "\n".join([*out, table(heads, rows)] if rows else [*out, "  no optimisation step is held"])


def _row_of(s: GaussianStep) -> list[str]:
    a, opacity = s.adam["xyz_W"], f"{s.opacity:.3f}" if s.drawn else ""
    moved, gradient = f"{1e3 * float((a.after - a.before).norm()):.3f}", f"{float(a.gradient.norm()):.2e}"
    frame = "-" if s.frame_index is None else str(s.frame_index)
    depth = f"{s.depth_m:.3f}" if s.drawn else "not drawn"
    return [str(s.serial), frame, str(s.view_index), s.stage, str(s.row), depth, str(s.n_pixels), f"{s.weight:.3f}",
            gradient, moved, opacity]  # fmt: skip
