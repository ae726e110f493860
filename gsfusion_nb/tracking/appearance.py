"""Whether a frame looks like the model at a pose, because geometry alone cannot tell one bare wall from another."""

from ..geometry import sum_rows
from ..types import Frame
from .surface import Surface

SAME_PLACE = 0.6
"""Smallest correlation of brightness where camera and model see the same surface. In the built-in room it is at least
0.94 at the true pose, and mostly below 0.5 at the poses of other frames."""
SAME_SURFACE_M = 0.05
"""Largest difference of depth at which camera and model see the same surface, metres."""
ENOUGH_PIXELS = 100
"""Smallest number of such pixels."""


def correlation(frame: Frame, surface: Surface) -> float | None:
    """Correlation of the frame's brightness with the model's, over the pixels that both see at the same depth.

    Args:
        frame: The frame.
        surface: The model seen from the pose to test, with colours, at the frame's size.

    Returns:
        -1 to 1; ``None`` if the model has no colours, too few pixels are shared, or an image is uniform there.
    """
    if surface.rgb is None or surface.depth_m.shape != frame.depth_m.shape:
        return None
    both = (surface.depth_m > 0) & (frame.depth_m > 0)
    both &= (surface.depth_m - frame.depth_m).abs() < SAME_SURFACE_M
    if int(both.sum()) < ENOUGH_PIXELS:
        return None
    a, b = (image[both].mean(dim=-1) for image in (frame.rgb, surface.rgb))
    a, b = a - sum_rows(a) / len(a), b - sum_rows(b) / len(b)
    norm = float((sum_rows(a * a) * sum_rows(b * b)).sqrt())
    return float(sum_rows(a * b)) / norm if norm > 1e-3 else None
