"""Click a pixel and see the Gaussians that made it; of a GPS-SLAM map, what is mixed in it."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...drawing.pictures import Picture, side_by_side, to_uint8
from ...render import SurfacePicture, render
from ...render.over_base import not_behind
from ...types import Camera, GaussianParams
from .ellipses import lens_picture, with_cross
from .panel import Drawn, Panel
from .pixel_blend import Splats, project_splats, reaching
from .pixel_stack import TABLE_ROWS, numbers_table, pixel_stack, rgb_text, swatch, weights_graph
from .touch import pixel_sliders, touched_pixel

PICTURE_PX = 300
"""Height of the pictures, pixels."""
GRAPH_PX = 230
"""Height of the graph below them."""
OUTLINED = 12
"""Number of ellipses in the enlarged neighbourhood."""


class PixelMicroscope(Panel):
    """A picture to click, the pixel's neighbourhood enlarged, and the pixel's stack as a graph and
    as a table.

    Click or drag on the picture, or move the sliders; from Python: ``set(u=u, v=v)``. ``stack`` is
    what is shown.

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
        self._open(
            project_splats(params, camera, T_WC),
            to_uint8(render(params, camera, T_WC).rgb),
            pixel,
        )

    def _open(
        self,
        splats: Splats,
        image: Picture,
        pixel: tuple[int, int] | None,
    ) -> None:
        self.splats = splats
        self.rendered = image
        camera = splats.camera
        super().__init__(
            self._draw,
            pixel_sliders(camera, pixel),
            name="microscope",
            kind="png",
            text="A rendered map",
            touch=lambda stroke, _: touched_pixel(stroke, camera, PICTURE_PX / camera.height),
        )

    def _stack_at(self, u: int, v: int) -> Any:
        return pixel_stack(self.splats, u, v)

    def _draw(self, u: int, v: int) -> Drawn:
        self.stack = s = self._stack_at(u, v)
        heaviest = s.row[s.weight.argsort(descending=True)[:OUTLINED]]
        lens = lens_picture(
            self.rendered,
            self.splats,
            (u, v),
            heaviest,
            size=PICTURE_PX,
        )
        picture = with_cross(self.rendered, u, v, PICTURE_PX)
        top = side_by_side([picture, lens], ["rendered: click a pixel", "enlarged, with ellipses"])
        pixel_words = " ".join(f"{x / 255:.3f}" for x in self.rendered[v, u])
        words = f"pixel ({u}, {v}): {s.caption}; rendered (8 bit) {pixel_words}{s._repr_html_()}"
        return np.concatenate([top, s.graph((top.shape[1], GRAPH_PX))]), words


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelMix:
    """The surface and the K Gaussians of one pixel, with their weights. A notebook shows it as a
    table."""

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
    def samples(self) -> tuple[Float[Tensor, " M"], Float[Tensor, "M 3"]]:
        """Weights and colours, the surface first. [K + 1] and [K + 1, 3]"""
        weight = torch.cat([self.weight.new_tensor([self.base_weight]), self.weight])
        return weight, torch.cat([self.base_rgb[None], self.rgb])

    @property
    def running(self) -> Float[Tensor, "M 3"]:
        """The colour of the surface, then with the first Gaussian, and so on to the pixel's. [K +
        1, 3]"""
        weight, rgb = self.samples
        return (weight[:, None] * rgb).cumsum(0) / weight.cumsum(0).clamp_min(1e-9)[:, None]

    @property
    def colour(self) -> Float[Tensor, "3"]:
        """(b C_s + sum w_k c_k) / (b + W): the colour of the pixel."""
        return self.running[-1]

    @property
    def caption(self) -> str:
        """Number of samples and their mean, as HTML."""
        hidden_words = f", {self.hidden} behind the surface" if self.hidden else ""
        mean = f"W = {self.total:.2f}, mean = {rgb_text(self.colour)}"
        return f"<b>surface and {len(self)} Gaussians</b>{hidden_words}, {mean}"

    def shuffled(self, generator: torch.Generator) -> "PixelMix":
        """The same Gaussians in a random order."""
        order = torch.randperm(len(self), generator=generator)
        parts = {name: getattr(self, name)[order] for name in ("row", "depth_m", "weight", "rgb")}
        return dataclasses.replace(self, **parts)

    def graph(self, size: tuple[int, int]) -> Picture:
        """A bar for each weight, the surface first, and the mean of the samples so far, in two
        orders."""
        other = self.shuffled(torch.Generator().manual_seed(self.u + 1000 * self.v))
        weight, rgb = self.samples
        title = "weights: surface, then Gaussians; below: mean so far, and in another order"
        return weights_graph(
            size, rgb, weight, {"mean": self.running, "shuffled": other.running}, title=title
        )

    def _repr_html_(self) -> str:
        share = 1 / max(self.base_weight + self.total, 1e-9)

        def line(
            k: str,
            row: str,
            depth: str,
            weight: float,
            rgb: Tensor,
        ) -> tuple[str, ...]:
            return (
                k,
                row,
                depth,
                f"{weight:.3f}",
                f"{weight * share:.0%}",
                swatch(rgb),
                rgb_text(rgb),
            )

        lines = [line("", "surface", "", self.base_weight, self.base_rgb)]
        for k in range(min(len(self), TABLE_ROWS)):
            numbers = (f"{self.depth_m[k]:.3f}", float(self.weight[k]), self.rgb[k])
            lines.append(
                line(
                    str(k),
                    str(int(self.row[k])),
                    *numbers,
                )
            )
        mean = line("", "mean", "", self.base_weight + self.total, self.colour)
        return numbers_table(
            ("k", "row", "depth m", "weight", "share", "", "colour"),
            lines,
            mean,
            n=len(self),
        )


def pixel_mix(splats: Splats, surface: SurfacePicture, u: int, v: int) -> PixelMix:
    """What is mixed in pixel (column ``u``, row ``v``), the heaviest Gaussian first.

    Raises:
        ValueError: the pixel is not in the picture.
    """
    p = splats.projection
    base = surface.base
    row, alpha = reaching(splats, u, v)
    w = not_behind(
        alpha[:, None],
        p.depth_m[row],
        base.depth_m[v, u][None],
        surface.behind_m,
    )[:, 0]
    order = w.argsort(descending=True, stable=True)[: int((w > 0).sum())]
    n_hidden = len(row) - len(order)
    row = row[order]
    w = w[order]
    return PixelMix(
        u=u,
        v=v,
        base_rgb=base.rgb[v, u],
        base_weight=float(base.weight[v, u]),
        row=row,
        depth_m=p.depth_m[row],
        weight=w,
        rgb=splats.rgb[row],
        hidden=n_hidden,
    )


class MixMicroscope(PixelMicroscope):
    """A picture to click, the pixel's neighbourhood enlarged, and what is mixed in it as a graph
    and as a table.

    The graph has a bar for each weight, the surface first, and two strips: the mean of all samples
    so far, from left to right, once with the heaviest Gaussian first and once in a random order.
    Both end in the same colour.

    Args:
        mapper: Of GPS-SLAM, or anything with its ``gaussians``, ``surface_picture`` and ``render``.
        camera, T_WC: The camera and pose that the map is seen from.
        pixel: The pixel to start with; the middle by default. (column, row)
    """

    def __init__(
        self,
        mapper: Any,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        *,
        pixel: tuple[int, int] | None = None,
    ):
        self.surface = mapper.surface_picture(camera, T_WC)
        splats = project_splats(mapper.parts.params_now(), camera, T_WC)
        self._open(splats, to_uint8(mapper.render(camera, T_WC).rgb), pixel)

    def _stack_at(self, u: int, v: int) -> PixelMix:
        return pixel_mix(self.splats, self.surface, u, v)
