"""Click a pixel of a GPS-SLAM map and see what is mixed in it: the surface, each Gaussian, and their mean."""

from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.ground import CARD_INK
from ...drawing.pictures import Picture, to_uint8
from ...types import Camera
from .pixel_microscope import OUTLINED, PICTURE_PX, PixelMicroscope
from .pixel_mix import PixelMix, mix_table, pixel_mix
from .pixel_stack import project_splats, rgb_text
from .stack_picture import empty_graph, lens_picture, write


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
