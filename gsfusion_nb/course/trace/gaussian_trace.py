"""What the operations say about one Gaussian."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...gaussians import GaussianModel
from ...optim import adam_update
from ...render import ScreenGaussians
from ...types import Camera
from .identity import Birth, Event
from .moments import Moment, numbers, table
from .operations import AdamColumn, Box, Record, StepRecord


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

    code: ClassVar = (GaussianModel, "params.xyz_W[rows] = seeds.xyz_W")

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
