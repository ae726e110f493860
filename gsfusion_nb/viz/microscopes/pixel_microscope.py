"""Click a pixel of a rendered Gaussian map and see the Gaussians that made it."""

import threading
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import CARD, Picture, to_uint8
from ...render import render
from ...types import Camera, GaussianParams
from ..display import Bundle, with_picture
from ..lost import LostNotice
from ..panels.click_image import ClickImage
from .pixel_stack import Splats, pixel_stack, project_splats, rgb_text, stack_table
from .stack_picture import lens_picture, stack_picture, with_cross

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
