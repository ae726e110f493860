"""Click a pixel and see the Gaussians that made it; of a GPS-SLAM map, what is mixed in it."""

import dataclasses
import threading
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from markupsafe import Markup
from torch import Tensor

from ...drawing.page import html_table
from ...drawing.pictures import CARD, CARD_INK, Picture, to_uint8
from ...render import BaseView, render
from ...render.composite import pixel_offsets, splat_alpha
from ...render.over_base import not_behind
from ...types import Camera, GaussianParams
from ..display import Bundle, ClickImage, LostNotice, with_picture
from .pixel_stack import (
    CELL_STYLE,
    TABLE_ROWS,
    Splats,
    check_pixel,
    empty_graph,
    lens_picture,
    pixel_stack,
    project_splats,
    rgb_text,
    stack_picture,
    stack_table,
    swatch,
    with_cross,
    write,
)

PICTURE_PX = 300
"""Height of the pictures, pixels."""
OUTLINED = 12
"""Number of ellipses in the enlarged neighbourhood."""


class PixelMicroscope:
    """A picture to click, the pixel's neighbourhood enlarged, and the pixel's stack as a graph and as a table.

    Click or drag on the picture, or use the arrow keys. From Python: ``look_at(u, v)``. ``stack`` is what is shown.

    Args:
        params: The map.
        camera, T_WC: The camera and pose that it is seen from.
        pixel: The pixel to start with; the middle by default. (column, row)
    """

    def __init__(
        self,
        params: GaussianParams,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        *,
        pixel: tuple[int, int] | None = None,
    ):
        self._open(project_splats(params, camera, T_WC), to_uint8(render(params, camera, T_WC).rgb), pixel)

    def _open(self, splats: Splats, image: Picture, pixel: tuple[int, int] | None) -> None:
        """Show this picture, and the pixel to start with."""
        self.splats, self.image = splats, image
        self._lock = threading.RLock()  # callbacks may come from another thread than the cells
        u, v = pixel or (splats.camera.width // 2, splats.camera.height // 2)
        self.stack: Any = self._stack_at(u, v)
        self._build(u, v)
        self._redraw()

    def look_at(self, u: int, v: int) -> Any:
        """Choose the pixel in column ``u`` and row ``v``. Returns its stack."""
        with self._lock:
            self._choose(u, v)
            self.clicks.pixel = (u, v)
        return self.stack

    def pictures(self) -> tuple[Picture, Picture]:
        """The lens and the graph of the chosen pixel."""
        s = self.stack
        heaviest = s.row[s.weight.argsort(descending=True)[:OUTLINED]]
        lens = lens_picture(self.image, self.splats, (s.u, s.v), heaviest, size=PICTURE_PX)
        return lens, stack_picture(s, width=560, height=240)

    def picture(self) -> Picture:
        """Everything but the table in one picture, as a stored notebook shows it."""
        import cv2

        lens, graph = self.pictures()
        image = with_cross(self.image, self.stack.u, self.stack.v, PICTURE_PX)
        top = np.concatenate([image, np.full((PICTURE_PX, 8, 3), CARD, np.uint8), lens], 1)
        graph = cv2.resize(
            graph, (top.shape[1], round(graph.shape[0] * top.shape[1] / graph.shape[1])), interpolation=cv2.INTER_AREA
        )
        return np.concatenate([top, np.full((8, top.shape[1], 3), CARD, np.uint8), graph])

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        return with_picture(
            self.widget._repr_mimebundle_(**kwargs),
            self.picture(),
            repr(self.stack),
            alt=f"{self.lens.alt}; below, {self.graph.alt}",
        )

    def _build(self, u: int, v: int) -> None:
        import ipywidgets as w

        camera = self.splats.camera
        wide = round(camera.width * PICTURE_PX / camera.height)
        self.clicks = ClickImage(camera.width, camera.height, width=wide, alt="the rendered map; click a pixel")
        self.clicks.add_class("gsnb-microscope-image")
        self.clicks.pixel = (u, v)
        self.clicks.observe(self._clicked, "pixel")
        self.lens = ClickImage(PICTURE_PX, PICTURE_PX, width=PICTURE_PX, format="png", touch="")
        self.lens.add_class("gsnb-microscope-lens")
        self.graph = ClickImage(560, 240, width=560, format="png", touch="")
        self.graph.add_class("gsnb-microscope-graph")
        self.caption, self.table = w.HTML(), w.HTML()
        self.table.add_class("gsnb-microscope-table")
        row = w.Layout(flex_flow="row wrap", grid_gap="8px", align_items="flex-start")
        self.widget = w.VBox([
            w.HBox([self.clicks, self.lens], layout=row), self.caption, self.graph, self.table, LostNotice(),
        ])  # fmt: skip
        self.widget.add_class("gsnb-microscope")

    def _clicked(self, _change: Any) -> None:
        with self._lock:
            u, v = self.clicks.pixel  # the newest, which may be newer than the change
            if (u, v) != (self.stack.u, self.stack.v):
                self._choose(u, v)

    def _choose(self, u: int, v: int) -> None:
        self.stack = self._stack_at(u, v)
        self._redraw()

    def _stack_at(self, u: int, v: int) -> Any:
        return pixel_stack(self.splats, u, v)

    def _table(self) -> str:
        return stack_table(self.stack)

    def _graph_alt(self) -> str:
        return f"alpha, weight and light left for each of the {len(self.stack)} Gaussians; the table has the numbers"

    def _caption(self, rendered: str) -> str:
        s = self.stack
        summed = rgb_text(s.colour)
        return f"pixel ({s.u}, {s.v}): <b>{len(s)} Gaussians</b>, sum of w c = {summed}; rendered (8 bit) {rendered}"

    def _redraw(self) -> None:
        s = self.stack
        self.clicks.show(with_cross(self.image, s.u, s.v, PICTURE_PX))
        lens, graph = self.pictures()
        self.lens.show(lens)
        self.graph.show(graph)
        self.clicks.alt = f"the rendered map; click a pixel; now ({s.u}, {s.v})"
        self.lens.alt = f"pixel ({s.u}, {s.v}) and its neighbours, enlarged, with the ellipses of its Gaussians"
        self.graph.alt = self._graph_alt()
        self.table.value = self._table()
        self.caption.value = self._caption(" ".join(f"{x / 255:.3f}" for x in self.image[s.v, s.u]))


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelMix:
    """The surface and the K Gaussians of one pixel, with their weights. A notebook shows it as a table."""

    u: int
    """Pixel column."""
    v: int
    """Pixel row."""
    base_rgb: Float[Tensor, "3"]
    """C_s."""
    base_weight: float
    """b; 1 but where a hole counts nothing."""
    row: Int[Tensor, " K"]
    depth_m: Float[Tensor, " K"]
    weight: Float[Tensor, " K"]
    """w_k."""
    rgb: Float[Tensor, "K 3"]
    """c_k."""
    hidden: int
    """Gaussians that reach the pixel and lie behind the surface: their weight is 0."""

    def __len__(self) -> int:
        return self.row.shape[0]

    @property
    def total(self) -> float:
        """W, the sum of the Gaussians' weights."""
        return float(self.weight.sum())

    @property
    def running(self) -> Float[Tensor, "M 3"]:
        """The colour of the surface, then with the first Gaussian, and so on to the pixel's. [K + 1, 3]"""
        one = torch.cat([self.weight.new_tensor([self.base_weight]), self.weight])
        colours = torch.cat([self.base_rgb[None], self.rgb])
        return (one[:, None] * colours).cumsum(0) / one.cumsum(0).clamp_min(1e-9)[:, None]

    @property
    def colour(self) -> Float[Tensor, "3"]:
        """(b C_s + sum w_k c_k) / (b + W): the colour of the pixel."""
        return self.running[-1]

    def shuffled(self, generator: torch.Generator) -> "PixelMix":
        """The same Gaussians in a random order."""
        order = torch.randperm(len(self), generator=generator)
        parts = {name: getattr(self, name)[order] for name in ("row", "depth_m", "weight", "rgb")}
        return dataclasses.replace(self, **parts)

    def __repr__(self) -> str:
        r, g, b = self.colour.tolist()
        return (
            f"PixelMix(pixel ({self.u}, {self.v}), surface and {len(self)} Gaussians, W {self.total:.2f}, "
            f"colour {r:.3f} {g:.3f} {b:.3f})"
        )

    def _repr_html_(self) -> str:
        return mix_table(self)


def pixel_mix(splats: Splats, below: BaseView, u: int, v: int) -> PixelMix:
    """What is mixed in pixel (column ``u``, row ``v``), the heaviest Gaussian first.

    Raises:
        ValueError: the pixel is not in the picture.
    """
    check_pixel(splats.camera, u, v)
    p, base = splats.projection, below.base
    centre = p.uv.new_tensor([u + 0.5, v + 0.5])
    row = (p.visible & ((p.uv - centre).abs() <= p.extent_px).all(1)).nonzero().squeeze(1)
    dx, dy = pixel_offsets(p.uv[row], torch.tensor([u]), torch.tensor([v]))
    alpha = splat_alpha(dx, dy, p.conic[row], p.opacity[row])[:, 0]
    row, alpha = row[alpha > 0], alpha[alpha > 0]
    w = not_behind(alpha[:, None], p.depth_m[row], base.depth_m[v, u][None], below.behind_m)[:, 0]
    hidden = w == 0
    row, w = row[~hidden], w[~hidden]
    order = w.argsort(descending=True, stable=True)
    row, w = row[order], w[order]
    return PixelMix(
        u=u, v=v, base_rgb=base.rgb[v, u], base_weight=float(base.weight[v, u]), row=row, depth_m=p.depth_m[row],
        weight=w, rgb=splats.rgb[row], hidden=int(hidden.sum()),
    )  # fmt: skip


def mix_table(mix: PixelMix, rows: int = TABLE_ROWS) -> str:
    """The mix as an HTML table: surface, Gaussians, and the mean below."""
    share = 1 / max(mix.base_weight + mix.total, 1e-9)
    lines: list[tuple[str, ...]] = [_line("", "surface", "", mix.base_weight, mix.base_rgb, share)]
    shown = min(len(mix), rows)
    for k in range(shown):
        lines.append(
            _line(str(k), str(int(mix.row[k])), f"{mix.depth_m[k]:.3f}", float(mix.weight[k]), mix.rgb[k], share)
        )
    if shown < len(mix):
        rest = float(mix.weight[shown:].sum())
        lines.append(("", f"… {len(mix) - shown} more", "", f"{rest:.3f}", f"{rest * share:.0%}", "", ""))
    total = mix.base_weight + mix.total
    mean = ("", "mean", "", f"{total:.3f}", "100%", swatch(mix.colour), rgb_text(mix.colour))
    lines.append(tuple(Markup("<b>{}</b>").format(x) for x in mean))
    heads = ("k", "row", "depth m", "weight", "share", "", "colour")
    return html_table(lines, heads=heads, name="gsnb-stack", style="font-size:12px", cell_style=CELL_STYLE)


def _line(k: str, row: str, depth: str, weight: float, rgb: Tensor, share: float) -> tuple[str, ...]:
    return k, row, depth, f"{weight:.3f}", f"{weight * share:.0%}", swatch(rgb), rgb_text(rgb)


class MixMicroscope(PixelMicroscope):
    """A picture to click, the pixel's neighbourhood enlarged, and what is mixed in it as a graph and as a table.

    The graph has a bar for each weight, the surface first, and two strips: the mean of all samples so far, from left to
    right, once with the heaviest Gaussian first and once in a random order. Both end in the same colour.

    Click or drag on the picture, or use the arrow keys. From Python: ``look_at(u, v)``. ``stack`` is what is shown.

    Args:
        mapper: Of GPS-SLAM, or anything with its ``gaussians``, ``below`` and ``render``.
        camera, T_WC: The camera and pose that the map is seen from.
        pixel: The pixel to start with; the middle by default. (column, row)
    """

    def __init__(
        self, mapper: Any, camera: Camera, T_WC: Float[Tensor, "4 4"], *, pixel: tuple[int, int] | None = None
    ):
        self.below = mapper.below(camera, T_WC)
        splats = project_splats(mapper.gaussians.params, camera, T_WC)
        self._open(splats, to_uint8(mapper.render(camera, T_WC).rgb), pixel)

    def pictures(self) -> tuple[Picture, Picture]:
        """The lens and the graph of the chosen pixel."""
        s = self.stack
        lens = lens_picture(self.image, self.splats, (s.u, s.v), s.row[:OUTLINED], size=PICTURE_PX)
        return lens, mix_picture(s, width=560, height=260)

    def _stack_at(self, u: int, v: int) -> PixelMix:
        return pixel_mix(self.splats, self.below, u, v)

    def _table(self) -> str:
        return mix_table(self.stack)

    def _graph_alt(self) -> str:
        return (
            f"weight of the surface and of each of the {len(self.stack)} Gaussians, and the mean in two orders; "
            "the table has the numbers"
        )

    def _caption(self, rendered: str) -> str:
        s = self.stack
        behind = f", {s.hidden} behind the surface" if s.hidden else ""
        return (
            f"pixel ({s.u}, {s.v}): <b>surface and {len(s)} Gaussians</b>{behind}, W = {s.total:.2f}, "
            f"mean = {rgb_text(s.colour)}; rendered (8 bit) {rendered}"
        )


def mix_picture(mix: PixelMix, *, width: int = 560, height: int = 260, scale: int = 2) -> Picture:
    """One bar for each weight, the surface first; below, the mean of the samples so far, in two orders.

    Args:
        mix: From ``pixel_mix``.
        width, height: Size on screen, pixels.
        scale: Picture pixels per screen pixel.
    """
    s = scale
    image, (left, right, top, bottom) = empty_graph(width, height, s, left_px=64, below_px=84)
    write(image, "weight: the surface first, then the Gaussians, heaviest first", left, 14 * s, s, ink=CARD_INK)
    edges = np.linspace(left, right, len(mix) + 2).round().astype(int)
    weights = [mix.base_weight, *mix.weight.tolist()]
    colours = to_uint8(torch.cat([mix.base_rgb[None], mix.rgb]).clamp(0, 1)[None])[0]
    for k, (w, colour) in enumerate(zip(weights, colours, strict=True)):
        y = round(bottom + min(w, 1.0) * (top - bottom))
        corners = (int(edges[k]), y), (max(int(edges[k + 1]) - s, int(edges[k]) + 1), bottom)
        cv2.rectangle(image, *corners, tuple(int(c) for c in colour), -1)
        cv2.rectangle(image, *corners, (150, 156, 166), 1)
    orders = {"mean": mix, "shuffled": mix.shuffled(torch.Generator().manual_seed(mix.u + 1000 * mix.v))}
    for i, (name, order) in enumerate(orders.items()):
        strip = slice((height - 72 + 26 * i) * s, (height - 54 + 26 * i) * s)
        write(image, name, 4 * s, strip.stop - 5 * s, s, ink=CARD_INK)
        for k, colour in enumerate(to_uint8(order.running.clamp(0, 1)[None])[0]):
            image[strip, edges[k] : edges[k + 1]] = colour
    caption = "mean of the samples so far, left to right: another order, the same end"
    write(image, caption, left, (height - 8) * s, s, ink=CARD_INK)
    return image
