"""The graphs on the page of a check-up."""

import numpy as np

from ...drawing.page import PageGraph, page_graph
from .frame_to_frame import OverFrames


def graphs(over: OverFrames | None, top_view: str) -> list[PageGraph]:
    """The path from above, and each quantity over the frames that was measured at least once."""
    if over is None:
        return []
    shown = [PageGraph("Path from above", top_view)] if top_view else []
    series = [
        ("Depth difference to the next frame", {"median": 100 * over.error}, "% of depth"),
        ("Rotation to the next frame", {"turn": over.turned_deg}, "degrees"),
        ("Step to the next frame", {"step": 100 * over.moved_m}, "cm"),
        ("Pixels without depth", {"missing": 100 * over.missing}, "%"),
        ("Brightness of the same points, next / this frame", {"gain": over.gain_stops}, "stops"),
        ("Sharpness beside the neighbours'", {"sharpness": over.sharpness}, "of their median"),
    ]
    return shown + [
        page_graph(title, over.number, curves, x_label="frame", y_label=unit)
        for title, curves, unit in series
        if np.isfinite(next(iter(curves.values()))).any()
    ]
