"""What the splat viewer shows, drawn by the library's own renderer: the picture of a stored notebook."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import check_pose
from ...constants import SH_C0
from ...drawing.page import fill
from ...drawing.pictures import Picture, colour_stops, to_uint8
from ...evaluation import expected_depth_m
from ...geometry.spherical_harmonics import rgb_to_sh_dc
from ...render import render
from ...types import Camera, GaussianParams
from ..viewpoint import Viewpoint, extent
from .columns import STATE_NAMES, Column
from .map_picture import draw_gaussians
from .surfel_pictures import STATE_COLOURS

PALETTES = ("turbo", "viridis", "state")
"""Depth, numbers, and the two states in the colours of ``state_picture``."""


def palette_stops(name: str) -> list[str]:
    """256 colours as "#rrggbb"."""
    if name != "state":
        return colour_stops(name, 256)
    unstable, stable = ("#" + bytes(STATE_COLOURS[f"{name}_opaque"]).hex() for name in STATE_NAMES)
    return [unstable] * 128 + [stable] * 128


def painted(
    params: GaussianParams, values: Float[Tensor, " N"], low: float, high: float, palette: str = "viridis"
) -> GaussianParams:
    """The same Gaussians, each with the colour of its number between ``low`` and ``high``."""
    stops = [[int(stop[i : i + 2], 16) / 255 for i in (1, 3, 5)] for stop in palette_stops(palette)]
    level = ((values - low) / max(high - low, 1e-9) * 255).round().clamp(0, 255).long()
    sh = rgb_to_sh_dc(torch.tensor(stops).to(params.sh)[level.to(params.sh.device)])
    return dataclasses.replace(params, sh=sh[:, None])


def splat_picture(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    paint: tuple[Float[Tensor, " N"], float, float, str] | None = None,
    depth: bool = False,
    size: float = 1.0,
    opacity: float = 1.0,
    background: Float[Tensor, "3"] | None = None,
) -> Picture:
    """The map from a camera, with the viewer's settings.

    Args:
        params, camera, T_WC: as for ``render``.
        paint: One number per Gaussian, the numbers of the first and the last colour, and a palette; ``None``: own
            colours.
        depth: Show expected depth instead.
        size: Multiplies every standard deviation.
        opacity: Multiplies every opacity (clamped below 1).
        background: Behind the map, 0..1; black by default.
    """
    if paint is not None:
        params = painted(params, *paint)
    if size != 1 or opacity != 1:
        o = (params.opacity_logit.sigmoid() * opacity).clamp(1e-6, 1 - 1e-6)
        log_size = torch.tensor(size).log().item()
        params = dataclasses.replace(params, log_scale=params.log_scale + log_size, opacity_logit=o.logit())
    if depth:
        return draw_gaussians(params, camera, T_WC, "depth")
    view = render(params, camera, T_WC)
    if background is None:
        return to_uint8(view.rgb)
    return to_uint8(view.rgb + (1 - view.alpha[..., None]) * background.to(view.rgb))


@dataclass(frozen=True, kw_only=True)
class GaussianRecord:
    """One row of a map, activated values. ``str(row)`` and the notebook show it as a small table."""

    row: int
    """Its number in the map."""
    xyz_W: tuple[float, ...]
    """Centre, metres."""
    scale_m: tuple[float, ...]
    """Standard deviations along its own axes, metres."""
    quat: tuple[float, ...]
    """Orientation, wxyz, unit length."""
    opacity: float
    """Peak opacity."""
    rgb: tuple[float, ...]
    """View-independent part of the colour, 0..1 unless it left that range."""
    sh_degree: int
    """Degree of the view-dependent part."""
    extras: dict[str, float]
    """Birth frame, seed level, and the other columns of the viewer."""

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        triples = {"xyz_W [m]": self.xyz_W, "scale_m [m]": self.scale_m, "quat (wxyz)": self.quat, "rgb": self.rgb}
        rows = [("row", f"{self.row:,}")]
        rows += [(name, "  ".join(f"{v:.4g}" for v in values)) for name, values in triples.items()]
        rows += [("opacity", f"{self.opacity:.4g}"), ("sh degree", str(self.sh_degree))]
        return rows + [(name, f"{value:.4g}") for name, value in self.extras.items()]

    def __str__(self) -> str:
        return "\n".join(f"{name:<12} {value}" for name, value in self.lines())

    def _repr_html_(self) -> str:
        return fill("splat_record.html", lines=self.lines())


def gaussian_record(params: GaussianParams, columns: list[Column], row: int) -> GaussianRecord:
    """The record of one row.

    Raises:
        IndexError: no such row.
    """
    if not 0 <= row < len(params):
        raise IndexError(f"row must be between 0 and {len(params) - 1}, got {row}")
    one = params[row : row + 1]
    unit = torch.nn.functional.normalize(one.quat[0].double(), dim=0)

    def numbers(values: torch.Tensor) -> tuple[float, ...]:
        return tuple(float(v) for v in values)

    return GaussianRecord(
        row=row,
        xyz_W=numbers(one.xyz_W[0]),
        scale_m=numbers(one.log_scale[0].exp()),
        quat=numbers(unit),
        opacity=float(one.opacity_logit[0].sigmoid()),
        rgb=numbers(one.sh[0, 0] * SH_C0 + 0.5),
        sh_degree=params.sh_degree,
        extras={c.name: float(c.values[row]) for c in columns},
    )


_FOCAL_PER_WIDTH = 0.7
"""Focal length / image width of a viewer without a camera: a 71 degree wide view."""


def viewing_camera(camera: Camera | None, width: int | None, height: int | None) -> Camera:
    """The given camera for a canvas of the given size, with its horizontal angle of view.

    By default the canvas has the camera's size, at most 640 pixels wide; without a camera it is 480 x 360.
    """
    if camera is None:
        w, h = width or 480, height or 360
        return Camera(width=w, height=h, fx=_FOCAL_PER_WIDTH * w, fy=_FOCAL_PER_WIDTH * w, cx=w / 2, cy=h / 2)
    if width is None:
        width = min(camera.width, 640) if height is None else round(height * camera.width / camera.height)
    scaled = camera.resized(width, round(width * camera.height / camera.width))
    if height is None or height == scaled.height:
        return scaled
    return Camera(
        width=width, height=height, fx=scaled.fx, fy=scaled.fy,
        cx=scaled.cx, cy=scaled.cy + (height - scaled.height) / 2,
    )  # fmt: skip


def starting_pose(
    params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"] | None, up_W: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "4 4"], float]:
    """The first pose, and the distance of the point to turn around (the median depth of the view), metres.

    Without a pose it is a view of the whole map from 35 degrees above.
    """
    centre_W, radius_m = extent(params.xyz_W)
    if T_WC is None:
        x, y, z = centre_W.tolist()
        half_view = min(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
        distance_m = 0.9 * radius_m / half_view
        view = Viewpoint(target_W=(x, y, z), azimuth_deg=-60.0, elevation_deg=35.0, distance_m=distance_m)
        return view.pose(up_W), distance_m
    check_pose("T_WC", T_WC)
    pose = T_WC.detach().cpu().float()
    depth_m = expected_depth_m(render(params, camera, pose))
    seen = depth_m[depth_m > 0]
    return pose, float(seen.median()) if len(seen) else radius_m
