"""One Gaussian, enlarged: the exact projection of its points beside the ellipse that is drawn."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import CARD, CARD_INK, AnyImage, Picture, to_uint8
from ...geometry import project, quaternion
from ...geometry.spherical_harmonics import rgb_to_sh_dc, sh_basis
from ...render import TileLists, render, tile_intersections
from ...types import Camera, GaussianParams
from ..display import Stroke
from .panel import Drawn, Panel, Point, Slider, draw_handles, nearest_handle
from .pixel_stack import Splats, outlines, project_splats

ORANGE, WHITE = (255, 150, 40), (255, 255, 255)


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
    """Orientation: ``turn_deg`` about the viewing axis z after ``lean_deg`` about the vertical axis y."""
    turn, lean = math.radians(turn_deg) / 2, math.radians(lean_deg) / 2
    about_z = torch.tensor([math.cos(turn), 0.0, 0.0, math.sin(turn)])
    about_y = torch.tensor([math.cos(lean), 0.0, math.sin(lean), 0.0])
    return quaternion.multiply(about_z, about_y)


def projection_picture(
    params: GaussianParams, camera: Camera, *, zoom: int = 6, n_points: int = 400
) -> tuple[Picture, Splats]:
    """One Gaussian, rendered by a camera at the origin; its ellipses; and points drawn from it, projected exactly.

    The blue blob is what the renderer draws, white are the ellipses of one and two standard deviations, orange are the
    exact projections of points of the 3D Gaussian. Where points and ellipse disagree, the linearisation of EWA fails.

    Args:
        params: One row.
        camera: Its picture is small, so that pixels can be seen.
        zoom: Screen pixels per pixel.
        n_points: Number of points; they are the same each time.

    Returns:
        The picture and the splat's numbers.
    """
    import cv2

    splats = project_splats(params, camera, torch.eye(4))
    view = to_uint8(0.12 + 0.88 * render(params, camera, torch.eye(4)).rgb)
    image = np.asarray(cv2.resize(view, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST), np.uint8)
    for u, v in _cloud_uv(params, camera, n_points):
        cv2.circle(image, (round(u * zoom), round(v * zoom)), 1, ORANGE, -1, cv2.LINE_AA)
    if bool(splats.projection.visible[0]):
        ring = outlines(splats, torch.tensor([0]))[0]
        centre = splats.projection.uv[0].double().numpy()
        for k in (1, 2):
            points = ((centre + k * (ring - centre)) * zoom * 16).round().clip(-1e6, 1e6).astype(np.int32)
            cv2.polylines(image, [points], True, WHITE, 1, cv2.LINE_AA, shift=4)
    return image, splats


def projection_caption(splats: Splats) -> str:
    """Covariance, angle and tiles of the only Gaussian, as HTML."""
    p = splats.projection
    if not bool(p.visible[0]):
        return "<b>not drawn</b>: nearer than the near plane, or too faint"
    A, B, C = p.conic[0].double().tolist()
    det = A * C - B * B
    uu, uv, vv = C / det, -B / det, A / det
    n = len(tile_intersections(p, splats.camera).gaussian)
    return (
        f"cov<sub>2D</sub> = [{uu:.1f} {uv:.1f}; {uv:.1f} {vv:.1f}] px²<br>"
        f"centre ({p.uv[0, 0]:.1f}, {p.uv[0, 1]:.1f}) px, area of 1σ {math.pi / math.sqrt(det):.0f} px²<br>"
        f"in the lists of {n} tiles"
    )


def sh_ball(sh: Float[Tensor, "K 3"], size: int = 160) -> Picture:
    """The colour of one Gaussian from all sides, painted on a ball: each point has the colour seen from that side.

    The ball is seen by a camera that looks along +z, x to the right, y down. A viewer in the direction of the normal n
    looks along d = -n, which is the direction that the harmonics are evaluated at.
    """
    n, inside = _ball_normals(size)
    degree = round(sh.shape[0] ** 0.5) - 1
    colour = (sh_basis(-n, degree) @ sh + 0.5).clamp(0, 1)
    image = (torch.tensor(CARD) / 255).repeat(size * size, 1)
    image[inside] = colour
    return to_uint8(image.view(size, size, 3))


def basis_atlas(size: int = 104) -> Picture:
    """The 16 basis functions on balls, one row per degree: red where positive, blue where negative."""
    import cv2

    n, inside = _ball_normals(size)
    Y = sh_basis(-n, 3)
    atlas = np.full((4 * size, 7 * size, 3), CARD, np.uint8)
    for k in range(16):
        degree = math.isqrt(k)
        column = 3 - degree + k - degree * degree
        value = (Y[:, k] / 0.9).clamp(-1, 1)[:, None]
        red, blue = torch.tensor([0.82, 0.1, 0.1]), torch.tensor([0.1, 0.3, 0.85])
        colour = 1 - value.abs() * (1 - torch.where(value > 0, red, blue))
        tile = (torch.tensor(CARD) / 255).repeat(size * size, 1)
        tile[inside] = colour
        y, x = degree * size, column * size
        atlas[y : y + size, x : x + size] = to_uint8(tile.view(size, size, 3))
        cv2.circle(atlas, (x + size // 2, y + size // 2), round(0.44 * size), (150, 156, 166), 1, cv2.LINE_AA)
        cv2.putText(atlas, f"Y{k}", (x + 3, y + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, CARD_INK, 1, cv2.LINE_AA)
    return atlas


def _cloud_uv(params: GaussianParams, camera: Camera, n: int) -> list[list[float]]:
    """Exact projections of points drawn from the first Gaussian; those behind the camera are left out."""
    unit = torch.randn(n, 3, generator=torch.Generator().manual_seed(0))
    R = quaternion.to_matrix(params.quat[0])
    xyz = params.xyz_W[0] + (unit * params.log_scale[0].exp()) @ R.T
    xyz = xyz[xyz[:, 2] > 0.05]
    uv = project(camera, xyz)
    inside = (uv > 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    return uv[inside].tolist()


def _ball_normals(size: int) -> tuple[Tensor, Tensor]:
    """Outward normals of the visible half of a ball, and which pixels of the square show it."""
    i = (torch.arange(size) + 0.5 - size / 2) / (0.44 * size)
    y, x = torch.meshgrid(i, i, indexing="ij")
    inside = (x * x + y * y < 1).flatten()
    x, y = x.flatten()[inside], y.flatten()[inside]
    return torch.stack([x, y, -(1 - x * x - y * y).sqrt()], -1), inside


def tile_picture(image: AnyImage, tiles: TileLists, *, scale: int = 2, strength: float = 0.62) -> Picture:
    """Length of every tile's list as colour (viridis: yellow is the longest) over the picture, with a colour bar.

    Args:
        image: What was rendered. [H, W, 3]
        tiles: From ``tile_intersections``.
        scale: Screen pixels per pixel.
        strength: Opacity of the colours.
    """
    import cv2

    count = tiles.offset.diff().view(tiles.tiles_y, tiles.tiles_x).cpu().numpy()
    most = max(int(count.max(initial=0)), 1)
    level = (count * 255 // most).astype(np.uint8)
    heat = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    picture = to_uint8(image)
    H, W = picture.shape[:2]
    heat = cv2.resize(heat, None, fx=tiles.tile_px, fy=tiles.tile_px, interpolation=cv2.INTER_NEAREST)[:H, :W]
    mixed = cv2.addWeighted(np.ascontiguousarray(heat), strength, picture, 1 - strength, 0)
    mixed = np.asarray(cv2.resize(mixed, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST), np.uint8)
    step = tiles.tile_px * scale
    mixed[::step] = mixed[::step] // 2
    mixed[:, ::step] = mixed[:, ::step] // 2
    bar = np.full((26, mixed.shape[1], 3), CARD, np.uint8)
    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_VIRIDIS)[..., ::-1]
    bar[7:19, 20:160] = np.asarray(cv2.resize(np.ascontiguousarray(ramp), (140, 12)), np.uint8)
    ink, font = CARD_INK, cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(bar, "0", (6, 18), font, 0.42, ink, 1, cv2.LINE_AA)
    words = f"{most} Gaussians in one tile of {tiles.tile_px} x {tiles.tile_px} px"
    cv2.putText(bar, words, (168, 18), font, 0.42, ink, 1, cv2.LINE_AA)
    return np.concatenate([mixed, bar])


_BALL_PX = 280


def one_gaussian_panel(camera: Camera, *, zoom: int = 6) -> Panel:
    """Move, turn and stretch one Gaussian in front of a camera of few pixels (``projection_picture``).

    Drag its middle, or the end of an axis; with the shift key, up and down move it farther away and nearer. Or use the
    sliders.
    """

    def draw(**values: Any) -> Drawn:
        xyz = torch.tensor([float(values[k]) for k in ("x_m", "y_m", "z_m")])
        scale = torch.tensor([float(values["long_m"]), float(values["thick_m"]), 0.02])
        orientation = orientation_from_angles(values["turn_deg"], values["lean_deg"])
        picture, splats = projection_picture(gaussian_row(xyz, scale, orientation), camera, zoom=zoom)
        return draw_handles(picture, gaussian_handles(values, camera, zoom)), projection_caption(splats)

    def touch(stroke: Stroke, values: dict[str, Any]) -> dict[str, float]:
        return touch_gaussian(stroke, values, camera, zoom)

    controls = {
        "x_m": Slider(value=0.0, low=-1.5, high=1.5, step=0.01, label="x, m"),
        "y_m": Slider(value=0.0, low=-1.5, high=1.5, step=0.01, label="y, m"),
        "z_m": Slider(value=1.5, low=0.3, high=6.0, step=0.1, label="z, m", readout=".1f"),
        "long_m": Slider(value=0.3, low=0.01, high=0.6, step=0.01, label="long axis, m"),
        "thick_m": Slider(value=0.1, low=0.002, high=0.3, step=0.002, label="short axis, m", readout=".3f"),
        "turn_deg": Slider(value=30, low=-180, high=180, step=1, label="turn, °", tip="about the viewing axis"),
        "lean_deg": Slider(value=0, low=-90, high=90, step=1, label="lean, °", tip="about the vertical axis"),
    }
    return Panel(draw, controls, name="one-gaussian", text="One Gaussian and its image", touch=touch)


def gaussian_handles(values: Mapping[str, Any], camera: Camera, zoom: int) -> dict[str, Point]:
    """Middle and ends of the two axes in the enlarged picture, pixels: the axes as EWA projects them."""
    x, y, z = (float(values[k]) for k in ("x_m", "y_m", "z_m"))
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    turn, lean = math.radians(values["turn_deg"]), math.radians(values["lean_deg"])
    long, thick = values["long_m"], values["thick_m"]
    nearer = math.sin(lean) / z  # the end of a leaning axis is nearer to the camera
    ahead = (math.cos(lean) * math.cos(turn) + nearer * x, math.cos(lean) * math.sin(turn) + nearer * y)
    ends = {"long": (long * ahead[0], long * ahead[1]), "thick": (-thick * math.sin(turn), thick * math.cos(turn))}
    handles = {name: (u + camera.fx / z * dx, v + camera.fy / z * dy) for name, (dx, dy) in ends.items()}
    return {name: (zoom * a, zoom * b) for name, (a, b) in {**handles, "middle": (u, v)}.items()}


def touch_gaussian(stroke: Stroke, values: Mapping[str, Any], camera: Camera, zoom: int) -> dict[str, float]:
    """What a drag changes: the place, or the length of an axis and for the long one its direction too."""
    (du, dv), z = stroke.moved, values["z_m"]
    if stroke.shift:
        return {"z_m": z * math.exp(-dv / 150)}
    handles = gaussian_handles(values, camera, zoom)
    held = nearest_handle(handles, stroke.start)
    if held is None:
        return {}
    if held == "middle":
        return {"x_m": values["x_m"] + du * z / camera.fx / zoom, "y_m": values["y_m"] + dv * z / camera.fy / zoom}
    (u, v), (mid_u, mid_v) = handles[held], handles["middle"]
    dx, dy = (u + du - mid_u) * z / camera.fx / zoom, (v + dv - mid_v) * z / camera.fy / zoom
    turn, lean = math.radians(values["turn_deg"]), math.radians(values["lean_deg"])
    if held == "thick":
        return {"thick_m": abs(dy * math.cos(turn) - dx * math.sin(turn))}
    return _long_axis((dx, dy), lean, (math.sin(lean) * values["x_m"] / z, math.sin(lean) * values["y_m"] / z))


def _long_axis(end: Point, lean: float, nearer: Point) -> dict[str, float]:
    """Length l and turn t of the axis that ends there: end = l (cos(lean) (cos t, sin t) + nearer)."""
    a = nearer[0] ** 2 + nearer[1] ** 2 - math.cos(lean) ** 2
    b, c = -2 * (end[0] * nearer[0] + end[1] * nearer[1]), end[0] ** 2 + end[1] ** 2
    inside = b * b - 4 * a * c
    if a >= -1e-6 or inside < 0:  # the axis points along the viewing ray: its end does not say how long it is
        return {}
    long = (-b - math.sqrt(inside)) / (2 * a)
    turn = math.atan2(end[1] - long * nearer[1], end[0] - long * nearer[0])
    return {"long_m": long, "turn_deg": math.degrees(turn)}


def sh_ball_panel() -> Panel:
    """One coefficient of one basis function of the colour, painted on a ball (``sh_ball``)."""

    def draw(k: int, red: float | int, green: float | int, blue: float | int) -> Drawn:
        sh = torch.zeros(16, 3)
        sh[k] = torch.tensor([red, green, blue], dtype=torch.float32)
        return _with_axes(sh_ball(sh, _BALL_PX)), f"all coefficients are 0 but sh<sub>{k}</sub>"

    controls = {
        "k": Slider(value=3, low=0, high=15, step=1, label="function k"),
        **{
            name: Slider(value=start, low=-1.5, high=1.5, step=0.05, label=f"sh_k, {name}")
            for name, start in (("red", 0.6), ("green", 0.0), ("blue", -0.6))
        },
    }
    return Panel(draw, controls, name="sh-ball", kind="png", text="A Gaussian's colour from all sides")


def _with_axes(ball: Picture) -> Picture:
    """Small x and y arrows in the corner; z points into the picture."""
    import cv2

    picture, ink = ball.copy(), CARD_INK
    o = (10, 10)
    for end, name, at in (((38, 10), "x", (42, 15)), ((10, 38), "y", (6, 54))):
        cv2.arrowedLine(picture, o, end, ink, 1, cv2.LINE_AA, tipLength=0.25)
        cv2.putText(picture, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, ink, 1, cv2.LINE_AA)
    return np.ascontiguousarray(picture)
