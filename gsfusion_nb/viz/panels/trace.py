"""A panel of a trace: a slider over everything that happened to a Gaussian or a voxel, forwards and
back."""

from typing import Any

import torch
from markupsafe import Markup

from ...drawing.curves import figure_picture, image_figure
from ...drawing.page import html_table
from ...drawing.pictures import Picture
from ...errors import ArgumentError
from ..display import Stroke
from .ellipses import CROSS, ellipse_outlines
from .panel import Choice, Drawn, Panel, Slider

FOLLOWS = ("Gaussian", "voxel")
"""What a click can follow."""
WIDTH_PX = 440
"""Width of the picture on screen, pixels."""
INKS = {"tile": "#409cff", "cell": "#ff5050", "pixel": CROSS}
"""Colours of a moment's boxes."""


class TracePanel(Panel):
    """Everything that happened to one Gaussian or voxel: a slider over the moments, a picture,
    numbers, code.

    The picture is that of the operation: blue frames are tiles, the red one is the quadtree cell,
    the yellow mark is the pixel, and the ellipse is the Gaussian at one standard deviation. A click
    on the picture (or the arrow keys) follows what *click follows* says: the Gaussian with the
    largest weight there, or the voxel of the surface there. From Python: ``look_at(gaussian=7)``,
    ``look_at(id=7)``, ``look_at(voxel=(x, y, z))``, and ``go_to(k)``. ``story`` is what is shown.

    Args:
        trace: The ``gsfusion_nb.course.trace.Trace`` of a mapper. Its answers are stories with
            ``moments``, in order; each has ``title``, ``lines()``, ``source_line()``, ``image``,
            ``boxes`` and ``ellipse``.
        what: As for ``look_at``.

    Raises:
        ValueError: as for ``look_at``.
    """

    def __init__(self, trace: Any, **what: Any):
        self.trace = trace
        self.story, self.name_of_story = self._find_story(**what)
        start = "voxel" if "voxel" in what else "Gaussian"
        controls = {
            "moment": Slider(
                value=0,
                low=0,
                high=len(self.story.moments) - 1,
                step=1,
                label="moment",
            ),
            "follows": Choice(value=start, options=FOLLOWS, label="click follows"),
        }
        buttons = {
            "Previous": lambda: self.go_to(self.moment - 1),
            "Next": lambda: self.go_to(self.moment + 1),
        }
        text = "The picture of an operation; click a pixel to follow it"
        super().__init__(
            self._draw,
            controls,
            buttons=buttons,
            name="trace",
            kind="png",
            text=text,
            touch=lambda stroke, _: self._on_point(stroke),
        )

    @property
    def moment(self) -> int:
        """Number of the moment that is shown, from 0."""
        return self.values["moment"]

    def look_at(self, **what: Any) -> Any:
        """Follow the Gaussian in a row of the map, ``gaussian=``, the one with a number, ``id=``,
        or a ``voxel=``.

        Raises:
            ValueError: not exactly one of them is given, or nothing is known of it.
        """
        with self.lock:
            self.story, self.name_of_story = self._find_story(**what)
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
        viewer.observe(lambda change: self._on_pick(change["new"]), "picked")
        return self

    def _on_point(self, stroke: Stroke) -> dict[str, Any]:
        """Follow what a click there follows, from the moment of the present operation on."""
        event = self.story.moments[self.moment]
        if event.camera is None:
            return {}
        camera = event.camera
        u, v = (int(x * camera.width / WIDTH_PX) for x in stroke.now)
        at = min(u, camera.width - 1), min(v, camera.height - 1), event.serial
        if self.values["follows"] == "voxel":
            story = self.look_at(voxel=self.trace.voxel_at(*at))
        else:
            story = self.look_at(id=self.trace.gaussian_at(*at))
        self.go_to(
            min(
                range(len(story.moments)),
                key=lambda k: abs(story.moments[k].serial - event.serial),
            )
        )
        return {}

    def _find_story(self, **what: Any) -> tuple[Any, str]:
        """The story of what ``look_at`` was asked, and its name."""
        if len(what) != 1 or not what.keys() <= {"gaussian", "id", "voxel"}:
            raise ArgumentError(f"give one of gaussian, id and voxel, got {sorted(what) or 'none'}")
        if "voxel" in what:
            story = self.trace.voxel(*what["voxel"])
            name = f"voxel {what['voxel']}"
        else:
            story = self.trace.gaussian(what.get("gaussian"), id=what.get("id"))
            name = f"Gaussian {story.id}"
        if not story.moments:
            raise ArgumentError(
                f"nothing is recorded of {name}: map a frame while the trace is open"
            )
        return story, name

    def _on_pick(self, row: int | None) -> None:
        if row is not None:
            try:
                self.look_at(gaussian=row)
            except (ValueError, IndexError) as error:
                self._show_error(error)

    def _draw(self, moment: int, follows: str) -> Drawn:
        event = self.story.moments[moment]
        n = len(self.story.moments)
        place, code = event.source_line()
        head = Markup("<b>{}</b>, {} of {}: {}").format(
            self.name_of_story, moment + 1, n, event.title
        )
        table = Markup(
            html_table(
                event.lines(), style="font-size:12px", cell_style="text-align:left;padding:1px 6px"
            )
        )
        line = Markup(
            '<div style="font-size:12px;overflow-wrap:anywhere">{}: <code>{}</code></div>'
        )
        return moment_picture(event), str(head + table + line.format(place, code))


def moment_picture(moment: Any, width: int = WIDTH_PX) -> Picture:
    """The image of a moment, enlarged to ``width`` pixels, with its marks; grey if the image is no
    longer held."""
    from matplotlib.patches import Polygon, Rectangle

    camera = moment.camera
    columns, rows = (1, 1) if camera is None else (camera.width, camera.height)
    image = torch.full((rows, columns, 3), 0.8) if moment.image is None else moment.image
    figure, axes = image_figure(image, (width, round(rows * width / columns)))
    for kind, places in moment.boxes.items():
        for x, y, w, h in places:
            axes.add_patch(
                Rectangle(
                    (x, y),
                    w,
                    h,
                    fill=False,
                    edgecolor=INKS[kind],
                    linewidth=1.5,
                )
            )
    if moment.ellipse is not None:
        uv, conic = moment.ellipse
        axes.add_patch(
            Polygon(
                ellipse_outlines(uv[None], conic[None])[0],
                fill=False,
                edgecolor=CROSS,
                linewidth=1.5,
            )
        )
    return figure_picture(figure)
