"""Panels about the frames of a recording: a pixel and its point, and mistakes repaired by hand."""

import functools
import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...data.adjust.depth_agreement import depth_agreement
from ...data.adjust.repair import repaired
from ...data.sequence import Sequence
from ...drawing.pictures import Picture, colour_depth, depth_range_m, side_by_side, to_uint8
from ...geometry import backproject, depth_to_normals, pixel_grid, project, se3
from ...recordings.checkup.pictures import depth_error, edge_overlay
from ...types import Camera, Frame
from ..display import Stroke
from .ellipses import draw_cross, resize_to_height
from .panel import Choice, Drawn, Number, Panel, Slider
from .touch import pixel_sliders, touched_pixel

POINT_COLOURS = ("colour", "depth", "normals")
"""What can colour the points."""


def point_view(
    frame: Frame,
    T_WC: Float[Tensor, "4 4"],
    *,
    camera: Camera | None = None,
    colours: Picture | None = None,
    point_px: int = 1,
) -> Picture:
    """The frame's pixels, lifted to points (GSFusion Eq. 10) and projected (Eq. 4) into a camera at
    ``T_WC``.

    A pixel shows the nearest point. It is black if there is none, because the frame never saw that
    place, or because the new camera is closer and the points are far apart.

    Args:
        frame: Where the points come from.
        T_WC: Pose of the camera that looks at them.
        camera: Its intrinsics; the frame's by default.
        colours: Of the frame's pixels, such as ``point_colours``; the photograph by default.
        point_px: Edge of the square that a point covers, pixels.
    """
    target = camera or frame.camera
    inks = torch.from_numpy(to_uint8(frame.colour) if colours is None else colours).view(-1, 3)
    xyz_C = backproject(frame.camera, pixel_grid(frame.camera), frame.depth_m).view(-1, 3)
    T_new_old = se3.inverse(T_WC.double()) @ frame.T_WC.double()
    xyz = se3.apply(T_new_old.float(), xyz_C)
    point_row = ((frame.depth_m.view(-1) > 0) & (xyz[:, 2] > 0.05)).nonzero()[:, 0]
    z = xyz[point_row, 2]
    corner = (project(target, xyz[point_row]) - 0.5 * (point_px - 1)).floor()
    nearest = torch.full((target.height * target.width,), torch.inf)
    picture = torch.zeros(target.height * target.width, 3, dtype=torch.uint8)
    for dx in range(point_px):
        for dy in range(point_px):
            i = corner[:, 0] + dx
            j = corner[:, 1] + dy
            in_picture = ((i >= 0) & (i < target.width) & (j >= 0) & (j < target.height)).nonzero()[
                :, 0
            ]
            at = j[in_picture].long() * target.width + i[in_picture].long()
            nearest.scatter_reduce_(0, at, z[in_picture], "amin")
            first = z[in_picture] <= nearest[at]
            picture[at[first]] = inks[point_row[in_picture[first]]]
    return picture.view(target.height, target.width, 3).numpy()


def normal_colours(normal: Float[Tensor, "H W 3"]) -> Picture:
    """Unit normals as colour: x, y, z from -1..1 to red, green, blue 0..1; black where the normal
    is zero."""
    has_normal = normal.norm(dim=-1, keepdim=True) > 0.5
    return to_uint8((0.5 + 0.5 * normal) * has_normal)


def point_colours(frame: Frame, show: str) -> Picture:
    """The colours that ``point_view`` gives to the frame's pixels; ``show`` is one of
    ``POINT_COLOURS``."""
    if show == "colour":
        return to_uint8(frame.colour)
    if show == "depth":
        return colour_depth(frame.depth_m, *depth_range_m(frame.depth_m))
    return normal_colours(depth_to_normals(frame.camera, frame.depth_m))


def displaced_pose(
    T_WC: Float[Tensor, "4 4"],
    sideways_m: float | int,
    turn_deg: float | int,
    forward_m: float | int = 0.0,
) -> Float[Tensor, "4 4"]:
    """The pose after a step along the camera's own axes, then a turn about its vertical axis,
    float64.

    Args:
        T_WC: Where it starts.
        sideways_m: To the right, metres.
        turn_deg: To the right, degrees.
        forward_m: Along the viewing direction, metres.
    """
    turn = torch.tensor(
        [0.0, 0.0, 0.0, 0.0, math.radians(turn_deg), 0.0],
        dtype=torch.float64,
    )
    step = torch.eye(4, dtype=torch.float64)
    step[0, 3] = float(sideways_m)
    step[2, 3] = float(forward_m)
    return T_WC.double() @ step @ se3.exp(turn)


def point_panel(frame: Frame) -> Panel:
    """A pixel of ``frame`` as numbers, and a camera that moves away from where the frame was taken.

    Click a pixel of the frame at the left: its depth, its point, and where that point is in the
    other view. Drag the view at the right to turn the camera. Or use the sliders.
    """
    near_m, far_m = depth_range_m(frame.depth_m)
    colours = functools.cache(lambda show: point_colours(frame, show))
    legend = {
        "depth": f"<br>depth in the frame: blue {near_m:.1f} m, red {far_m:.1f} m",
        "normals": "<br>x, y, z of the normal in the camera frame as red, green, blue",
    }

    def draw(
        *,
        u: int,
        v: int,
        right_m: float,
        forward_m: float,
        turn_deg: float,
        show: str,
        point_px: int,
    ) -> Drawn:
        T_WC = displaced_pose(frame.T_WC, right_m, turn_deg, forward_m).float()
        picture = point_view(frame, T_WC, colours=colours(show), point_px=point_px)
        empty = 1 - float(((picture[..., 0] | picture[..., 1] | picture[..., 2]) > 0).mean())
        place, about = pixel_story(frame, T_WC, u, v)
        frame_picture = draw_cross(colours(show), (u + 0.5, v + 0.5))
        right = picture if place is None else draw_cross(picture, place)
        pair = side_by_side(
            [frame_picture, right],
            ["the frame: click a pixel", "its points from the new pose: drag"],
        )
        x, y, z = T_WC[:3, 3].tolist()
        words = (
            f"{about}<br>camera at ({x:.2f}, {y:.2f}, {z:.2f}) m; no point on {empty:.0%} of "
            "the pixels"
        )
        return pair, words + legend.get(show, "")

    def touch(stroke: Stroke, values: dict[str, Any]) -> dict[str, Number]:
        if stroke.start[0] < frame.camera.width:
            return touched_pixel(stroke, frame.camera)
        du, _ = stroke.moved
        return {"turn_deg": values["turn_deg"] - math.degrees(du / frame.camera.fx)}

    controls = {
        **pixel_sliders(frame.camera),
        "right_m": Slider(
            value=0.0,
            low=-1.0,
            high=1.0,
            step=0.02,
            label="right, m",
        ),
        "forward_m": Slider(
            value=0.0,
            low=-1.0,
            high=1.0,
            step=0.02,
            label="forward, m",
        ),
        "turn_deg": Slider(
            value=0.0, low=-90, high=90, step=1.0, label="turn right, °", readout=".0f"
        ),
        "show": Choice(value="colour", options=POINT_COLOURS, label="show"),
        "point_px": Slider(
            value=1,
            low=1,
            high=4,
            step=1,
            label="point size, px",
        ),
    }
    return Panel(
        draw, controls, name="points", text="A frame and its points from another pose", touch=touch
    )


def pixel_story(
    frame: Frame, T_new: Float[Tensor, "4 4"], u: int, v: int
) -> tuple[tuple[float, float] | None, str]:
    """A pixel's depth, its point in the frame of the camera (GSFusion Eq. 10) and of the world, and
    where another camera at ``T_new`` sees that point (Eq. 4); ``None`` where it does not. The text
    is HTML."""
    depth_m = float(frame.depth_m[v, u])
    head = f"pixel ({u}, {v}), centre ({u + 0.5:g}, {v + 0.5:g}): "
    if depth_m <= 0:
        return None, head + "<b>no depth</b>, so no point"
    uv = torch.tensor([[u + 0.5, v + 0.5]])
    xyz_C = backproject(frame.camera, uv, torch.tensor([depth_m]))
    xyz_W = se3.apply(frame.T_WC, xyz_C)
    xyz_new = se3.apply(se3.inverse(T_new), xyz_W)
    c, w = (", ".join(f"{x:.3f}" for x in p[0].tolist()) for p in (xyz_C, xyz_W))
    words = (
        f"{head}z = <b>{depth_m:.3f} m</b><br>x<sub>C</sub> = ({c}) m, x<sub>W</sub> = ({w}) m<br>"
    )
    if float(xyz_new[0, 2]) <= 0:
        return None, words + "behind the moved camera"
    place = project(frame.camera, xyz_new)[0].tolist()
    in_picture = 0 <= place[0] < frame.camera.width and 0 <= place[1] < frame.camera.height
    at = (
        f"in the moved camera at ({place[0]:.1f}, {place[1]:.1f}), z = {float(xyz_new[0, 2]):.3f} m"
    )
    return (place[0], place[1]) if in_picture else None, words + (
        at if in_picture else at + ": outside its picture"
    )


_HEIGHT_PX = 270


def repair_panel(sequence: Sequence, first: int, second: int) -> Panel:
    """Sliders for depth scale, time of the poses, focal length and position of the colour image.

    Left: the depth of frame ``first``, moved into frame ``second`` with the poses, minus the depth
    there (dark: equal, light yellow: 10 cm and more). Right: frame ``second`` with the depth
    image's edges in green.

    Args:
        sequence: The recording as it is read.
        first, second: Two frames that see the same things from different places.

    Raises:
        IndexError: no such frame.
    """
    for name, at in (("first", first), ("second", second)):
        if not 0 <= at < len(sequence):
            raise IndexError(f"{name} must be 0..{len(sequence) - 1}, got {at}")
    camera = sequence.camera

    def draw(
        *,
        depth_factor: Number,
        pose_shift: Number,
        focal: Number,
        right_px: Number,
        down_px: Number,
    ) -> Drawn:
        repair = RepairConfig(
            depth_factor=float(depth_factor),
            pose_shift_frames=float(pose_shift),
            fx=float(focal * camera.fx),
            fy=float(focal * camera.fy),
            rgb_shift_x_px=float(right_px),
            rgb_shift_y_px=float(down_px),
        )
        repaired_frames = repaired(sequence, repair)
        a = repaired_frames[first]
        b = repaired_frames[second]
        agreement = depth_agreement(a, b, step=2)
        parts = [
            resize_to_height(np.asarray(p), _HEIGHT_PX)
            for p in (depth_error(a, b), edge_overlay(b))
        ]
        labels = [
            f"frame {first} in frame {second}: error of depth",
            f"frame {second}: edges of depth on colour",
        ]
        words = (
            f"<b>{agreement.agreeing:.0%}</b> of the points agree within 3 %; median difference "
        )
        return side_by_side(parts, labels), f"{words}{100 * agreement.median_m:.1f} cm"

    controls = {
        "depth_factor": Slider(
            value=1.0, low=0.1, high=10.0, step=0.005, label="depth ×", log=True
        ),
        "pose_shift": Slider(
            value=0.0, low=-3, high=3, step=0.1, label="poses later, frames", readout=".1f"
        ),
        "focal": Slider(
            value=1.0,
            low=0.8,
            high=1.2,
            step=0.01,
            label="focal length ×",
        ),
        "right_px": Slider(
            value=0.0, low=-10, high=10, step=0.5, label="colour right, px", readout=".1f"
        ),
        "down_px": Slider(
            value=0.0, low=-10, high=10, step=0.5, label="colour down, px", readout=".1f"
        ),
    }
    return Panel(draw, controls, name="repair", text="A recording, repaired by hand")
