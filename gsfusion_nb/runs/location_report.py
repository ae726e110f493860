"""The report of a recording that was located in a map: pictures and the map's rendering side by
side, numbers, and errors over the frames."""

import math
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any

import torch

from ..data import OpenedSequence
from ..drawing.page import fill, page_graph, page_picture
from ..errors import SequenceError
from ..evaluation.metrics import METRIC_GROUPS, NBSP, format_metric, reason_missing
from ..files import write_file
from .located_frames import LocatedFrame, LocatedRecording
from .stored_map import StoredMap

SHOWN = 6
"""Number of located frames that are shown, and of others."""
_GROUP = "Location in the map"
_HEADLINE = (
    "share_located",
    "share_within_3_cm",
    "location_error_median_m",
    "location_error_median_deg",
    "seconds_per_located_frame",
)


def write_location_page(
    path: Path, found: LocatedRecording, stored: StoredMap, sequence: OpenedSequence
) -> None:
    """Write report.html, atomically."""
    located_rows = [row for row in found.frames if row.location.is_located]
    others = [row for row in found.frames if not row.location.is_located]
    warnings = list(found.warnings)
    if others:
        warnings.append(
            f"{len(others)} of {len(found.frames)} frames were not located, the first is frame "
            f"{others[0].index}"
        )
    metrics = METRIC_GROUPS[_GROUP]
    page = fill(
        "located.html",
        title=f"{sequence.name} in the map of {stored.folder.name}",
        subtitle=f"{len(located_rows)} of {len(found.frames)} frames located, {stored.system}, "
        f"{len(stored.places)} keyframes",
        warnings=warnings,
        headline=[
            _card(metrics[name].label, format_metric(name, found.metrics[name]))
            for name in _HEADLINE
            if reason_missing(found.metrics[name]) is None
        ],
        views=[_view(row, stored, sequence) for row in _spread(located_rows)],
        lost=[_lost_view(row, sequence) for row in _spread(others)],
        graphs=_graphs(found.frames),
        numbers=[
            (metric.label, metric.meaning, format_metric(name, found.metrics[name]))
            for name, metric in metrics.items()
            if name in found.metrics
        ],
    )
    write_file(path, page)


def _spread(rows: Rows[LocatedFrame]) -> list[LocatedFrame]:
    """At most ``SHOWN`` rows, evenly spread from the first to the last."""
    n = len(rows)
    if n <= SHOWN:
        return list(rows)
    return [rows[round(k * (n - 1) / (SHOWN - 1))] for k in range(SHOWN)]


def _card(label: str, text: str) -> dict[str, str]:
    number, _, unit = text.partition(NBSP)
    return {"label": label, "number": number, "unit": unit}


def _view(row: LocatedFrame, stored: StoredMap, sequence: OpenedSequence) -> dict[str, Any]:
    """The picture, and the map as the camera sees it from the pose that was found."""
    T_WC = row.location.T_WC
    assert T_WC is not None
    frame = _frame(row, sequence)
    location = row.location
    lines = [f"from {location.way}", f"{location.n_landmarks} landmarks"]
    if row.error is not None:
        distance_m, angle_deg = row.error
        lines.append(f"error {distance_m * 100:.1f}{NBSP}cm, {angle_deg:.2f}°")
    images = []
    if frame is not None:
        rgb = frame.rgb.cpu()
        with torch.no_grad():
            drawn = stored.draw(frame.camera, T_WC).rgb.clamp(0, 1).cpu()
        both = (rgb + drawn) / 2
        images = [
            page_picture(rgb, "Picture", alt=f"Frame {row.index}, picture"),
            page_picture(drawn, "Map from the pose", alt=f"Frame {row.index}, map"),
            page_picture(both, "Both, half and half: edges meet", alt=f"Frame {row.index}, both"),
        ]
    return {"name": f"Frame {row.index}", "lines": lines, "pictures": images}


def _lost_view(row: LocatedFrame, sequence: OpenedSequence) -> dict[str, Any]:
    """The picture of a frame that was not located, and why."""
    frame = _frame(row, sequence)
    images = []
    if frame is not None:
        images = [page_picture(frame.rgb.cpu(), "Picture", alt=f"Frame {row.index}, picture")]
    return {"name": f"Frame {row.index}", "lines": [row.location.reason], "pictures": images}


def _frame(row: LocatedFrame, sequence: OpenedSequence) -> Any:
    """The frame, or None if it cannot be read."""
    view = sequence.mapping
    try:
        return view[view.positions.index(row.index)]
    except SequenceError:
        return None


def _graphs(rows: Rows[LocatedFrame]) -> list[Any]:
    """Error, and landmarks in view, over the frames; gaps are frames that were not located."""
    if not rows:
        return []
    x = [row.index for row in rows]
    graphs = []
    if any(row.error for row in rows):
        error_cm = [math.nan if row.error is None else 100 * row.error[0] for row in rows]
        graphs.append(
            page_graph("Error", x, {"error": error_cm}, x_label="frame", y_label="error, cm")
        )
    landmarks = [row.location.n_landmarks if row.location.is_located else math.nan for row in rows]
    graphs.append(
        page_graph(
            "Landmarks of the map in the frame",
            x,
            {"landmarks": landmarks},
            x_label="frame",
            y_label="landmarks that agree",
        )
    )
    return graphs
