"""What the front end of the splat viewer is told of a map and a camera, besides the rows."""

from collections.abc import Sequence
from typing import Any

import torch

from ..render.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    FRUSTUM_CLAMP,
    NEAR_PLANE_M,
    SCREEN_BLUR_PX2,
    TRANSMITTANCE_MIN,
)
from ..types import Camera, GaussianParams
from .palettes import PALETTES, palette
from .splat_rows import Column, finite_rows
from .viewpoint import Place

PICK_ALPHA = 0.25
"""A click picks the front-most Gaussian whose alpha at the pixel is at least this."""
SOFTWARE_ROWS = 150_000
"""The software rasteriser draws at most this many rows, the most important; with more it would
react too slowly."""


def rules(near_m: float = NEAR_PLANE_M) -> dict[str, float]:
    """The numbers of the library's renderer, which the front end uses, too. Gaussians nearer than
    ``near_m``, metres, are not drawn."""
    return {
        "near_m": near_m,
        "blur_px2": SCREEN_BLUR_PX2,
        "clamp": FRUSTUM_CLAMP,
        "alpha_min": ALPHA_MIN,
        "alpha_max": ALPHA_MAX,
        "transmittance_min": TRANSMITTANCE_MIN,
        "pick_alpha": PICK_ALPHA,
        "software_rows": SOFTWARE_ROWS,
    }


def view_state(camera: Camera, places: dict[str, Place], up_W: torch.Tensor) -> dict[str, Any]:
    """Where the viewer is and can go.

    Args:
        camera: Of the canvas.
        places: Of ``places_of``; the viewer starts at "photo".
        up_W: The world's up direction. [3]
    """
    first = places["photo"]
    return {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "up_W": (up_W / up_W.norm()).tolist(),
        "pose": first.T_WC.flatten().tolist(),
        "pivot_m": first.pivot_m,
        "reach_m": 1.5 * places["above"].pivot_m,
        "places": {
            name: [p.T_WC.flatten().tolist(), p.pivot_m, p.cut_m] for name, p in places.items()
        },
        "palettes": {name: palette(name).tobytes().hex() for name in PALETTES},
    }


def map_state(params: GaussianParams, columns: Sequence[Column]) -> dict[str, Any]:
    """What the rows can be coloured by, when they were born, and a warning if the map has invalid
    rows."""
    frames = [c for c in columns if c.kind == "frame" and len(c.values)]
    bad = len(params) - int(finite_rows(params).sum())
    words = f"{bad:,} of the rows hold NaN or infinite numbers and are not drawn" if bad else ""
    return {
        "columns": [c.as_dict() for c in columns],
        "birth_range": list(frames[0].limits) if frames else [],
        "notice": words,
    }
