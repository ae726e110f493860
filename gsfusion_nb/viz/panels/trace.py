"""A panel of a trace: a slider over everything that happened to a pixel, a voxel or a Gaussian, forwards and back."""

import threading
from typing import Any

import numpy as np
import torch
from markupsafe import Markup

from ...checks import check_name
from ...drawing.page import html_table
from ...drawing.pictures import Picture, to_uint8
from ..display import Bundle, ClickImage, LostNotice, with_picture
from .pixel_stack import CROSS, ellipse_outlines, write

FOLLOWS = ("pixel", "Gaussian", "voxel")
"""What a click can follow."""
WIDTH_PX = 440
"""Width of the picture on screen, pixels."""
_TILE, _CELL = (64, 156, 255), (255, 80, 80)


class TracePanel:
    """Everything that happened to one pixel, Gaussian or voxel: a slider over the moments, a picture, numbers, code.

    The picture is that of the operation: blue frames are tiles, the red one is the quadtree cell, the yellow mark is
    the pixel, and the ellipse is the Gaussian at one standard deviation. A click on the picture (or the arrow keys)
    follows what *click follows* says: the pixel, the Gaussian with the largest weight there, or the voxel of the
    surface there. From Python: ``look_at(pixel=(u, v))``, ``look_at(gaussian=7)``, ``look_at(id=7)``,
    ``look_at(voxel=(x, y, z))``, and ``go_to(k)``. ``story`` is what is shown.

    Args:
        trace: The ``gsfusion_nb.course.trace.Trace`` of a mapper. Its answers are stories with ``moments``, in
            order; each has ``title``, ``lines()``, ``source_line()``, ``image`` and ``marks``.
        what: As for ``look_at``; the pixel in the middle of the first picture by default.

    Raises:
        ValueError: nothing was recorded yet.
    """

    def __init__(self, trace: Any, **what: Any):
        self.trace = trace
        self._lock = threading.RLock()  # callbacks may come from another thread than the cells
        self._quiet = False
        self._build()
        self.look_at(**(what or {"pixel": (0, 0)}))
        if not what and (shown := self._moment) is not None:
            self.look_at(pixel=(shown.camera.width // 2, shown.camera.height // 2))

    def look_at(
        self,
        *,
        pixel: tuple[int, int] | None = None,
        gaussian: int | None = None,
        id: int | None = None,
        voxel: tuple[int, int, int] | None = None,
    ) -> Any:
        """Follow a pixel (u, v), the Gaussian in a row of the map, the one with a number, or a voxel.

        Raises:
            ValueError: not exactly one of them is given, or nothing is known of it.
        """
        given = {
            k: x for k, x in {"pixel": pixel, "gaussian": gaussian, "id": id, "voxel": voxel}.items() if x is not None
        }
        if len(given) != 1:
            raise ValueError(f"give one of pixel, gaussian, id and voxel, got {sorted(given) or 'none'}")
        if pixel is not None:
            story, name = self.trace.pixel(*pixel), f"pixel {pixel}"
        elif voxel is not None:
            story, name = self.trace.voxel(*voxel), f"voxel {voxel}"
        else:
            story = self.trace.gaussian(gaussian, id=id)
            name = f"Gaussian {story.id}"
        if not story.moments:
            raise ValueError(f"nothing is recorded of {name}: map a frame while the trace is open")
        return self.show_story(story, name, self.slider.value)

    def show_story(self, story: Any, name: str, k: int) -> Any:
        """Show moment ``k`` of a story that the trace told before, and its name; the last one for larger numbers."""
        with self._lock:
            self.story, self.name = story, name
            self._quiet = True
            self.slider.max = len(story.moments) - 1
            self.slider.value = min(k, self.slider.max)
            self._quiet = False
            self._redraw()
        return story

    def go_to(self, k: int) -> "TracePanel":
        """Show moment ``k`` of the story, from 0; the last one for larger numbers."""
        self.slider.value = min(max(k, 0), self.slider.max)
        return self

    def follow_picks(self, viewer: Any) -> "TracePanel":
        """Follow each Gaussian that is clicked in a ``SplatViewer`` of the same map."""
        viewer.observe(lambda change: self._picked(change["new"]), "picked")
        return self

    def picture(self) -> Picture:
        """The picture of the present moment, with its marks."""
        return moment_picture(self._moment)

    @property
    def follows(self) -> str:
        """What a click follows: "pixel", "Gaussian" or "voxel"."""
        return str(self.choice.value)

    @follows.setter
    def follows(self, follows: str) -> None:
        check_name("follows", follows, FOLLOWS)
        self.choice.value = follows

    def follow(self, u: int, v: int) -> None:
        """Follow what a click on a pixel of the present picture follows.

        Raises:
            ValueError: nothing is recorded there.
        """
        serial = self._moment.serial
        if self.follows == "voxel":
            fused = [m for m in self.trace.pixel(u, v).moments if getattr(m, "voxels", ())]
            if not fused:
                raise ValueError(f"no depth was fused at pixel ({u}, {v})")
            now = min(fused, key=lambda m: abs(m.serial - serial))
            self.look_at(voxel=min(now.voxels, key=lambda x: abs(x.z_m - now.depth_m)).ijk)
        elif self.follows == "Gaussian":
            steps = [m for m in self.trace.pixel(u, v).steps if len(m.ids)]
            if not steps:
                raise ValueError(f"no Gaussian colours pixel ({u}, {v})")
            now = min(steps, key=lambda m: abs(m.serial - serial))
            self.look_at(id=int(now.ids[now.weight.argmax()]))
        else:
            self.look_at(pixel=(u, v))
        self._go_near(serial)

    @property
    def _moment(self) -> Any:
        return self.story.moments[self.slider.value]

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        text = f"{self.name}, moment {self.slider.value + 1} of {len(self.story.moments)}\n{self._moment}"
        return with_picture(self.widget._repr_mimebundle_(**kwargs), self.picture(), text, alt=self.clicks.alt)

    def _build(self) -> None:
        import ipywidgets as w

        self.clicks = ClickImage(1, 1, width=WIDTH_PX, format="png", alt="the picture of the operation; click a pixel")
        self.clicks.add_class("gsnb-trace-image")
        self.clicks.observe(self._clicked, "pixel")
        self.slider = w.IntSlider(
            min=0,
            max=0,
            description="moment",
            layout=w.Layout(width=f"{WIDTH_PX}px"),
            tooltip="what happened, in order",
        )
        self.slider.add_class("gsnb-trace-moment")
        self.slider.observe(self._moved, "value")
        self.choice = w.Dropdown(
            options=list(FOLLOWS), description="click follows", style={"description_width": "90px"}
        )
        self.choice.layout.width = "220px"
        self.choice.add_class("gsnb-trace-follows")
        self.back, self.next = (
            w.Button(description=name, icon=icon, layout=w.Layout(width="104px"), tooltip=f"{name} moment")
            for name, icon in (("Previous", "step-backward"), ("Next", "step-forward"))
        )
        self.back.add_class("gsnb-trace-previous")
        self.next.add_class("gsnb-trace-next")
        self.back.on_click(lambda _: self.go_to(self.slider.value - 1))
        self.next.on_click(lambda _: self.go_to(self.slider.value + 1))
        beside = w.Layout(flex="1 1 320px", min_width="300px", max_height="460px", overflow="auto")
        self.numbers = w.HTML(layout=beside)
        self.numbers.add_class("gsnb-trace-numbers")
        buttons = w.HBox([self.back, self.next, self.choice], layout=w.Layout(flex_flow="row wrap"))
        left = w.VBox([self.clicks, self.slider, buttons, LostNotice()], layout=w.Layout(width=f"{WIDTH_PX + 12}px"))
        row = w.Layout(flex_flow="row wrap", align_items="flex-start", grid_gap="12px")
        self.widget = w.HBox([left, self.numbers], layout=row)
        self.widget.add_class("gsnb-trace")

    def _moved(self, _change: Any) -> None:
        if not self._quiet:
            with self._lock:
                self._redraw()

    def _clicked(self, _change: Any) -> None:
        if self._quiet:
            return
        u, v = self.clicks.pixel
        with self._lock:
            try:
                self.follow(u, v)
            except (ValueError, IndexError) as error:
                self.numbers.value = str(Markup("<b>{}</b>").format(str(error)))

    def _go_near(self, serial: int) -> None:
        """Show the moment of the story that is next to an operation."""
        moments = self.story.moments
        self.go_to(min(range(len(moments)), key=lambda k: abs(moments[k].serial - serial)))

    def _picked(self, row: int | None) -> None:
        if row is None:
            return
        try:
            self.look_at(gaussian=row)
        except (ValueError, IndexError) as error:
            self.numbers.value = str(Markup("<b>{}</b>").format(str(error)))

    def _redraw(self) -> None:
        moment = self._moment
        if moment.camera is not None:
            self._quiet = True
            self.clicks.size = (moment.camera.width, moment.camera.height)
            if moment.marks.pixel is not None:
                self.clicks.pixel = moment.marks.pixel
            self._quiet = False
        self.clicks.show(self.picture())
        self.clicks.alt = f"{self.name}: {moment.title}; click a pixel to follow it"
        self.back.disabled, self.next.disabled = self.slider.value == 0, self.slider.value == self.slider.max
        place, code = moment.source_line()
        head = Markup("<b>{}</b>, {} of {}: {}").format(
            self.name, self.slider.value + 1, len(self.story.moments), moment.title
        )
        table = Markup(html_table(moment.lines(), style="font-size:12px", cell_style="text-align:left;padding:1px 6px"))
        line = Markup('<div style="font-size:12px;overflow-wrap:anywhere">{}: <code>{}</code></div>').format(
            place, code
        )
        self.numbers.value = str(Markup('<div style="line-height:1.4">{}</div>').format(head) + table + line)


def moment_picture(moment: Any, width: int = WIDTH_PX) -> Picture:
    """The image of a moment, enlarged to ``width`` pixels, with its marks; grey if the image is no longer held."""
    import cv2

    camera = moment.camera
    if camera is None:
        picture = np.full((60, width, 3), 236, np.uint8)
        write(picture, "the picture of this moment is no longer held", 12, 34, 1)
        return picture
    zoom = width / camera.width
    size = (width, round(camera.height * zoom))
    if moment.image is None:
        picture = np.full((size[1], size[0], 3), 200, np.uint8)
    else:
        picture = np.array(cv2.resize(to_uint8(moment.image), size, interpolation=cv2.INTER_NEAREST), np.uint8)
    marks = moment.marks
    for box in marks.tiles:
        _box(picture, box, zoom, _TILE)
    if marks.cell is not None:
        _box(picture, marks.cell, zoom, _CELL)
    if marks.ellipse is not None:
        uv, conic = torch.tensor([marks.ellipse[:2]]), torch.tensor([marks.ellipse[2:]])
        ring = (ellipse_outlines(uv, conic)[0] * zoom * 16).round().clip(-1e6, 1e6).astype(np.int32)
        for ink, wide in (((0, 0, 0), 4), (CROSS, 2)):
            cv2.polylines(picture, [ring], True, ink, wide, cv2.LINE_AA, shift=4)
    if marks.pixel is not None:
        u, v = marks.pixel
        _box(picture, (u, v, 1, 1), zoom, CROSS)
    return picture


def _box(picture: Picture, box: tuple[int, int, int, int], zoom: float, ink: tuple[int, int, int]) -> None:
    import cv2

    x, y, w, h = box
    low, high = (round(x * zoom), round(y * zoom)), (round((x + w) * zoom) - 1, round((y + h) * zoom) - 1)
    cv2.rectangle(picture, low, high, (0, 0, 0), 3)
    cv2.rectangle(picture, low, high, ink, 1)
