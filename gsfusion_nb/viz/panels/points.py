"""One RGB-D frame as a point cloud, seen by a camera at another pose."""

import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import Picture, colour_depth, depth_range_m, to_uint8
from ...drawing.side_by_side import side_by_side
from ...geometry import backproject, depth_to_normals, pixel_grid, project, se3
from ...types import Camera, Frame
from .panel import Choice, Drawn, Panel, Slider

POINT_COLOURS = ("colour", "depth", "normals")
"""What can colour the points."""


def point_view(
    frame: Frame,
    T_WC: Float[Tensor, "4 4"],
    *,
    camera: Camera | None = None,
    show: str = "colour",
    point_px: int = 1,
) -> Picture:
    """The frame's pixels, lifted to points (GSFusion Eq. 10) and projected (Eq. 4) into a camera at ``T_WC``.

    A pixel shows the nearest point. It is black if there is none, because the frame never saw that place, or because
    the new camera is closer and the points are far apart.

    Args:
        frame: Where the points come from.
        T_WC: Pose of the camera that looks at them.
        camera: Its intrinsics; the frame's by default.
        show: Colour of the points: "colour" (photograph), "depth" (z-depth in the frame), "normals"
            (``normal_colours``).
        point_px: Edge of the square that a point covers, pixels.

    Raises:
        ValueError: unknown ``show``.
    """
    target = camera or frame.camera
    colours = torch.from_numpy(point_colours(frame, show)).view(-1, 3)
    xyz_C = backproject(frame.camera, pixel_grid(frame.camera), frame.depth_m).view(-1, 3)
    T_new_old = se3.inverse(T_WC.double()) @ frame.T_WC.double()
    xyz = se3.apply(T_new_old.float(), xyz_C)
    seen = ((frame.depth_m.view(-1) > 0) & (xyz[:, 2] > 0.05)).nonzero()[:, 0]
    z = xyz[seen, 2]
    corner = (project(target, xyz[seen]) - 0.5 * (point_px - 1)).floor()
    nearest = torch.full((target.height * target.width,), torch.inf)
    picture = torch.zeros(target.height * target.width, 3, dtype=torch.uint8)
    for dx in range(point_px):
        for dy in range(point_px):
            i, j = corner[:, 0] + dx, corner[:, 1] + dy
            inside = ((i >= 0) & (i < target.width) & (j >= 0) & (j < target.height)).nonzero()[:, 0]
            at = j[inside].long() * target.width + i[inside].long()
            nearest.scatter_reduce_(0, at, z[inside], "amin")
            first = z[inside] <= nearest[at]
            picture[at[first]] = colours[seen[inside[first]]]
    return picture.view(target.height, target.width, 3).numpy()


def normal_colours(normal: Float[Tensor, "H W 3"]) -> Picture:
    """Unit normals as colour: x, y, z from -1..1 to red, green, blue 0..1; black where the normal is zero."""
    known = normal.norm(dim=-1, keepdim=True) > 0.5
    return to_uint8((0.5 + 0.5 * normal) * known)


def point_colours(frame: Frame, show: str) -> Picture:
    """The colours that ``point_view`` gives to the frame's pixels."""
    if show not in POINT_COLOURS:
        raise ValueError(f"show must be one of {', '.join(POINT_COLOURS)}, got {show!r}")
    if show == "colour":
        return to_uint8(frame.colour)
    if show == "depth":
        return colour_depth(frame.depth_m, *depth_range_m(frame.depth_m))
    return normal_colours(depth_to_normals(frame.camera, frame.depth_m))


def moved_pose(
    T_WC: Float[Tensor, "4 4"],
    offset_C_m: tuple[float, float, float],
    turn_deg: float | int,
    pitch_deg: float | int = 0.0,
) -> Float[Tensor, "4 4"]:
    """The pose after a step along the camera's own axes, then a turn about its y and a pitch about its x axis.

    Args:
        T_WC: Where it starts.
        offset_C_m: Right, down, forward, metres.
        turn_deg: To the right, degrees.
        pitch_deg: Upwards, degrees.
    """
    step = torch.zeros(6, dtype=torch.float64)
    step[:3] = torch.tensor(offset_C_m, dtype=torch.float64)
    turn, pitch = torch.zeros(6, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
    turn[4], pitch[3] = torch.deg2rad(torch.tensor([float(turn_deg), float(pitch_deg)], dtype=torch.float64))
    return (T_WC.double() @ se3.exp(step) @ se3.exp(turn) @ se3.exp(pitch)).float()


def point_panel(frame: Frame) -> Panel:
    """Sliders that move a camera away from where ``frame`` was taken; the points stay where they are."""

    near_m, far_m = depth_range_m(frame.depth_m)
    legend = {
        "depth": f"<br>depth in the frame: blue {near_m:.1f} m, red {far_m:.1f} m",
        "normals": "<br>x, y, z of the normal in the camera frame as red, green, blue",
    }

    def draw(*, right_m: float, forward_m: float, turn_deg: float, show: str, point_px: int) -> Drawn:
        T_WC = moved_pose(frame.T_WC, (right_m, 0.0, forward_m), turn_deg)
        picture = point_view(frame, T_WC, show=show, point_px=point_px)
        empty = float((picture == 0).all(-1).mean())
        pair = side_by_side([point_colours(frame, show), picture], ["the frame", "its points from the new pose"])
        x, y, z = T_WC[:3, 3].tolist()
        words = f"camera at ({x:.2f}, {y:.2f}, {z:.2f}) m; no point on {empty:.0%} of the pixels"
        return pair, words + legend.get(show, "")

    controls = {
        "right_m": Slider(value=0.0, low=-1.0, high=1.0, step=0.02, label="right, m"),
        "forward_m": Slider(value=0.0, low=-1.0, high=1.0, step=0.02, label="forward, m"),
        "turn_deg": Slider(value=0.0, low=-90, high=90, step=1.0, label="turn right, °", readout=".0f"),
        "show": Choice(value="colour", options=POINT_COLOURS, label="show"),
        "point_px": Slider(value=1, low=1, high=4, step=1, label="point size, px"),
    }
    return Panel(draw, controls, name="points", text="point panel")
