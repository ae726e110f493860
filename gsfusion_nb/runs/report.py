"""The report of a run as one HTML file with numbers, pictures, graphs and settings; it loads no
other files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..drawing import pictures
from ..drawing.page import PICTURE_WIDTH, ColourBar, PageGraph, fill, page_graph, page_picture
from ..drawing.pictures import AnyImage
from ..evaluation.metrics import (
    METRIC_GROUPS,
    METRICS,
    NBSP,
    format_metric,
    format_value,
    reason_missing,
)
from ..files import write_file
from ..mapping.step_report import StepReport
from .number_words import NUMBERS
from .report_map import Opening, opening_values
from .report_panel import ReportPanel

HEADLINE = (
    ("psnr_held_out_db", "ssim_held_out", "SSIM {}"),
    ("psnr_mapped_db", "ssim_mapped", "SSIM {}"),
    ("n_gaussians", "model_size_mb", "{}"),
    ("n_keyframes", "n_frames", "of {} frames"),
    ("fps_total", "fps_mean_inverse", "mean 1/dt: {}"),
    ("peak_memory_mb", "seconds_total", "whole run: {}"),
)
"""Per box: metric shown large, metric in the line below, and the text of that line. What the first
one says is in ``NUMBERS``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportData:
    """Everything the report shows. Only the title is required; parts that are not given are not
    shown."""

    title: str
    about: str = ""
    """A sentence for somebody who sees such a report for the first time."""
    subtitle: str = ""
    """One line: settings that people compare."""
    opening: Opening | None = None
    """The map and a photograph, at the top."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """Name -> number or ``NotComputed``; the known names, labels and units are in
    ``metrics.METRIC_GROUPS``."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """Settings as nested dictionaries, as from ``dataclasses.asdict``."""
    frames: Sequence[StepReport] = ()
    states: Sequence[str] = ()
    """Names of those counts of each frame that add up to its Gaussians."""
    global_losses: Sequence[float | int] = ()
    """Mean loss of each pass of the global optimisation."""
    views: Sequence[ReportPanel] = ()
    mesh_pictures: Mapping[str, AnyImage] = field(default_factory=dict)
    """Caption -> picture of the mesh."""
    warnings: Sequence[str] = ()
    """Sentences shown at the top, for example why a run ended early."""
    environment: Mapping[str, Any] = field(default_factory=dict)
    """Versions, threads, device."""
    files: Mapping[str, str] = field(default_factory=dict)
    """File name -> what it contains and which programs open it."""


def write_report(path: Path | str, run: ReportData) -> Path:
    """Write ``run`` as one HTML file, atomically: a reader sees the old file or the new one, never
    a partial one.

    Returns:
        The path written.
    """
    page = fill(
        "report.html",
        title=run.title,
        about=run.about,
        opening=_opening(run.opening),
        subtitle=run.subtitle,
        warnings=run.warnings,
        headline=_headline(run.metrics),
        views=_views(run.views),
        quadtrees=_quadtrees(run.views),
        graphs=_graphs(run.frames, run.states, run.global_losses),
        stages=_stages(run.frames),
        meshes=[page_picture(image, name) for name, image in run.mesh_pictures.items()],
        groups=_metric_groups(run.metrics),
        files=run.files,
        config=_settings(run.config),
        environment=_settings(run.environment),
        frame_rows=[_frame_cells(row) for row in run.frames],
    )
    path = Path(path)
    write_file(path, page)
    return path


def _opening(opening: Opening | None) -> dict[str, Any] | None:
    """The map and the photograph beside it."""
    if opening is None:
        return None
    seen = "This photograph was not mapped." if opening.photo.held_out else ""
    caption = f"{opening.photo.name} of the camera. {seen}"
    return opening_values([opening], caption.strip())


def _headline(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The main numbers, shown at the top."""
    boxes = []
    for name, second, line in HEADLINE if metrics else ():
        value = metrics.get(name)
        more = ""
        if reason_missing(metrics.get(second)) is None:
            more = line.format(format_metric(second, metrics[second]))
        missing = reason_missing(value) is not None
        text = format_metric(name, value)
        number, _, unit = (text, "", "") if missing else text.partition(NBSP)
        boxes.append(
            {
                "label": NUMBERS[name].label,
                "meaning": NUMBERS[name].meaning,
                "number": number,
                "unit": unit,
                "is_missing": missing,
                "more": more,
            }
        )
    return boxes


def _views(panels: Sequence[ReportPanel]) -> list[dict[str, Any]]:
    """Input, render and error of each view, and the same for depth; held-out views come first."""
    views = []
    for panel in sorted(panels, key=lambda panel: not panel.held_out):
        scores = [f"PSNR {panel.psnr:.2f}{NBSP}dB", f"SSIM {panel.ssim:.3f}"]
        views.append(
            {
                "name": panel.name,
                "held_out": panel.held_out,
                "scores": scores,
                "pictures": _pictures(panel),
            }
        )
    return views


def _pictures(panel: ReportPanel) -> list[dict[str, Any]]:
    depth_m = panel.depth_m
    render_depth_m = panel.render_depth_m
    near_m, far_m = pictures.depth_range_m(depth_m, render_depth_m)
    error = pictures.ERROR_COLOURS
    depth = pictures.DEPTH_COLOURS
    light = ColourBar(colours=error, low="0", high=f"{pictures.ERROR_LIMIT:g} or more, of 1")
    metres = ColourBar(colours=depth, low=f"{near_m:.2f}{NBSP}m", high=f"{far_m:.2f}{NBSP}m")
    difference = ColourBar(
        colours=error, low="0", high=f"{pictures.DEPTH_ERROR_LIMIT_M * 100:g}{NBSP}cm or more"
    )
    rows = (
        ("Input", panel.rgb, None),
        ("Render", panel.render, None),
        ("|Render − input|, mean of channels", pictures.error_map(panel.render, panel.rgb), light),
        (
            "Depth, measured (striped: missing)",
            pictures.colour_depth(depth_m, near_m, far_m),
            metres,
        ),
        (
            "Depth, rendered (striped: missing)",
            pictures.colour_depth(render_depth_m, near_m, far_m),
            metres,
        ),
        (
            "|Rendered − measured depth|",
            pictures.depth_error_map(render_depth_m, depth_m),
            difference,
        ),
    )
    return [
        page_picture(image, words, alt=f"{panel.name}, {words}", bar=bar)
        for words, image, bar in rows
    ]


def _quadtrees(panels: Sequence[ReportPanel]) -> list[dict[str, Any]]:
    """The input of each view that has quadtree cells, with the cells drawn over it."""
    trees = []
    for panel in sorted(panels, key=lambda panel: not panel.held_out):
        if panel.cells is None:
            continue
        scale = max(1, round(PICTURE_WIDTH / panel.rgb.shape[1]))
        canvas = pictures.paint_cells(panel.rgb, panel.cells, scale=scale)
        caption = (
            f"{panel.name}, {len(panel.cells.level):,} cells: one Gaussian may be seeded in each"
        )
        bar = ColourBar(colours=pictures.LEVEL_COLOURS, low="coarse", high="fine")
        trees.append(page_picture(canvas, caption, alt=f"{panel.name}, quadtree", bar=bar))
    return trees


def _graphs(
    frames: Sequence[StepReport], states: Sequence[str], global_losses: Sequence[float | int]
) -> list[PageGraph]:
    """Time by stage, size of the map, its states, PSNR and loss over the frames, and the loss of
    the global optimisation."""
    x = [row.frame_index for row in frames]
    marks = {
        "marks": [row.frame_index for row in frames if row.is_keyframe],
        "marks_label": "keyframe",
    }
    graphs = []
    if frames:
        times = _stages_ms(frames)
        graphs.append(
            page_graph(
                "Time per frame", x, times, x_label="frame", y_label="time, ms", stacked=True
            )
        )
        gaussians = {"Gaussians": [row.n_gaussians for row in frames]}
        graphs.append(
            page_graph(
                "Size of the map", x, gaussians, x_label="frame", y_label="Gaussians", **marks
            )
        )
    if frames and states:
        counts = {name.replace("_", " "): [row.counts[name] for row in frames] for name in states}
        labels = {"x_label": "frame", "y_label": "Gaussians"}
        graphs.append(page_graph("States of the Gaussians", x, counts, stacked=True, **labels))
    psnr = {
        "before the step": [r.psnr_before_db for r in frames],
        "after the step": [r.psnr_after_db for r in frames],
    }
    psnr = {label: values for label, values in psnr.items() if not all(map(math.isnan, values))}
    if psnr:
        graphs.append(
            page_graph(
                "PSNR of the current view", x, psnr, x_label="frame", y_label="PSNR, dB", **marks
            )
        )
    if any(row.losses for row in frames):
        ends = {
            "first step": [row.losses[0] if row.losses else math.nan for row in frames],
            "last step": [row.losses[-1] if row.losses else math.nan for row in frames],
        }
        graphs.append(
            page_graph(
                "Loss at a frame's first and last step", x, ends, x_label="frame", y_label="loss"
            )
        )
    if global_losses:
        passes = list(range(1, len(global_losses) + 1))
        loss = {"mean loss": list(global_losses)}
        label = "pass over the keyframes"
        graphs.append(
            page_graph("Global optimisation", passes, loss, x_label=label, y_label="loss")
        )
    return graphs


def _stages(frames: Sequence[StepReport]) -> list[dict[str, str]]:
    """Time of each stage: per frame, in total, and as a share."""
    times = {name: sum(ms) for name, ms in _stages_ms(frames).items()}
    whole = sum(times.values()) or 1.0
    return [
        {
            "name": name,
            "per_frame": f"{ms / len(frames):,.1f}{NBSP}ms",
            "total": f"{ms / 1e3:,.2f}{NBSP}s",
            "share": f"{ms / whole:.0%}",
        }
        for name, ms in times.items()
    ]


def _stages_ms(frames: Sequence[StepReport]) -> dict[str, list[float]]:
    """Stage -> milliseconds per frame."""
    names = dict.fromkeys(name for row in frames for name in row.seconds)
    return {name: [1e3 * row.seconds.get(name, 0.0) for row in frames] for name in names}


def _metric_groups(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """All metrics in groups, each with its meaning; metrics with unknown names come last."""
    groups = {
        group: [
            _metric_line(METRICS[n].label, METRICS[n].meaning, n, metrics[n])
            for n in names
            if n in metrics
        ]
        for group, names in METRIC_GROUPS.items()
    }
    groups["Other"] = [
        _metric_line(name, "", name, value)
        for name, value in metrics.items()
        if name not in METRICS
    ]
    return [{"title": group, "lines": lines} for group, lines in groups.items() if lines]


def _metric_line(
    label: str,
    meaning: str,
    name: str,
    value: Any,
) -> dict[str, Any]:
    missing = reason_missing(value) is not None
    return {
        "label": label,
        "meaning": meaning,
        "text": format_metric(name, value),
        "is_missing": missing,
    }


def _settings(
    values: Mapping[str, Any],
    prefix: str = "",
) -> list[tuple[str, str]]:
    """Settings as dotted names and short texts."""
    rows = []
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            rows += _settings(value, f"{prefix}{name}.")
        else:
            rows.append((prefix + name, format_value("none" if value in ({}, None, "") else value)))
    return rows


def _frame_cells(row: StepReport) -> tuple[str, ...]:
    """One row of the table of frames."""

    def number(value: float, digits: int) -> str:
        return "–" if math.isnan(value) else f"{value:.{digits}f}"

    return (
        f"{row.frame_index}",
        "●" if row.is_keyframe else "",
        f"{1e3 * row.total_seconds:,.0f}",
        f"{row.n_seeds:,}",
        f"{row.n_gaussians:,}",
        number(row.psnr_before_db, 2),
        number(row.psnr_after_db, 2),
        number(row.losses[-1] if row.losses else math.nan, 4),
    )
