"""The top of a report: the map of a run, to be dragged, beside a photograph."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from ..drawing.encoding import data_uri
from ..drawing.page import page_picture
from ..geometry.upright import world_up
from ..render.near_plane import near_plane_m
from ..resources import MAP_MEMORY
from ..types import Mesh
from ..viewer.page_map import PageMap, page_map, page_script, page_style, waiting_controls
from ..viewer.viewpoint import viewing_camera
from .mapping_run import MappingRun
from .report_panel import ReportPanel

CANVAS_WIDTH = 480
"""Of the picture of the map, pixels; the page stretches it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Opening:
    """What stands at the top of a report."""

    map: PageMap
    title: str
    """Name of the system that made the map."""
    photo: ReportPanel
    """The view to which the button "photo" goes."""
    notes: Sequence[str]
    """Sentences below the map: what is not as in the run's own pictures, and why."""


def opening_of(run: MappingRun, views: Sequence[ReportPanel], mesh: Mesh) -> Opening | None:
    """The map of a run, seen from above without its ceiling, and one of its views, a held-out one
    if there is any; None if the map is empty, there is no view, or the memory is limited and the
    system draws a surface.

    Args:
        run: The run, when its maps are complete.
        views: Those of its report.
        mesh: Its surface.
    """
    mapper = run.mapper
    draws_surface = mapper.description.needs_volume_to_render
    if draws_surface and MAP_MEMORY.limit_bytes is not None:
        return None  # all discs of a large surface would not fit
    params = mapper.files.standard_gaussians(mesh)
    photo = min(views, key=lambda view: not view.held_out, default=None)
    if not len(params) or photo is None or photo.T_WC is None:
        return None
    shown = page_map(
        params,
        viewing_camera(run.sequence.camera, CANVAS_WIDTH, None),
        photo.T_WC,
        world_up(run.poses),
        birth_frames=None if draws_surface else mapper.gaussians.birth_frame,
        near_m=near_plane_m(mapper.config),
    )
    notes = []
    if draws_surface:
        notes += [
            f"This map is a surface that {len(mapper.gaussians):,} Gaussians correct.",
            "Here the surface is drawn as discs too, coarser than in the pictures below.",
        ]
    if shown.has_fewer:
        unit = "discs" if draws_surface else "Gaussians"
        kept = f"{shown.n:,} {unit} in this page, {shown.n_whole:,} before"
        notes.append(f"Like neighbours are joined: {kept}.")
    title = mapper.description.title
    return Opening(map=shown, title=title, photo=photo, notes=notes) if shown.n else None


def opening_values(openings: Sequence[Opening], caption: str) -> dict[str, Any]:
    """Maps and the photograph of the first one, as ``parts.html`` shows them.

    Args:
        openings: Of runs of the same recording, at least one.
        caption: Below the photograph.
    """
    photo = openings[0].photo
    return {
        "maps": [_map_values(opening) for opening in openings],
        "photo": page_picture(photo.rgb, caption, alt=f"{photo.name}, a photograph"),
        "controls": Markup(waiting_controls()),
        "script": Markup(page_script()),
        "style": Markup(page_style()),
    }


def _map_values(opening: Opening) -> dict[str, Any]:
    height, width = opening.map.poster.shape[:2]
    return {
        "src": data_uri(opening.map.poster),
        "width": width,
        "height": height,
        "alt": f"The map that {opening.title} made, seen from above without its ceiling",
        "data": Markup(opening.map.data),
        "title": opening.title,
        "notes": opening.notes,
        "has_timeline": opening.map.has_timeline,
    }
