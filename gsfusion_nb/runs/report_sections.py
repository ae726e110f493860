"""The sections of the report page, each a function from plain data to HTML. An empty section is an empty string."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from ..drawing import pictures
from ..drawing.page import PICTURE_WIDTH, chart, colour_bar, figure
from ..evaluation.metrics import METRIC_GROUPS, METRICS, NBSP, format_metric, format_value, reason_missing

if TYPE_CHECKING:
    from .report_page import FrameRow, ViewPanel

HEADLINE = (
    ("psnr_held_out_db", "PSNR, held out", "ssim_held_out", "SSIM {}"),
    ("psnr_mapped_db", "PSNR, mapped", "ssim_mapped", "SSIM {}"),
    ("n_gaussians", "Gaussians", "model_size_mb", "{}"),
    ("n_keyframes", "Keyframes", "n_frames", "of {} frames"),
    ("fps_total", "Frames / total time", "fps_mean_inverse", "mean 1/dt: {}"),
    ("peak_memory_mb", "Peak memory", "seconds_total", "whole run: {}"),
)
"""Large number, its label, and the number in the line under it."""

HOW_TO_OPEN = {
    "gaussians.ply": "Standard 3D Gaussian splatting file: drop it into SuperSplat, antimatter15/splat or PlayCanvas.",
    "mesh.ply": "Coloured triangle mesh in metres: MeshLab, CloudCompare, Blender or <code>pyvista.read</code>.",
    "trajectory.txt": "TUM format, camera to world: <code>evo_traj tum trajectory.txt --plot</code>.",
    "config.json": "Every setting of the run; start from it to repeat or vary the run.",
    "metrics.json": "The numbers of this page: <code>json.load</code>, or <code>pandas.read_json</code> for many runs.",
    "report.html": "This page; it needs no other file.",
}


def header(title: str, subtitle: str, warnings: Sequence[str]) -> str:
    """Title, one line of context, and warnings where nobody misses them."""
    notes = "".join(f'<div class="warn" role="alert">{escape(text)}</div>' for text in warnings)
    lead = f'<p class="lead">{escape(subtitle)}</p>' if subtitle else ""
    return f"<header><h1>{escape(title)}</h1>{lead}{notes}</header>"


def headline(metrics: Mapping[str, Any]) -> str:
    """The numbers that a reader wants first."""
    if not metrics:
        return ""
    cards = []
    for name, label, second, line in HEADLINE:
        more = ""
        if reason_missing(metrics.get(second)) is None:
            more = f'<div class="more">{line.format(escape(format_metric(second, metrics[second])))}</div>'
        cards.append(f'<div class="card"><div class="label">{label}</div>{_large(name, metrics.get(name))}{more}</div>')
    return f'<section class="grid hero">{"".join(cards)}</section>'


def _large(name: str, value: Any) -> str:
    text = escape(format_metric(name, value))
    if reason_missing(value) is not None:
        return f'<div class="value missing">{text}</div>'
    number, _, unit = text.partition(NBSP)
    return f'<div class="value">{number}{f"{NBSP}<small>{unit}</small>" if unit else ""}</div>'


def views(panels: "Sequence[ViewPanel]") -> str:
    """Input, render and error of each view and the same for depth, held-out views first; then the quadtrees."""
    if not panels:
        return ""
    ordered = sorted(panels, key=lambda panel: not panel.held_out)
    trees = "".join(_quadtree(panel) for panel in ordered if panel.cells is not None)
    trees = f'<h2>Quadtree</h2><div class="grid two">{trees}</div>' if trees else ""
    return (
        "<section><h2>Views</h2>"
        '<p class="note">Held-out views were never mapped: they show how well the map predicts what it has not seen. '
        "Click a picture to enlarge it.</p>" + "".join(_view(panel) for panel in ordered) + trees + "</section>"
    )


def _view(panel: "ViewPanel") -> str:
    chip = '<span class="chip held">held out</span>' if panel.held_out else '<span class="chip">mapped</span>'
    scores = [f"PSNR {panel.psnr:.2f}{NBSP}dB"] if not math.isnan(panel.psnr) else []
    scores += [f"SSIM {panel.ssim:.3f}"] if not math.isnan(panel.ssim) else []
    limit = pictures.ERROR_LIMIT
    error = pictures.error_map(panel.render, panel.rgb)
    parts = [
        figure(panel.rgb, f"{panel.name}, input", "Input"),
        figure(panel.render, f"{panel.name}, render", "Render"),
        figure(error, f"{panel.name}, error", "|Render − input|, mean of channels")
        + colour_bar(pictures.ERROR_COLOURS, "0", f"{limit:g} or more, of 1"),
    ]
    parts += _depth_pair(panel)
    kinds = ("", "", ' class="error"', "", "", ' class="error"')  # on a narrow page the errors move behind the pairs
    figures = "".join(f"<figure{kind}>{part}</figure>" for kind, part in zip(kinds, parts, strict=False))
    return (
        f'<article class="card view"><div class="view-head"><h3>{escape(panel.name)}</h3>{chip}'
        f'<span class="score">{" · ".join(scores)}</span></div><div class="pictures">{figures}</div></article>'
    )


def _depth_pair(panel: "ViewPanel") -> list[str]:
    pair = {"Depth, measured": panel.depth_m, "Depth, rendered": panel.render_depth_m}
    known = {caption: depth for caption, depth in pair.items() if depth is not None}
    if not known:
        return []
    near, far = pictures.depth_range_m(*known.values())
    bar = colour_bar(pictures.DEPTH_COLOURS, f"{near:.2f}{NBSP}m", f"{far:.2f}{NBSP}m")
    parts = [
        figure(pictures.colour_depth(depth, near, far), f"{panel.name}, {caption}", f"{caption} (striped: missing)")
        + bar
        for caption, depth in known.items()
    ]
    if panel.depth_m is not None and panel.render_depth_m is not None:
        limit_m = pictures.DEPTH_ERROR_LIMIT_M
        error = pictures.depth_error_map(panel.render_depth_m, panel.depth_m)
        ends = colour_bar(pictures.ERROR_COLOURS, "0", f"{limit_m * 100:g}{NBSP}cm or more")
        parts.append(figure(error, f"{panel.name}, depth error", "|Rendered − measured depth|") + ends)
    return parts


def _quadtree(panel: "ViewPanel") -> str:
    scale = max(1, round(PICTURE_WIDTH / panel.rgb.shape[1]))
    painted = pictures.paint_cells(panel.rgb, panel.cells, scale=scale)
    caption = f"{panel.name}, {len(panel.cells.level):,} cells: one Gaussian may be seeded in each"
    painted_figure = figure(painted, f"{panel.name}, quadtree", caption)
    return f'<figure class="card">{painted_figure}{colour_bar(pictures.LEVEL_COLOURS, "coarse", "fine")}</figure>'


def curves(frames: "Sequence[FrameRow]", global_losses: Sequence[float | int]) -> str:
    """Time by stage, size of the map, PSNR and loss over the frames, and where the time went."""
    x = [row.index for row in frames]
    keys = [row.index for row in frames if row.keyframe]
    marks = {"marks": keys, "marks_label": "keyframe"}
    charts = []
    if frames:
        charts.append(chart("Time per frame", x, _stages_ms(frames), x_label="frame", y_label="time, ms", stacked=True))
        gaussians = {"Gaussians": [row.n_gaussians for row in frames]}
        charts.append(chart("Size of the map", x, gaussians, x_label="frame", y_label="Gaussians", **marks))
    psnr = {"before the step": [r.psnr_before for r in frames], "after the step": [r.psnr for r in frames]}
    psnr = {label: values for label, values in psnr.items() if not all(map(math.isnan, values))}
    if psnr:
        charts.append(chart("PSNR of the current view", x, psnr, x_label="frame", y_label="PSNR, dB", **marks))
    if any(row.losses for row in frames):
        ends = {
            "first step": [row.losses[0] if row.losses else math.nan for row in frames],
            "last step": [row.losses[-1] if row.losses else math.nan for row in frames],
        }
        charts.append(chart("Loss at a frame's first and last step", x, ends, x_label="frame", y_label="loss"))
    if global_losses:
        passes = list(range(1, len(global_losses) + 1))
        loss = {"mean loss": list(global_losses)}
        charts.append(chart("Global optimisation", passes, loss, x_label="pass over the keyframes", y_label="loss"))
    charts.append(_stage_card(frames))
    if not any(charts):
        return ""
    return f'<section><h2>Over the frames</h2><div class="grid two">{"".join(charts)}</div></section>'


def _stage_names(frames: "Sequence[FrameRow]") -> list[str]:
    return list(dict.fromkeys(name for row in frames for name in row.stage_seconds))


def _stages_ms(frames: "Sequence[FrameRow]") -> dict[str, list[float]]:
    """Stage -> milliseconds per frame; what no stage claims is "other", so that the top is the whole step."""
    stages = {n: [1e3 * row.stage_seconds.get(n, 0.0) for row in frames] for n in _stage_names(frames)}
    rest = [max(0.0, 1e3 * (row.seconds - sum(row.stage_seconds.values()))) for row in frames]
    if not stages:
        return {"whole step": rest}
    return {**stages, "other": rest} if sum(rest) > 0.005 * sum(1e3 * row.seconds for row in frames) else stages


def meshes(images: Mapping[str, pictures.AnyImage]) -> str:
    """Pictures of the mesh."""
    if not images:
        return ""
    figures = "".join(f"<figure>{figure(image, name, name)}</figure>" for name, image in images.items())
    return f'<section><h2>Mesh</h2><div class="card view"><div class="pictures few">{figures}</div></div></section>'


def all_metrics(metrics: Mapping[str, Any]) -> str:
    """Every number, in groups, with what it means; numbers without a known name come last."""
    cards = []
    for group, names in METRIC_GROUPS.items():
        rows = [
            (METRICS[n].label, METRICS[n].meaning, format_metric(n, metrics[n]), metrics[n])
            for n in names
            if n in metrics
        ]
        cards.append(_metric_card(group, rows))
    other = [(name, "", format_metric(name, value), value) for name, value in metrics.items() if name not in METRICS]
    cards.append(_metric_card("Other", other))
    if not any(cards):
        return ""
    return f'<section><h2>Numbers</h2><div class="grid two">{"".join(cards)}</div></section>'


def _metric_card(title: str, rows: list[tuple[str, str, str, Any]]) -> str:
    if not rows:
        return ""
    lines = ""
    for label, meaning, text, value in rows:
        if reason_missing(value) is not None:
            lines += f'<tr><td colspan="2">{escape(label)}<span class="what missing">{escape(text)}</span></td></tr>'
            continue
        what = f'<span class="what">{escape(meaning)}</span>' if meaning else ""
        lines += f'<tr><td>{escape(label)}{what}</td><td class="num">{escape(text)}</td></tr>'
    return f'<div class="card"><h3>{escape(title)}</h3><table>{lines}</table></div>'


def _stage_card(frames: "Sequence[FrameRow]") -> str:
    if not frames or not _stage_names(frames):
        return ""
    stages = {name: sum(ms) for name, ms in _stages_ms(frames).items()}
    total = sum(stages.values()) or 1.0
    rows = "".join(
        f'<tr><td>{escape(name)}</td><td class="num">{ms / len(frames):,.1f}{NBSP}ms</td>'
        f'<td class="num">{ms / 1e3:,.2f}{NBSP}s</td><td class="num">{ms / total:.0%}</td></tr>'
        for name, ms in stages.items()
    )
    head = '<tr><th>Stage</th><th class="num">per frame</th><th class="num">in all</th><th class="num">share</th></tr>'
    return f'<div class="card"><h3>Where the time went</h3><table>{head}{rows}</table></div>'


def files(names: Mapping[str, str]) -> str:
    """The files of the run and what opens them."""
    if not names:
        return ""
    rows = "".join(
        f"<tr><td><code>{escape(name)}</code></td><td>{escape(text)}"
        f'<span class="what">{HOW_TO_OPEN.get(name, "")}</span></td></tr>'
        for name, text in names.items()
    )
    table = f'<table class="files">{rows}</table>'
    return f'<section><h2>Files, and what opens them</h2><div class="card view">{table}</div></section>'


def settings(title: str, values: Mapping[str, Any]) -> str:
    """Settings as dotted names."""
    if not values:
        return ""
    rows = "".join(
        f'<div><code>{escape(name)}</code><span class="v">{escape(format_value(value))}</span></div>'
        for name, value in _flat(values)
    )
    return f'<section><h2>{escape(title)}</h2><div class="card view columns">{rows}</div></section>'


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows = []
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            rows += _flat(value, f"{prefix}{name}.")
        else:
            rows.append((prefix + name, "none" if value in ({}, None, "") else value))
    return rows


def frame_table(frames: "Sequence[FrameRow]") -> str:
    """Every frame's numbers, folded away."""
    if not frames:
        return ""
    columns = (
        "frame",
        "keyframe",
        "time, ms",
        "new Gaussians",
        "Gaussians",
        "PSNR before, dB",
        "PSNR after, dB",
        "last loss",
    )
    head = "".join(f'<th class="num">{name}</th>' for name in columns)
    return (
        f"<details><summary>All {len(frames):,} frames</summary>"
        f'<div class="card scroll"><table><thead><tr>{head}</tr></thead><tbody>'
        + "".join(map(_frame_line, frames))
        + "</tbody></table></div></details>"
    )


def _frame_line(row: "FrameRow") -> str:
    def number(value: float, digits: int) -> str:
        return "–" if math.isnan(value) else f"{value:.{digits}f}"

    cells = (
        f"{row.index}", "●" if row.keyframe else "", f"{1e3 * row.seconds:,.0f}", f"{row.n_seeds:,}",
        f"{row.n_gaussians:,}", number(row.psnr_before, 2), number(row.psnr, 2),
        number(row.losses[-1] if row.losses else math.nan, 4),
    )  # fmt: skip
    return "<tr>" + "".join(f'<td class="num">{text}</td>' for text in cells) + "</tr>"
