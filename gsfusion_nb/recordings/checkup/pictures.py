"""Pictures of a check-up: depth of one frame compared with another, depth edges on colour, the path
from above."""

from collections import abc
from typing import Any

import cv2
import torch

from ...config import RepairConfig
from ...data.adjust.depth_agreement import relative_poses, thinned
from ...data.adjust.poses import reread_poses
from ...data.depth_registration import warp_depth
from ...data.sequence import Sequence
from ...drawing.curves import curve_figure
from ...drawing.page import PageGraph
from ...drawing.pictures import Picture, depth_error_map, fit_width, to_uint8
from ...errors import BadFrameError
from ...types import Frame
from .edges import depth_edges
from .sample import Sample

EDGE_COLOUR = (0, 255, 160)
_WIDTH = 640
_GAP = 8


def pictures_of(
    as_read: Sequence,
    as_repaired: Sequence | None,
    pairs: abc.Sequence[tuple[int, int]],
    *,
    has_poses: bool,
) -> dict[str, Picture]:
    """Depth errors and edges of a pair in the middle of the recording, as read and repaired.

    Args:
        as_read, as_repaired: The recording before and after its repair; the second may have fewer
            frames.
        pairs: Positions of the frames compared, in the first.
        has_poses: Whether there are poses; without them only edges are drawn.
    """
    by_preference = sorted(
        pairs,
        key=lambda p: (abs(p[1] - p[0] - _GAP), abs(p[0] - len(as_read) // 2)),
    )
    numbers_as_read = getattr(as_read, "positions", range(len(as_read)))
    pictures: dict[str, Picture] = {}
    for label, sequence in (("as read", as_read), ("repaired", as_repaired)):
        if sequence is None:
            break
        numbers = list(getattr(sequence, "positions", range(len(sequence))))
        for pair in by_preference[:4]:
            try:
                first, second = (sequence[numbers.index(numbers_as_read[place])] for place in pair)
            except (BadFrameError, ValueError):  # the repair leaves it out
                continue
            i = first.index
            j = second.index
            if has_poses:
                title = (
                    f"Depth of frame {i} in frame {j}, {label}: difference to the depth "
                    "measured there"
                )
                pictures[title] = depth_error(first, second)
            pictures[f"Frame {j}, {label}: depth edges (green) on colour"] = edge_overlay(second)
            break
    return pictures


def depth_error(first: Frame, second: Frame) -> Picture:
    """Depth of ``first`` moved into ``second``, compared with the depth there; light yellow: 10 cm
    or more."""
    # sparse points leave holes, so the target has half the resolution
    step = max(1, round(first.camera.width / (_WIDTH / 2)))
    camera, depth_b = thinned(second.camera, second.depth_m, step)
    T = relative_poses(first.T_WC.double(), second.T_WC.double())
    depth_in_second = warp_depth(first.depth_m, first.camera, camera, T)
    picture = depth_error_map(depth_in_second, depth_b)
    size = (_WIDTH, round(picture.shape[0] * _WIDTH / picture.shape[1]))
    return to_uint8(cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST))


def edge_overlay(frame: Frame) -> Picture:
    """The colour image with the depth image's edges drawn in."""
    picture = fit_width(frame.colour, _WIDTH)
    _, depth_m = thinned(
        frame.camera,
        frame.depth_m,
        max(1, round(frame.camera.width / 320)),
    )
    h, w = picture.shape[:2]
    canvas = cv2.resize(
        picture,
        (_WIDTH, round(h * _WIDTH / w)),
        interpolation=cv2.INTER_LINEAR,
    )
    mask = (
        cv2.resize(
            depth_edges(depth_m.numpy()),
            canvas.shape[1::-1],
            interpolation=cv2.INTER_NEAREST,
        )
        > 0
    )
    canvas[mask] = EDGE_COLOUR
    return canvas


def path_from_above(sample: Sample, interpretation: RepairConfig) -> list[PageGraph]:
    """The path seen along the cameras' mean up direction; nothing with fewer than two poses."""
    T = reread_poses(sample.stored_poses, interpretation)
    T = T[torch.isfinite(T).all(dim=(1, 2))]
    if len(T) < 2:
        return []
    up_W = -T[:, :3, 1].mean(0)
    up_W = up_W / up_W.norm().clamp_min(1e-9)
    forward_W = T[0, :3, 2] - (T[0, :3, 2] @ up_W) * up_W
    forward_W = forward_W / forward_W.norm().clamp_min(1e-9)
    at = T[:, :3, 3] - T[:, :3, 3].mean(0)
    x, y = ((at @ axis).numpy() for axis in (torch.linalg.cross(forward_W, up_W), forward_W))
    figure = curve_figure(x, {"path": y}, x_label="metres", y_label="metres")
    axes: Any = figure.axes[0]
    axes.set_aspect("equal", adjustable="datalim")
    return [PageGraph("Path from above", figure)]
