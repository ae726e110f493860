"""One Gaussian, enlarged: the exact projection of its points beside the ellipse that is drawn."""

import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import figure_picture, image_figure
from ...drawing.pictures import Picture, to_uint8
from ...geometry import project, quaternion
from ...geometry.spherical_harmonics import rgb_to_sh_dc
from ...render import render, tile_intersections
from ...types import Camera, GaussianParams
from ..display import Stroke
from .ellipses import outlines
from .panel import Drawn, Panel, Slider
from .pixel_blend import Splats, project_splats
from .touch import Point, draw_handles, nearest_handle


def gaussian_row(
    xyz_W: Float[Tensor, "3"],
    scale_m: Float[Tensor, "3"],
    quat: Float[Tensor, "4"],
    *,
    opacity: float = 0.9,
    rgb: tuple[float, float, float] = (0.25, 0.55, 0.9),
) -> GaussianParams:
    """A map of one Gaussian from activated values, with the same colour from every direction."""
    return GaussianParams(
        xyz_W=xyz_W[None].float(),
        log_scale=scale_m[None].float().log(),
        quat=quat[None].float(),
        opacity_logit=torch.tensor([opacity]).logit(),
        sh=rgb_to_sh_dc(torch.tensor([[rgb]])),
    )


def orientation_from_angles(turn_deg: float | int, lean_deg: float | int) -> Float[Tensor, "4"]:
    """Orientation: ``turn_deg`` about the viewing axis z after ``lean_deg`` about the vertical axis
    y."""
    turn = math.radians(turn_deg) / 2
    lean = math.radians(lean_deg) / 2
    about_z = torch.tensor([math.cos(turn), 0.0, 0.0, math.sin(turn)])
    about_y = torch.tensor([math.cos(lean), 0.0, math.sin(lean), 0.0])
    return quaternion.multiply(about_z, about_y)


def projection_picture(
    params: GaussianParams, camera: Camera, *, zoom: int = 6
) -> tuple[Picture, Splats]:
    """One Gaussian, rendered by a camera at the origin; its ellipses; and points drawn from it,
    projected exactly.

    The blue blob is what the renderer draws, white are the ellipses of one and two standard
    deviations, orange are the exact projections of 400 points of the 3D Gaussian, the same each
    time. Where points and ellipse disagree, the linearisation of EWA fails.

    Args:
        params: One row.
        camera: Its picture is small, so that pixels can be seen.
        zoom: Screen pixels per pixel.

    Returns:
        The picture and the splat's numbers.
    """
    splats = project_splats(params, camera, torch.eye(4))
    view = to_uint8(0.12 + 0.88 * render(params, camera, torch.eye(4)).rgb)
    figure, axes = image_figure(view, (zoom * camera.width, zoom * camera.height))
    axes.plot(
        *_cloud_uv(params, camera, 400).T,
        "o",
        color="#ff9628",
        markersize=1.5,
    )
    if bool(splats.projection.visible[0]):
        ring = outlines(splats, torch.tensor([0]))[0]
        centre = splats.projection.uv[0].double().numpy()
        for k in (1, 2):
            axes.plot(
                *(centre + k * (ring - centre)).T,
                color="white",
                linewidth=0.8,
            )
    return figure_picture(figure), splats


def projection_caption(splats: Splats) -> str:
    """Covariance, angle and tiles of the only Gaussian, as HTML."""
    p = splats.projection
    if not bool(p.visible[0]):
        return "<b>not drawn</b>: nearer than the near plane, or too faint"
    A, B, C = p.conic[0].double().tolist()
    det = A * C - B * B
    uu = C / det
    uv = -B / det
    vv = A / det
    n = len(tile_intersections(p, splats.camera).gaussian)
    return (
        f"cov<sub>2D</sub> = [{uu:.1f} {uv:.1f}; {uv:.1f} {vv:.1f}] px²<br>centre "
        f"({p.uv[0, 0]:.1f}, {p.uv[0, 1]:.1f}) px, area of 1σ {math.pi / math.sqrt(det):.0f} "
        f"px²<br>in the lists of {n} tiles"
    )


def _cloud_uv(params: GaussianParams, camera: Camera, n: int) -> np.ndarray:
    """Exact projections of points drawn from the first Gaussian; those behind the camera are left
    out."""
    unit = torch.randn(n, 3, generator=torch.Generator().manual_seed(0))
    R = quaternion.to_matrix(params.quat[0])
    xyz = params.xyz_W[0] + (unit * params.log_scale[0].exp()) @ R.T
    xyz = xyz[xyz[:, 2] > 0.05]
    uv = project(camera, xyz)
    in_picture = (uv > 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    return uv[in_picture].numpy()


def one_gaussian_panel(camera: Camera, *, zoom: int = 6) -> Panel:
    """Move, turn and stretch one Gaussian in front of a camera of few pixels
    (``projection_picture``).

    Drag its middle, or the end of an axis; or use the sliders.
    """

    def draw(**values: Any) -> Drawn:
        xyz = torch.tensor([float(values[k]) for k in ("x_m", "y_m", "z_m")])
        scale = torch.tensor([float(values["long_m"]), float(values["thick_m"]), 0.02])
        orientation = orientation_from_angles(values["turn_deg"], values["lean_deg"])
        picture, splats = projection_picture(
            gaussian_row(xyz, scale, orientation), camera, zoom=zoom
        )
        return draw_handles(picture, gaussian_handles(values, camera, zoom)), projection_caption(
            splats
        )

    controls = {
        "x_m": Slider(
            value=0.0,
            low=-1.5,
            high=1.5,
            step=0.01,
            label="x, m",
        ),
        "y_m": Slider(
            value=0.0,
            low=-1.5,
            high=1.5,
            step=0.01,
            label="y, m",
        ),
        "z_m": Slider(
            value=1.5,
            low=0.3,
            high=6.0,
            step=0.1,
            label="z, m",
            readout=".1f",
        ),
        "long_m": Slider(
            value=0.3,
            low=0.01,
            high=0.6,
            step=0.01,
            label="long axis, m",
        ),
        "thick_m": Slider(
            value=0.1, low=0.002, high=0.3, step=0.002, label="short axis, m", readout=".3f"
        ),
        "turn_deg": Slider(
            value=30, low=-180, high=180, step=1, label="turn, °", tip="about the viewing axis"
        ),
        "lean_deg": Slider(
            value=0, low=-90, high=90, step=1, label="lean, °", tip="about the vertical axis"
        ),
    }
    text = "One Gaussian and its image"
    touch = functools.partial(touch_gaussian, camera=camera, zoom=zoom)
    return Panel(draw, controls, name="one-gaussian", text=text, touch=touch)


def gaussian_handles(
    values: Mapping[str, Any],
    camera: Camera,
    zoom: int,
) -> dict[str, Point]:
    """Middle and ends of the two axes in the enlarged picture, pixels; of a leaning axis without
    the perspective."""
    x, y, z = (float(values[k]) for k in ("x_m", "y_m", "z_m"))
    u = camera.fx * x / z + camera.cx
    v = camera.fy * y / z + camera.cy
    turn = math.radians(values["turn_deg"])
    thick = values["thick_m"]
    long = values["long_m"] * math.cos(math.radians(values["lean_deg"]))
    ends = {"long": (long, 0.0), "thick": (0.0, thick), "middle": (0.0, 0.0)}
    c = math.cos(turn) / z
    s = math.sin(turn) / z
    places = {
        name: (u + camera.fx * (c * a - s * b), v + camera.fy * (s * a + c * b))
        for name, (a, b) in ends.items()
    }
    return {name: (zoom * a, zoom * b) for name, (a, b) in places.items()}


def touch_gaussian(
    stroke: Stroke, values: Mapping[str, Any], camera: Camera, zoom: int
) -> dict[str, float]:
    """What a drag changes: the place, or the length of an axis and for the long one its direction
    too."""
    du, dv = stroke.moved
    z = values["z_m"]
    handles = gaussian_handles(values, camera, zoom)
    handle = nearest_handle(handles, stroke.start)
    if handle is None:
        return {}
    if handle == "middle":
        return {
            "x_m": values["x_m"] + du * z / camera.fx / zoom,
            "y_m": values["y_m"] + dv * z / camera.fy / zoom,
        }
    u, v = handles[handle]
    mid_u, mid_v = handles["middle"]
    dx = (u + du - mid_u) * z / camera.fx / zoom
    dy = (v + dv - mid_v) * z / camera.fy / zoom
    if handle == "thick":
        turn = math.radians(values["turn_deg"])
        return {"thick_m": abs(dy * math.cos(turn) - dx * math.sin(turn))}
    foreshortening = max(math.cos(math.radians(values["lean_deg"])), 0.1)
    return {
        "long_m": math.hypot(dx, dy) / foreshortening,
        "turn_deg": math.degrees(math.atan2(dy, dx)),
    }
