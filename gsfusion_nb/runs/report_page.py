"""Report of a run as one HTML file with numbers, pictures, graphs and settings; it loads no other files."""

from pathlib import Path

from ..drawing.html import fill
from ..drawing.page import page_picture
from ..files import write_file
from . import report_contents as contents
from .report_data import ReportData


def write_report(path: Path | str, run: ReportData) -> Path:
    """Write ``run`` as one HTML file, atomically: a reader sees the old file or the new one, never a partial one.

    Returns:
        The path written.
    """
    path = Path(path)
    write_file(path, report_html(run))
    return path


def report_html(run: ReportData) -> str:
    """The page as HTML text."""
    return fill(
        "report.html",
        title=run.title,
        subtitle=run.subtitle,
        warnings=run.warnings,
        headline=contents.headline(run.metrics),
        views=contents.views(run.views),
        quadtrees=contents.quadtrees(run.views),
        graphs=contents.graphs(run.frames, run.global_losses),
        stages=contents.stages(run.frames),
        meshes=[page_picture(image, name) for name, image in run.mesh_pictures.items()],
        groups=contents.metric_groups(run.metrics),
        files=run.files,
        config=contents.settings(run.config),
        environment=contents.settings(run.environment),
        frame_rows=[contents.frame_cells(row) for row in run.frames],
    )
