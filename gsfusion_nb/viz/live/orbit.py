"""A viewer of the Gaussian map for a notebook: sliders that move the camera, one picture that follows them."""

import contextlib
import math
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...drawing.pictures import Picture
from ...evaluation import expected_depth_m
from ...gaussians import GaussianModel
from ...geometry.upright import world_up
from ...mapping import Mapper
from ...render import render
from ...types import Camera, GaussianParams
from ..display import Bundle, with_picture
from ..splats.map_picture import SHOWS, draw_gaussians, draw_view
from ..viewpoint import Vector, Viewpoint, extent, viewpoint_of

if TYPE_CHECKING:
    from ..panels.click_image import Stroke
    from ..splats.viewer import SplatViewer

_FOCAL_PER_WIDTH = 0.7
"""Focal length / image width of the viewer's camera if the map has no cameras: a 71 degree wide view."""
TURN_DEG = 200.0
"""A drag across the whole picture turns the camera by this angle."""
_LABELLED = {"first-seen frame": "birth_frame", "quadtree level": "tag"}


def orbit_view(
    source: Mapper | GaussianModel | GaussianParams,
    *,
    camera: Camera | None = None,
    T_WC: Float[Tensor, "4 4"] | None = None,
    up_W: Vector | None = None,
    size: tuple[int, int] = (480, 360),
    lock: Any = None,
) -> "OrbitView":
    """Look at a Gaussian map from every side; the last line of a cell shows the viewer.

    Args:
        source: A mapper (which also knows its cameras), a model, or bare parameters. Every redraw shows its current
            state, also while the map grows.
        camera: Intrinsics of the view; the mapper's own by default.
        T_WC: Camera-to-world pose to start from; the mapper's first keyframe by default.
        up_W: The world's up direction; by default the mean of the mapper's cameras' -y axes, or z.
        size: Width and height of the picture, pixels.
        lock: Held while drawing, if another thread changes the map (``LiveMapper.lock``).
    """
    return OrbitView(source, camera=camera, T_WC=T_WC, up_W=up_W, size=size, lock=lock)


class OrbitView:
    """What ``orbit_view`` returns. ``widget`` is the ipywidgets box, ``picture()`` what it shows now.

    Drag the picture, or use the arrow keys on it, to turn the camera; with the shift key, up and down move it nearer
    and away. The sliders do the same.

    ``set(azimuth_deg=..., elevation_deg=..., distance_m=..., cut_m=..., show=...)`` moves the sliders from Python, to
    whole degrees and steps of 5 cm.
    """

    def __init__(
        self,
        source: Mapper | GaussianModel | GaussianParams,
        *,
        camera: Camera | None = None,
        T_WC: Float[Tensor, "4 4"] | None = None,
        up_W: Vector | None = None,
        size: tuple[int, int] = (480, 360),
        lock: Any = None,
    ):
        self._source = source
        self._lock = lock or contextlib.nullcontext()
        keyframes = list(source.keyframes) if isinstance(source, Mapper) else []
        self.camera = _camera(camera or (keyframes[0].camera if keyframes else None), size)
        self.up_W = torch.as_tensor(world_up([k.T_WC for k in keyframes]) if up_W is None else up_W).float()
        start = keyframes[0].T_WC if T_WC is None and keyframes else T_WC
        over = self._draws_surface()
        centre_W, self._radius_m = extent((over.standard_gaussians() if over else self._params()).xyz_W)
        x, y, z = centre_W.tolist()
        far = 0.9 * self._radius_m / self._half_view()
        self._above = Viewpoint(target_W=(x, y, z), azimuth_deg=-60.0, elevation_deg=74.0, distance_m=far)
        self._home = self._above if start is None else viewpoint_of(start, self._depth_ahead(start), self.up_W)
        self._target_W = self._home.target_W
        self._quiet = False
        self._stroke, self._grabbed = 0, dict[str, float]()
        self._build()
        self._redraw()

    def pose(self) -> Float[Tensor, "4 4"]:
        """T_WC of the camera the sliders describe."""
        s = self.sliders
        view = Viewpoint(
            target_W=self._target_W,
            azimuth_deg=s["azimuth"].value,
            elevation_deg=s["elevation"].value,
            distance_m=s["distance"].value,
        )
        return view.pose(self.up_W)

    def picture(self) -> Picture:
        """What the camera sees of the map as it is now.

        Of a map that draws over its surface, a picture with something cut away shows the surface as discs.
        """
        with self._lock:
            show: Any = self.show.value
            labels = self._labels(_LABELLED[show]) if show in _LABELLED else None
            cut_m, params, over = self.sliders["cut"].value, self._params(), self._draws_surface()
            if over is not None and labels is None:
                if cut_m == 0:
                    return draw_view(over.render(self.camera, self.pose()), show)
                params = over.standard_gaussians()
            return draw_gaussians(params, self.camera, self.pose(), show, labels=labels, cut_m=cut_m)

    def splats(self) -> "SplatViewer":
        """A splat viewer of the same map, from the same place."""
        from ..splats.viewer import SplatViewer

        return SplatViewer(self._source, camera=self.camera, T_WC=self.pose(), up_W=self.up_W, lock=self._lock)

    def set(
        self,
        *,
        azimuth_deg: float | int | None = None,
        elevation_deg: float | int | None = None,
        distance_m: float | int | None = None,
        cut_m: float | int | None = None,
        show: str | None = None,
    ) -> "OrbitView":
        """Move the sliders, several at once with one redraw."""
        values = {"azimuth": azimuth_deg, "elevation": elevation_deg, "distance": distance_m, "cut": cut_m}
        self._quiet = True
        try:
            for name, value in values.items():
                if value is not None:
                    slider = self.sliders[name]
                    slider.max = max(slider.max, value)
                    slider.value = _on_step(value, slider.step)
            if show is not None:
                self.show.value = show
        finally:
            self._quiet = False
        self._redraw()
        return self

    def look_from(self, place: str) -> "OrbitView":
        """Move the camera to the viewpoint of a button: "photo", "above" or "inside"."""
        if place not in self.places:
            raise KeyError(f"no viewpoint {place!r}; known: {', '.join(self.places)}")
        view, cut_m = self.places[place]
        self._target_W = view.target_W
        return self.set(
            azimuth_deg=_wrapped(view.azimuth_deg),
            elevation_deg=view.elevation_deg,
            distance_m=view.distance_m,
            cut_m=cut_m,
        )

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        self._redraw()
        bundle = self.widget._repr_mimebundle_(**kwargs)
        text = f"OrbitView({len(self._params()):,} Gaussians)"
        return with_picture(bundle, self.picture(), text, alt=self.image.alt)

    def _build(self) -> None:
        import ipywidgets as w

        from ..panels.click_image import ClickImage
        from ..panels.panel import beside

        self.sliders = self._make_sliders()
        self.places = self._make_places()
        shows = [s for s in SHOWS if s not in _LABELLED or self._labels(_LABELLED[s]) is not None]
        self.show = w.Dropdown(
            options=shows, description="show", style={"description_width": "92px"}, layout=w.Layout(width="300px")
        )
        self.buttons = {name: w.Button(description=name, layout=w.Layout(width="96px")) for name in self.places}
        for name, button in self.buttons.items():
            button.on_click(lambda _, name=name: self.look_from(name))
        for name, slider in self.sliders.items():
            slider.add_class(f"gsnb-orbit-{name}")
        for control in (*self.sliders.values(), self.show):
            control.observe(self._changed, names="value")
        width, height = self.camera.width, self.camera.height
        self.image = ClickImage(width, height, width=width, touch="stroke")
        self.image.add_class("gsnb-orbit-image")
        self.image.on_stroke(self._dragged)
        self.caption = w.HTML()
        controls = [*self.sliders.values(), self.show]
        self.widget = beside(self.image, controls, list(self.buttons.values()), self.caption)
        self.widget.add_class("gsnb-orbit")

    def _make_sliders(self) -> dict[str, Any]:
        import ipywidgets as w

        home = self._home
        reach = math.ceil(max(2.0 * self._above.distance_m, 1.5 * home.distance_m))
        rows = {  # label, value, low, high, step, tooltip
            "azimuth": ("azimuth °", _wrapped(home.azimuth_deg), -180, 180, 1, "around the vertical"),
            "elevation": ("elevation °", home.elevation_deg, -89, 89, 1, "above the horizontal"),
            "distance": ("distance m", home.distance_m, 0, reach, 0.05, "0: the camera is at the target"),
            "cut": ("cut away m", 0, 0, reach, 0.05, "hide everything nearer than this"),
        }
        return {
            name: w.FloatSlider(
                value=_on_step(value, step), min=low, max=high, step=step, description=label, tooltip=tip,
                readout_format=".0f" if step == 1 else ".2f", style={"description_width": "92px"},
                layout=w.Layout(width="300px"), continuous_update=True,
            )
            for name, (label, value, low, high, step, tip) in rows.items()
        }  # fmt: skip

    def _make_places(self) -> dict[str, tuple[Viewpoint, float]]:
        """Viewpoint of each button, and the depth up to which it hides the map."""
        inside = Viewpoint(target_W=self._above.target_W, azimuth_deg=90.0, elevation_deg=0.0, distance_m=0.0)
        roof_m = max(self._above.distance_m - 0.13 * self._radius_m, 0.0)
        return {"photo": (self._home, 0.0), "above": (self._above, roof_m), "inside": (inside, 0.0)}

    def _changed(self, _change: Any) -> None:
        if not self._quiet:
            self._redraw()

    def _dragged(self, stroke: "Stroke") -> None:
        if stroke.number != self._stroke:
            self._stroke, self._grabbed = stroke.number, {name: s.value for name, s in self.sliders.items()}
        held, (du, dv) = self._grabbed, stroke.moved
        if stroke.shift:
            self.set(distance_m=max(held["distance"], 0.05) * math.exp(dv / (0.3 * self.camera.height)))
            return
        turn = TURN_DEG / self.camera.width
        if held["distance"] < 0.05:  # the camera stands on the point that it would circle: look around
            turn *= -0.4
        elevation = self.sliders["elevation"]
        self.set(
            azimuth_deg=_wrapped(held["azimuth"] - turn * du),
            elevation_deg=min(max(held["elevation"] + turn * dv, elevation.min), elevation.max),
        )

    def _redraw(self) -> None:
        self.image.show(self.picture())
        s = self.sliders
        self.image.alt = (
            f"{len(self._params()):,} Gaussians, {self.show.value}, seen from azimuth {s['azimuth'].value:.0f} and "
            f"elevation {s['elevation'].value:.0f} degrees at {s['distance'].value:.2f} m; drag to turn"
        )
        self.caption.value = f"{len(self._params()):,} Gaussians"

    def _params(self) -> GaussianParams:
        return self._source if isinstance(self._source, GaussianParams) else self._model().params

    def _model(self) -> Any:
        return self._source.gaussians if isinstance(self._source, Mapper) else self._source

    def _draws_surface(self) -> Mapper | None:
        """The mapper, if its pictures are more than its Gaussians."""
        return self._source if isinstance(self._source, Mapper) and self._source.needs_volume_to_render else None

    def _labels(self, column: str) -> Int[Tensor, " N"] | None:
        model = self._model()
        if isinstance(model, GaussianParams) or (column == "tag" and model.TAG_MEANING != "quadtree level"):
            return None
        return getattr(model, column)

    def _half_view(self) -> float:
        """Tangent of half the narrower angle of view."""
        return min(0.5 * self.camera.width / self.camera.fx, 0.5 * self.camera.height / self.camera.fy)

    def _depth_ahead(self, T_WC: Float[Tensor, "4 4"]) -> float:
        """Median depth of the map in a view, metres: the distance of the point to orbit around."""
        over = self._draws_surface()
        view = over.render(self.camera, T_WC) if over else render(self._params(), self.camera, T_WC)
        depth_m = expected_depth_m(view)
        seen = depth_m[depth_m > 0]
        return float(seen.median()) if len(seen) else self._radius_m


def _camera(camera: Camera | None, size: tuple[int, int]) -> Camera:
    """A camera for a picture of ``size``, with square pixels and the horizontal angle of view of the given one."""
    width, height = size
    focal = _FOCAL_PER_WIDTH * width if camera is None else camera.fx * width / camera.width
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)


def _on_step(value: float | int, step: float | int) -> float:
    """The nearest value that the slider can show; the browser would round any other one and send it back."""
    return float(round(value / step) * step)


def _wrapped(angle_deg: float) -> float:
    """The same angle in -180..180."""
    return (angle_deg + 180.0) % 360.0 - 180.0
