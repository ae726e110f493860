"""The splat viewer: a Gaussian map in a notebook cell, turned with the mouse, coloured by a chosen
quantity.

The browser draws (``viewer/static/``): with WebGL2 where there is a graphics card, else with a
rasteriser in a worker. Rows are sent as binary messages and are not part of the widget's state, so
a saved notebook does not hold the map.
"""

import threading
import time
from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import anywidget
import numpy as np
import torch
import traitlets as t
from jaxtyping import Float
from torch import Tensor

from ..checks import check_name, check_pose
from ..drawing.pictures import Picture, to_uint8
from ..errors import KindError
from ..geometry.upright import world_up
from ..render.constants import NEAR_PLANE_M
from ..render.near_plane import near_plane_m
from ..types import Camera, GaussianParams, RenderOutput
from ..viewer import front_end, splat_rows, splat_state
from ..viewer.splat_rows import Column, GaussianRecord, RowLayout
from ..viewer.viewpoint import Vector, places_of, viewing_camera
from .display import Bundle, LiveOutput, static_views, synced, with_picture
from .map_pictures import Paint, depth_picture, map_picture

MIN_INTERVAL_S = 0.2
"""Shortest time between two updates of a growing map."""


class SplatViewer(LiveOutput, anywidget.AnyWidget):
    """Look at a Gaussian map from every side; the last line of a cell shows it.

    Drag to orbit, shift-drag to pan, ctrl-drag to look around, wheel (after a click) to zoom, R to
    reset, click to pick: the row's numbers appear in the viewer, ``viewer.picked`` is its number,
    ``viewer.picked_row()`` its values, ``viewer.observe(f, "picked")`` calls ``f`` at each pick.
    The viewer is as wide as the cell, at most twice its canvas. ``look_from("above")`` and the
    buttons go to other places. With ``static_views()`` only a picture by the library's renderer is
    shown. A map of GPS-SLAM is shown with its surface as discs, in rows behind those of the map;
    colour by "surface" tells them apart.

    Args:
        source: A mapper (which also knows its cameras), a model, or bare parameters.
        camera: Intrinsics of the view; the mapper's own by default.
        T_WC: Camera-to-world pose to start from; the mapper's first keyframe by default, else above
            the map.
        width, height: Of the canvas, pixels.
        extras: Numbers to colour by: name -> one per Gaussian. [N] each
        up_W: The world's up direction; by default the mean of the known cameras' -y axes.
        lock: Held while reading the map, if another thread changes it (``LiveMapper.lock``).
        colour_by: "rgb", "depth" (from the camera), "opacity", "birth_frame", "tag" (seed level),
            "state", "contribution" or another extra, where given.

    Raises:
        TypeError: ``source`` is not a map. ValueError: an extra does not fit the map, or the pose
            is not rigid.
    """

    _esm = front_end.splat_module()
    _css = front_end.splat_style()

    width = synced(t.Int())
    height = synced(t.Int())
    intrinsics = synced(t.List(t.Float()))
    pose = synced(t.List(t.Float()))
    pivot_m = synced(t.Float())
    places = synced(t.Dict())
    cut_m = synced(t.Float(0.0, min=0.0))
    """Everything nearer than this is hidden, metres: opens a closed room."""
    reach_m = synced(t.Float(1.0))
    up_W = synced(t.List(t.Float()))
    rules = synced(t.Dict())
    palettes = synced(t.Dict())
    columns = synced(t.List(t.Dict()))
    birth_range = synced(t.List(t.Float()))
    notice = synced(t.Unicode())
    colour_by = synced(t.Unicode("rgb"))
    size = synced(t.Float(1.0, min=0.01))
    opacity = synced(t.Float(1.0, min=0.0))
    points = synced(t.Bool(False))
    background = synced(t.Unicode("#000000"))
    born_until = synced(t.Float(None, allow_none=True))
    picked = synced(t.Int(None, allow_none=True))
    record = synced(t.List(t.List(t.Unicode())))
    renderer = synced(t.Enum(("auto", "software", "webgl"), "auto"))
    renderer_used = synced(t.Unicode(""))
    gpu = synced(t.Unicode(""))
    stats = synced(t.Dict())

    def __init__(
        self,
        source: Any,
        *,
        camera: Camera | None = None,
        T_WC: Float[Tensor, "4 4"] | None = None,
        width: int | None = None,
        height: int | None = None,
        extras: Mapping[str, Any] | None = None,
        up_W: Vector | None = None,
        lock: Any = None,
        colour_by: str = "rgb",
    ):
        self._source = source
        self._extras = dict(extras or {})
        self._lock = lock or nullcontext()
        keyframes = list(getattr(source, "keyframes", ()))
        poses = [k.T_WC for k in keyframes] or ([] if T_WC is None else [T_WC])
        up_axis = torch.as_tensor(world_up(poses) if up_W is None else up_W).float()
        self.camera = viewing_camera(
            camera or (keyframes[0].camera if keyframes else None), width, height
        )
        config = getattr(source, "config", None)
        self._near_m = NEAR_PLANE_M if config is None else near_plane_m(config)
        self._sending = threading.RLock()
        self._page_records: np.ndarray | None = None
        self._listening = False
        self._is_displayed = False
        self._timer: threading.Timer | None = None
        self._last_sent_s = -1e9
        with self._lock:
            self._read()
            start = keyframes[0].T_WC if T_WC is None and keyframes else T_WC
            places = places_of(
                self._params[splat_rows.finite_rows(self._params)],
                self.camera,
                start,
                up_axis,
                self._near_m,
            )
        super().__init__(
            colour_by=colour_by,
            rules=splat_state.rules(self._near_m),
            **splat_state.view_state(self.camera, places, up_axis),
        )
        self._describe()
        self.observe(lambda _change: self._show_record(), "picked")
        self.on_msg(self._on_message)

    @property
    def T_WC(self) -> Float[Tensor, "4 4"]:
        """The camera's present pose; assign a pose to move it."""
        return torch.tensor(self.pose).view(4, 4)

    @T_WC.setter
    def T_WC(self, T_WC: Float[Tensor, "4 4"]) -> None:
        check_pose("T_WC", T_WC)
        self.pose = T_WC.flatten().tolist()

    def look_from(self, place: str) -> "SplatViewer":
        """Move the camera to "photo", where it was at first, "above" the map, without the roof, or
        "inside" it."""
        check_name("place", place, tuple(self.places))
        with self.hold_sync():
            self.pose, self.pivot_m, self.cut_m = self.places[place]
        return self

    def update(
        self,
        source: Any = None,
        *,
        extras: Mapping[str, Any] | None = None,
    ) -> None:
        """Show the map as it is now, or another one. Only changed rows are sent, at most five times
        a second.

        After a call that comes too soon, the state of the map is sent a little later.

        Args:
            source: The map; the one shown so far by default.
            extras: New numbers to colour by; by default the old ones, which must still fit the map.

        Raises:
            TypeError, ValueError: as when the viewer was made.
        """
        self._source = self._source if source is None else source
        self._extras = self._extras if extras is None else dict(extras)
        wait_s = self._last_sent_s + MIN_INTERVAL_S - time.monotonic()
        with self._lock, self._sending:
            self._read()
            if wait_s <= 0:
                self._refresh()
            elif self._timer is None:
                self._timer = threading.Timer(wait_s, self._refresh_late)
                self._timer.daemon = True
                self._timer.start()

    def picked_row(self) -> GaussianRecord | None:
        """All numbers of the picked Gaussian; ``None`` if none is picked, or it was removed."""
        with self._lock:
            if self.picked is None or self.picked >= len(self._params):
                return None
            return splat_rows.gaussian_record(self._params, self._columns, self.picked)

    def _show_record(self) -> None:
        """Names and values of the picked row, which the browser shows in the picture."""
        row = self.picked_row()
        self.record = [] if row is None else [list(line) for line in row.lines()]

    def picture(self) -> Picture:
        """What the viewer shows, drawn by the library's renderer (in point mode: as ellipses)."""
        with self._lock:
            if (view := self._surface_view()) is not None:
                return depth_picture(view) if self.colour_by == "depth" else to_uint8(view.rgb)
            rows = splat_rows.finite_rows(self._params)
            T_WC = self.T_WC
            if self.cut_m > 0:
                to_W = T_WC.to(self._params.xyz_W)
                rows &= (self._params.xyz_W - to_W[:3, 3]) @ to_W[:3, 2] > self.cut_m
            by_name = {c.name: c for c in self._columns}
            if self.born_until is not None and "birth_frame" in by_name:
                rows &= torch.from_numpy(by_name["birth_frame"].values <= self.born_until).to(
                    rows.device
                )
            background = torch.tensor(
                [int(self.background[i : i + 2], 16) / 255 for i in (1, 3, 5)]
            )
            return map_picture(
                self._params[rows],
                self.camera,
                T_WC,
                paint=self._paint(by_name.get(self.colour_by), rows),
                depth=self.colour_by == "depth",
                size=self.size,
                opacity=self.opacity,
                background=background,
                near_m=self._near_m,
            )

    def _paint(self, column: Column | None, rows: Tensor) -> Paint | None:
        if column is not None:
            values = torch.from_numpy(np.nan_to_num(column.values))[rows.cpu()]
            return Paint(
                values=values,
                low=column.limits[0],
                high=column.limits[1],
                palette=column.palette,
            )
        if self.colour_by == "opacity":
            return Paint(
                values=self._params.opacity_logit[rows].sigmoid(),
                low=0.0,
                high=1.0,
            )
        return None

    def _surface_view(self) -> RenderOutput | None:
        """The whole picture of a mapper that draws over its surface, as long as the viewer changes
        nothing in it."""
        has_changes = (
            self.cut_m > 0 or self.born_until is not None or self.size != 1 or self.opacity != 1
        )
        if (
            has_changes
            or self.colour_by not in ("rgb", "depth")
            or not _draws_surface(self._source)
        ):
            return None
        return self._source.render(self.camera, self.T_WC)

    def __repr__(self) -> str:
        return f"SplatViewer({len(self._params):,} Gaussians, {self.width}x{self.height})"

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        self._is_displayed = self._is_displayed or not static_views()
        colour_words = (
            "in their colours" if self.colour_by == "rgb" else f"coloured by {self.colour_by}"
        )
        alt = f"A map of {len(self._params):,} Gaussians, {colour_words}"
        return with_picture(
            super()._repr_mimebundle_(**kwargs), self.picture(), repr(self), alt=alt
        )

    @t.validate("colour_by")
    def _check_colour_by(self, proposal: Any) -> str:
        check_name(
            "colour_by",
            proposal["value"],
            ("rgb", "depth", "opacity", *(c.name for c in self._columns)),
        )
        return proposal["value"]

    def _read(self) -> None:
        """Read parameters and columns from the source."""
        gaussians = getattr(self._source, "gaussians", self._source)
        params = (
            gaussians
            if isinstance(gaussians, GaussianParams)
            else getattr(gaussians, "params", None)
        )
        if not isinstance(params, GaussianParams):
            kind = type(self._source).__name__
            raise KindError(
                f"SplatViewer needs a mapper, a GaussianModel or GaussianParams, got {kind}"
            )
        columns = splat_rows.columns_of(gaussians, len(params), self._extras)
        n = len(params)
        if _draws_surface(self._source):  # the surface as discs, behind the map's own rows
            params = self._source.files.standard_gaussians()
            columns = splat_rows.with_surface(columns, n, len(params))
        self._params = params
        self._columns = columns

    def _describe(self) -> None:
        """Send the front end the columns, and a warning if the map has invalid rows."""
        with self.hold_sync():
            for name, value in splat_state.map_state(self._params, self._columns).items():
                setattr(self, name, value)

    def _refresh(self) -> None:
        with (
            self._lock,
            self._sending,
        ):  # always in this order: a caller of `update` may hold the first already
            self._timer = None
            self._read()
            layout = splat_rows.layout_for(self._params, len(self._columns))
            records = splat_rows.pack_rows(
                self._params, splat_rows.value_table(self._columns, len(self._params)), layout
            )
            self._describe()
            self._last_sent_s = time.monotonic()
            self._send_rows(records, layout)
            self._show_record()

    def _refresh_late(self) -> None:
        """Called in the timer's thread, where errors would not be shown."""
        try:
            self._refresh()
        except ValueError as e:
            self.notice = str(e)

    def _send_rows(self, records: np.ndarray, layout: RowLayout) -> None:
        """Send the rows that the front end does not have; all rows if it has not answered (a cell
        may be running)."""
        if not (self._listening or self._is_displayed):
            return
        packet = splat_rows.packet_between(self._page_records if self._listening else None, records)
        self._page_records = records
        if packet is not None:
            index, rows = packet
            head = {
                "n": len(records),
                "stride": layout.stride,
                "columns": layout.columns,
                "harmonics": layout.harmonics,
                "all": index is None,
            }
            buffers = [a.tobytes() for a in ([rows] if index is None else [index, rows])]
            self.send({"kind": "rows", "head": head}, buffers)

    def _on_message(self, _widget: Any, content: Any, _buffers: Any) -> None:
        """The front end has opened, or has missed a message."""
        if content.get("kind") == "ready":
            with self._lock, self._sending:
                self._listening = True
                self._page_records = None
                self._refresh()


def _draws_surface(source: Any) -> bool:
    """Whether a mapper's pictures are more than its Gaussians."""
    description = getattr(source, "description", None)
    return description is not None and description.needs_volume_to_render
