"""A panel of a trace: a slider over everything that happened to a pixel, a voxel or a Gaussian, forwards and back."""

from collections.abc import Sequence
from typing import Any

import torch
from markupsafe import Markup

from ...drawing.curves import figure_picture, image_figure
from ...drawing.page import html_table
from ...drawing.pictures import Picture
from ..display import Stroke
from .panel import Choice, Drawn, Panel, Slider
from .pixel_stack import CROSS, ellipse_outlines

FOLLOWS = ("pixel", "Gaussian", "voxel")
"""What a click can follow."""
WIDTH_PX = 440
"""Width of the picture on screen, pixels."""


class TracePanel(Panel):
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
        self.story, self.name_of_story = self._told(**(what or {"pixel": (0, 0)}))
        controls = {
            "moment": Slider(value=0, low=0, high=len(self.story.moments) - 1, step=1, label="moment"),
            "follows": Choice(value=FOLLOWS[0], options=FOLLOWS, label="click follows"),
        }
        buttons = {"Previous": lambda: self.go_to(self.moment - 1), "Next": lambda: self.go_to(self.moment + 1)}
        text = "The picture of an operation; click a pixel to follow it"
        super().__init__(
            self._draw, controls, buttons=buttons, name="trace", kind="png", text=text,
            touch=lambda stroke, _: self._clicked(stroke),
        )  # fmt: skip
        if not what and (camera := self.story.moments[0].camera) is not None:
            self.look_at(pixel=(camera.width // 2, camera.height // 2))

    @property
    def moment(self) -> int:
        """Number of the moment that is shown, from 0."""
        return self.values["moment"]

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
        with self.lock:
            self.story, self.name_of_story = self._told(pixel=pixel, gaussian=gaussian, id=id, voxel=voxel)
            self._quiet = True
            self.controls["moment"].max = len(self.story.moments) - 1
            self._quiet = False
            self.go_to(self.moment)
        return self.story

    def go_to(self, k: int) -> "TracePanel":
        """Show moment ``k`` of the story, from 0; the last one for larger numbers."""
        self.set(moment=min(max(k, 0), len(self.story.moments) - 1))
        return self

    def follow_picks(self, viewer: Any) -> "TracePanel":
        """Follow each Gaussian that is clicked in a ``SplatViewer`` of the same map."""
        viewer.observe(lambda change: self._picked(change["new"]), "picked")
        return self

    def _clicked(self, stroke: Stroke) -> dict[str, Any]:
        """Follow what a click there follows, from the moment of the present operation on."""
        now = self.story.moments[self.moment]
        if now.camera is None:
            return {}
        zoom, camera = WIDTH_PX / now.camera.width, now.camera
        u, v = min(int(stroke.now[0] / zoom), camera.width - 1), min(int(stroke.now[1] / zoom), camera.height - 1)
        follows, of_pixel = self.values["follows"], self.trace.pixel(u, v)

        def nearest(moments: Sequence[Any]) -> int:
            if not moments:
                raise ValueError(f"no {follows} is known at pixel ({u}, {v})")
            return min(range(len(moments)), key=lambda k: abs(moments[k].serial - now.serial))

        what: dict[str, Any] = {"pixel": (u, v)}
        if follows == "voxel":
            fused = [m for m in of_pixel.moments if getattr(m, "voxels", ())]
            here = fused[nearest(fused)]
            what = {"voxel": min(here.voxels, key=lambda x: abs(x.z_m - here.depth_m)).ijk}
        elif follows == "Gaussian":
            steps = [m for m in of_pixel.steps if len(m.ids)]
            here = steps[nearest(steps)]
            what = {"id": int(here.ids[here.weight.argmax()])}
        story = self.look_at(**what)
        self.go_to(nearest(story.moments))
        return {}

    def _told(self, **what: Any) -> tuple[Any, str]:
        """The story of what ``look_at`` was asked, and its name."""
        given = {k: x for k, x in what.items() if x is not None}
        if len(given) != 1:
            raise ValueError(f"give one of pixel, gaussian, id and voxel, got {sorted(given) or 'none'}")
        ((kind, which),) = given.items()
        if kind in ("pixel", "voxel"):
            story, name = getattr(self.trace, kind)(*which), f"{kind} {which}"
        else:
            story = self.trace.gaussian(given.get("gaussian"), id=given.get("id"))
            name = f"Gaussian {story.id}"
        if not story.moments:
            raise ValueError(f"nothing is recorded of {name}: map a frame while the trace is open")
        return story, name

    def _picked(self, row: int | None) -> None:
        if row is not None:
            try:
                self.look_at(gaussian=row)
            except (ValueError, IndexError) as error:
                self._show_error(error)

    def _draw(self, moment: int, follows: str) -> Drawn:
        now, n = self.story.moments[moment], len(self.story.moments)
        place, code = now.source_line()
        head = Markup("<b>{}</b>, {} of {}: {}").format(self.name_of_story, moment + 1, n, now.title)
        table = Markup(html_table(now.lines(), style="font-size:12px", cell_style="text-align:left;padding:1px 6px"))
        line = Markup('<div style="font-size:12px;overflow-wrap:anywhere">{}: <code>{}</code></div>')
        return moment_picture(now), str(head + table + line.format(place, code))


def moment_picture(moment: Any, width: int = WIDTH_PX) -> Picture:
    """The image of a moment, enlarged to ``width`` pixels, with its marks; grey if the image is no longer held."""
    from matplotlib.patches import Polygon, Rectangle

    camera, marks = moment.camera, moment.marks
    columns, rows = (1, 1) if camera is None else (camera.width, camera.height)
    image = torch.full((rows, columns, 3), 0.8) if moment.image is None else moment.image
    figure, axes = image_figure(image, (width, round(rows * width / columns)))
    boxes = [*((box, "#409cff") for box in marks.tiles), *([(marks.cell, "#ff5050")] if marks.cell else [])]
    boxes += [] if marks.pixel is None else [((*marks.pixel, 1, 1), CROSS)]
    for (x, y, w, h), ink in boxes:
        axes.add_patch(Rectangle((x, y), w, h, fill=False, edgecolor=ink, linewidth=1.5))
    if marks.ellipse is not None:
        ring = ellipse_outlines(torch.tensor([marks.ellipse[:2]]), torch.tensor([marks.ellipse[2:]]))[0]
        axes.add_patch(Polygon(ring, fill=False, edgecolor=CROSS, linewidth=1.5))
    return figure_picture(figure)
