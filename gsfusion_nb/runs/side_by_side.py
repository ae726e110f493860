"""One page of several runs of the same recording: numbers, the same held-out views, meshes, and the
map as it grew."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..drawing import pictures
from ..drawing.page import ColourBar, fill, page_graph, page_picture
from ..errors import ArgumentError
from ..evaluation.metrics import NBSP, format_metric
from ..files import write_file
from .number_words import NUMBERS
from .report import ReportData
from .report_map import opening_values
from .report_panel import ReportPanel

if TYPE_CHECKING:
    from .driver import FinishedRun


SHOWN = (
    "psnr_held_out_db",
    "ssim_held_out",
    "depth_l1_held_out_m",
    "n_gaussians",
    "mesh_accuracy_m",
    "mesh_completion_ratio",
    "fps_total",
    "seconds_online",
    "seconds_compiling",
    "seconds_global",
)
"""The metrics shown of each run, if any run has them."""


def write_side_by_side(path: Path | str, runs: Sequence["FinishedRun"]) -> Path:
    """Write one HTML file, atomically, that loads no other files; it links to the report of each
    run.

    Args:
        path: Of the file, in a folder above those of the runs.
        runs: Of the same recording, each scored; at least one.

    Returns:
        The path written.

    Raises:
        ValueError: a run was not scored, so that it has no report.
    """
    path = Path(path)
    reports = [_report_of(run) for run in runs]
    names = [run.mapper.description.title for run in runs]
    of_frames = {
        name: [step.psnr_after_db for step in run.run.steps]
        for name, run in zip(names, runs, strict=True)
    }
    sizes = {
        name: [step.n_gaussians for step in run.run.steps]
        for name, run in zip(names, runs, strict=True)
    }
    frames = [step.frame_index for step in runs[0].run.steps]
    shown = [report.opening for report in reports if report.opening is not None]
    caption = f"{shown[0].photo.name} of the camera" if shown else ""
    page = fill(
        "side_by_side.html",
        title=f"{' and '.join(names)} on {runs[0].run.sequence.name}",
        opening=opening_values(shown, caption) if shown else None,
        names=names,
        links=[(run.folder / "report.html").relative_to(path.parent).as_posix() for run in runs],
        numbers=list(zip(numbers_of(runs)[1:], meanings_of(runs), strict=True)),
        views=_views([report.views for report in reports], names),
        meshes=[
            page_picture(picture, f"{name}, {words.partition(',')[0]}")
            for views in zip(*(report.mesh_pictures.items() for report in reports), strict=True)
            for name, (words, picture) in zip(names, views, strict=True)
        ][: 2 * len(runs)],
        graphs=[
            page_graph(
                "PSNR of the frame after its steps; a gap: no step for it",
                frames,
                of_frames,
                x_label="frame",
                y_label="PSNR, dB",
            ),
            page_graph("Size of the map", frames, sizes, x_label="frame", y_label="Gaussians"),
        ],
    )
    write_file(path, page)
    return path


def _report_of(run: "FinishedRun") -> ReportData:
    if run.report is None:
        raise ArgumentError(
            f"{run.folder} was not scored, so it has no report to show beside others"
        )
    return run.report


def numbers_of(runs: Sequence["FinishedRun"]) -> list[list[str]]:
    """The rows of a table: a head with the names of the systems, then each number's label and its
    values."""
    rows = [
        [NUMBERS[name].label, *(format_metric(name, run.metrics.get(name)) for run in runs)]
        for name in _measured(runs)
    ]
    return [["", *(run.mapper.description.title for run in runs)], *rows]


def meanings_of(runs: Sequence["FinishedRun"]) -> list[str]:
    """What each number of ``numbers_of`` says, in its order."""
    return [NUMBERS[name].meaning for name in _measured(runs)]


def _measured(runs: Sequence["FinishedRun"]) -> list[str]:
    measured = [name for name in SHOWN if any(name in run.metrics for run in runs)]
    compiled_s = max(run.metrics.get("seconds_compiling", 0.0) for run in runs)
    return [name for name in measured if name != "seconds_compiling" or compiled_s >= 0.05]


def _views(
    of_runs: Sequence[Sequence[ReportPanel]],
    names: Sequence[str],
) -> list[dict[str, Any]]:
    """Each view that all runs held out: what was recorded, and of each run the picture and the
    error of its depth."""
    view_rows = []
    held_out = [{view.name: view for view in views if view.held_out} for views in of_runs]
    for first in held_out[0].values():
        panels = [views[first.name] for views in held_out if first.name in views]
        if len(panels) < len(held_out):
            continue
        near_m, far_m = pictures.depth_range_m(first.depth_m)
        metres = ColourBar(
            colours=pictures.DEPTH_COLOURS, low=f"{near_m:.2f}{NBSP}m", high=f"{far_m:.2f}{NBSP}m"
        )
        difference = ColourBar(
            colours=pictures.ERROR_COLOURS,
            low="0",
            high=f"{pictures.DEPTH_ERROR_LIMIT_M * 100:g}{NBSP}cm or more",
        )
        rows = [page_picture(first.rgb, "As recorded", alt=f"{first.name}, as recorded")]
        for name, panel in zip(names, panels, strict=True):
            rows.append(
                page_picture(
                    panel.render, f"{name}, {panel.psnr:.2f}{NBSP}dB", alt=f"{first.name}, {name}"
                )
            )
        depth_picture = pictures.colour_depth(first.depth_m, near_m, far_m)
        rows.append(
            page_picture(depth_picture, "Depth as measured", alt=f"{first.name}, depth", bar=metres)
        )
        for name, panel in zip(names, panels, strict=True):
            error = pictures.depth_error_map(panel.render_depth_m, panel.depth_m)
            rows.append(
                page_picture(
                    error,
                    f"{name}, error of depth",
                    alt=f"{first.name}, {name}, depth",
                    bar=difference,
                )
            )
        view_rows.append({"name": first.name, "pictures": rows})
    return view_rows
