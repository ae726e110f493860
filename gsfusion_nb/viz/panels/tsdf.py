"""Panels about a TSDF volume: a plane through it as a picture, and a camera that fills it."""

import functools
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import LABEL_PX, Picture, side_by_side, to_uint8
from ...drawing.shading import shaded_view
from ...errors import ArgumentError
from ...tsdf import TsdfVolume, integrate, raycast
from ...types import Camera, Frame
from ...viewer.palettes import palette
from ...viewer.viewpoint import orbit_camera
from ..display import Stroke
from .panel import Choice, Control, Drawn, Panel, Slider, Switch
from .touch import Point, draw_handles, nearest_handle

LEGENDS = {"distance": "; red behind, blue free", "weight": "; dark 1, bright 20", "colour": ""}
QUANTITIES = tuple(LEGENDS)
"""What a slice can show."""
X_M = (-2.6, 2.6)
Y_M = (-2.1, 2.1)
PX_PER_M = 60
"""Usual extent of a slice, metres, and its scale, pixels per metre."""

_BEHIND = (178, 34, 52)
_ZERO = (255, 255, 255)
_FREE = (44, 98, 168)
_UNSEEN = (58, 78)
"""Grey levels of the stripes where no voxel was observed."""
_CAMERA = (255, 140, 0)


def slice_picture(
    volume: TsdfVolume,
    *,
    height_m: float | int = 1.0,
    x_m: tuple[float, float] = X_M,
    y_m: tuple[float, float] = Y_M,
    px_per_m: float | int = PX_PER_M,
    quantity: str = "distance",
    max_weight: float | int = 20,
) -> Picture:
    """The horizontal plane z = ``height_m`` from above, x to the right and y up.

    "distance": D from red (-1, behind a surface) over white (0, on it) to blue (+1, free);
    "weight": the observation count from dark (1) to bright (``max_weight`` and more); "colour": the
    mean colour. Voxels never observed, and where there are none, are striped grey. Each pixel shows
    the voxel that contains it, without interpolation.

    Args:
        volume: The map.
        height_m: Height of the plane, metres.
        x_m, y_m: Extent, metres.
        px_per_m: Scale, pixels per metre.
        quantity: What is shown.
        max_weight: Weight at the brightest colour.

    Raises:
        ValueError: unknown quantity.
    """
    if quantity not in QUANTITIES:
        raise ArgumentError(f"quantity must be one of {', '.join(QUANTITIES)}, got {quantity!r}")
    width, height = (max(1, round((b - a) * px_per_m)) for a, b in (x_m, y_m))
    x = x_m[0] + (torch.arange(width) + 0.5) / px_per_m
    y = y_m[1] - (torch.arange(height) + 0.5) / px_per_m
    xy = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).view(-1, 2)
    points = torch.cat(
        [xy, torch.full_like(xy[:, :1], float(height_m))],
        dim=1,
    )
    sample = volume.sample_nearest(points.to(volume.device))
    D, W = (a.cpu().numpy().reshape(height, width) for a in (sample.D, sample.W))
    if quantity == "distance":
        image = distance_colours(D)
    elif quantity == "weight":
        image = palette("viridis")[(np.clip(W / max_weight, 0, 1) * 255 + 0.5).astype(int)]
    else:
        image = to_uint8(sample.rgb.view(height, width, 3))
    stripes = (np.add.outer(np.arange(height), np.arange(width)) // 4) % 2
    return np.where(
        (W > 0)[..., None],
        image,
        np.where(stripes, *_UNSEEN)[..., None],
    ).astype(np.uint8)


def distance_colours(D: Float[np.ndarray, "H W"] | Float[Tensor, "H W"]) -> Picture:
    """Truncated signed distance as colour: red -1, white 0, blue +1."""
    d = np.clip(np.asarray(D, dtype=np.float32), -1, 1)[..., None]
    negative, zero, free = (np.array(c, np.float32) for c in (_BEHIND, _ZERO, _FREE))
    colour = np.where(
        d < 0,
        zero + (zero - negative) * d,
        zero + (free - zero) * d,
    )
    return (colour + 0.5).astype(np.uint8)


def draw_camera(
    picture: Picture,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    reach_m: float | int = 1.2,
) -> Picture:
    """A copy of a slice of the usual extent with a dot at the camera, and the left and right edge
    of what it sees."""
    T = T_WC.detach().cpu().double().numpy()
    edges = [
        np.array([(u - camera.cx) / camera.fx, 0.0, 1.0]) * reach_m
        for u in (0.0, float(camera.width))
    ]
    points = [slice_pixel(*p[:2]) for p in (T[:3, 3], *(T[:3, :3] @ e + T[:3, 3] for e in edges))]
    place, left_end, right = ((round(16 * u), round(16 * v)) for u, v in points)
    image = picture.copy()
    for ink, thickness in (((30, 30, 30), 4), (_CAMERA, 2)):
        cv2.line(image, place, left_end, ink, thickness, cv2.LINE_AA, 4)
        cv2.line(image, place, right, ink, thickness, cv2.LINE_AA, 4)
        cv2.circle(
            image,
            place,
            (3 + thickness) * 16,
            ink,
            -1,
            cv2.LINE_AA,
            4,
        )
    return image


def slice_pixel(x_m: float | int, y_m: float | int) -> tuple[float, float]:
    """(u, v) of a point of the world in a slice of the usual extent and scale, pixels."""
    return (x_m - X_M[0]) * PX_PER_M, (Y_M[1] - y_m) * PX_PER_M


def slice_place(u: float | int, v: float | int) -> tuple[float, float]:
    """The world's (x, y), metres, at a pixel of such a slice."""
    return X_M[0] + u / PX_PER_M, Y_M[1] - v / PX_PER_M


DepthSensor = Callable[[Float[Tensor, "4 4"]], Frame]
"""Takes a frame at a camera-to-world pose."""
ARM_M = 0.9
"""Distance from the camera in the slice to the handle that turns it, metres."""


def level_pose(
    x_m: float | int,
    y_m: float | int,
    height_m: float | int,
    heading_deg: float | int,
    tilt_deg: float | int = 0.0,
) -> Float[Tensor, "4 4"]:
    """T_WC of an upright camera in a world whose z points up.

    Args:
        x_m, y_m, height_m: Where it stands, metres.
        heading_deg: Where it looks, counter-clockwise from the world's x axis, degrees.
        tilt_deg: Angle above the horizontal, degrees.
    """
    return orbit_camera((x_m, y_m, height_m), heading_deg + 180, -tilt_deg, 0.0)


def shape_picture(volume: TsdfVolume, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Picture:
    """The surface in the volume, lit from the upper left; dark where none has been measured."""
    surface = raycast(volume, camera, T_WC)
    return to_uint8(shaded_view(surface.normal_W @ T_WC[:3, :3], surface.depth_m > 0))


def camera_handles(x_m: float, y_m: float, heading_deg: float) -> dict[str, Point]:
    """In a slice, pixels: the handle that moves the camera, and the one in front of it that turns
    it."""
    h = math.radians(heading_deg)
    tip = (x_m + ARM_M * math.cos(h), y_m + ARM_M * math.sin(h))
    return {"place": slice_pixel(x_m, y_m), "heading": slice_pixel(*tip)}


def touch_camera(
    stroke: Stroke,
    values: dict[str, Any],
    camera: Camera,
) -> dict[str, float]:
    """What a drag over the panel's picture changes: a handle in the slice, or the direction of view
    in the view."""
    du, dv = stroke.moved
    # the lower right corner of the slice; the view is beside it, and as high
    slice_width, slice_height = slice_pixel(X_M[1], Y_M[0])
    if stroke.start[0] >= slice_width:  # the scene in the view follows the pointer
        deg_per_px = math.degrees(camera.height / slice_height / camera.fx)
        heading_deg = wrapped_deg(values["heading_deg"] + du * deg_per_px)
        return {"heading_deg": heading_deg, "tilt_deg": values["tilt_deg"] + dv * deg_per_px}
    handles = camera_handles(values["x_m"], values["y_m"], values["heading_deg"])
    handle = nearest_handle(handles, (stroke.start[0], stroke.start[1] - LABEL_PX))
    if handle is None:
        return {}
    x, y = slice_place(handles[handle][0] + du, handles[handle][1] + dv)
    if handle == "place":
        return {"x_m": x, "y_m": y}
    return {"heading_deg": math.degrees(math.atan2(y - values["y_m"], x - values["x_m"]))}


def wrapped_deg(angle_deg: float) -> float:
    """The same angle in -180..180 degrees."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def tsdf_fill_panel(
    volume: TsdfVolume,
    camera: Camera,
    sensor: DepthSensor,
    *,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Panel:
    """Move a camera, press *measure*, and see the volume fill. Moving alone does not change the
    map.

    Drag the camera in the slice, the handle in front of it to turn it, or the view to look around;
    or use the sliders.

    Args:
        volume: Filled in place; *forget* empties it.
        camera: Of the preview.
        sensor: Takes a frame at a pose; ``integrate`` fuses it.
        start: x, y in metres, and heading in degrees.
    """
    n_fused = [0]

    def fuse_view(T_WC: Tensor) -> None:
        integrate(volume, sensor(T_WC))
        n_fused[0] += 1

    def pose(values: dict[str, Any]) -> Float[Tensor, "4 4"]:
        return level_pose(
            values["x_m"], values["y_m"], 1.3, values["heading_deg"], values["tilt_deg"]
        )

    def measure() -> None:
        fuse_view(pose(panel.values))

    def forget() -> None:
        volume.load_state_dict(TsdfVolume(volume.config, volume.device).state_dict())
        n_fused[0] = 0

    def draw(
        *,
        height_m: float,
        quantity: str,
        at_every_move: bool,
        **where: float,
    ) -> Drawn:
        T_WC = pose(where)
        if at_every_move:
            fuse_view(T_WC)
        flat = draw_camera(
            slice_picture(volume, height_m=height_m, quantity=quantity), camera, T_WC
        )
        slice_image = draw_handles(
            flat, camera_handles(where["x_m"], where["y_m"], where["heading_deg"])
        )
        titles = [
            f"{quantity}, slice at z = {height_m:.2f} m{LEGENDS[quantity]}",
            "the map, seen from the camera",
        ]
        text = (
            f'<b class="gsnb-fill-frames">{n_fused[0]}</b> measurements, '
            f"<b>{volume.n_blocks:,}</b> blocks of 8&sup3; "
            f"voxels, {int((volume.W > 0).sum()):,} voxels observed"
        )
        return side_by_side([slice_image, shape_picture(volume, camera, T_WC)], titles), text

    controls = _fill_controls(*start)
    buttons = {"measure": measure, "forget": forget}
    text = "A slice of a TSDF volume with the camera in it, and what the camera sees of the map"
    touch = functools.partial(touch_camera, camera=camera)
    panel = Panel(
        draw,
        controls,
        buttons=buttons,
        name="fill",
        kind="png",
        text=text,
        touch=touch,
    )
    return panel


def _fill_controls(x_m: float, y_m: float, heading_deg: float) -> dict[str, Control]:
    """The sliders and choices of ``tsdf_fill_panel``, with the camera at the given place."""
    return {
        "x_m": Slider(
            value=float(x_m),
            low=-2.2,
            high=2.2,
            step=0.05,
            label="x, m",
        ),
        "y_m": Slider(
            value=float(y_m),
            low=-1.7,
            high=1.7,
            step=0.05,
            label="y, m",
        ),
        "heading_deg": Slider(
            value=float(heading_deg),
            low=-180,
            high=180,
            step=1.0,
            label="heading, °",
            readout=".0f",
        ),
        "tilt_deg": Slider(
            value=0.0,
            low=-60,
            high=60,
            step=1.0,
            label="tilt, °",
            readout=".0f",
        ),
        "height_m": Slider(
            value=1.0,
            low=0.0,
            high=2.6,
            step=0.02,
            label="slice at z, m",
        ),
        "quantity": Choice(value="distance", options=QUANTITIES, label="show"),
        "at_every_move": Switch(value=False, label="measure at every move"),
    }
