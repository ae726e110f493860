"""Panel of the pixels at which RTG-SLAM adds Gaussians, by cause (Eq. 6)."""

import numpy as np
import torch
from markupsafe import Markup
from torch import Tensor

from ...drawing.page import html_table
from ...drawing.pictures import error_map, side_by_side, to_uint8
from ...render import SurfaceView
from ...seeding.rules.rtg_slam import adding_masks
from ...types import Frame
from ..map_pictures import CAUSES
from .panel import Drawn, Panel, Slider


def masks_by_cause(
    view: SurfaceView,
    frame: Frame,
    min_transmittance: float,
    depth_error_m: float,
    colour_error: float,
) -> dict[int, Tensor]:
    """The pixels where Gaussians are added, by cause (RTG-SLAM Eq. 6), keys as in ``CAUSES``; no
    pixel is in two.

    A pixel without a disc has no depth error, as in the library's default.
    """
    seen_m = torch.where(view.depth_m > 0, view.depth_m, frame.depth_m)
    limits = (min_transmittance, depth_error_m, colour_error)
    surface, colour = adding_masks(
        view.transmittance, seen_m, frame.depth_m, view.rgb, frame.rgb, *limits
    )
    unseen = view.transmittance > min_transmittance
    return {1: surface & unseen, 2: surface & ~unseen, 3: colour}


def disc_adding_panel(view: SurfaceView, frame: Frame) -> Panel:
    """Sliders for the thresholds of RTG-SLAM's Eq. 6 over a frame that the map has not seen yet.

    Args:
        view: The map, rendered at the frame's pose.
        frame: The new frame.
    """

    photo = to_uint8(frame.colour)
    render_u8 = to_uint8(view.rgb)

    def draw(*, min_transmittance: float, depth_error_m: float, colour_error: float) -> Drawn:
        masks = masks_by_cause(view, frame, min_transmittance, depth_error_m, colour_error)
        picture = np.repeat(
            0.25 * 255 + 0.5 * photo.mean(-1, keepdims=True),
            3,
            axis=-1,
        )
        count = Markup('<span class="gsnb-adding-{}">{:,} pixels</span>')
        rows = []
        for cause, mask in masks.items():
            share = f"{float(mask.float().mean()):.1%}"
            rows.append((CAUSES[cause][0], count.format(cause, int(mask.sum())), share))
            picture[mask.numpy()] = 0.35 * picture[mask.numpy()] + 0.65 * np.array(CAUSES[cause][1])
        pictures = [photo, render_u8, error_map(render_u8, photo), picture.astype(np.uint8)]
        k = max(1, round(300 / picture.shape[1]))
        pictures = [p.repeat(k, 0).repeat(k, 1) for p in pictures]
        top = side_by_side(pictures[:2], ["new frame", "map so far"])
        low = side_by_side(pictures[2:], ["colour error", "yellow new, red depth, blue colour"])
        return np.concatenate([top, low]), html_table(rows)

    controls = {
        "min_transmittance": Slider(
            value=0.5,
            low=0.05,
            high=0.95,
            step=0.05,
            label="δ_T",
        ),
        "depth_error_m": Slider(
            value=0.1,
            low=0.01,
            high=0.3,
            step=0.01,
            label="δ_d, m",
        ),
        "colour_error": Slider(
            value=0.1,
            low=0.01,
            high=0.3,
            step=0.01,
            label="δ_c",
        ),
    }
    return Panel(draw, controls, name="adding", text="the masks of Eq. 6")
