"""What a notebook shows for an object in the last line of a cell: a small picture beside the most important numbers."""

from typing import Any

import numpy as np
import torch
from markupsafe import Markup

from ..drawing.page import fill
from ..drawing.pictures import (
    Picture,
    colour_depth,
    data_uri,
    depth_range_m,
    fit_width,
    paint_cells,
    side_by_side,
    to_uint8,
)
from ..gaussians import GaussianModel
from ..runs import FinishedRun, MappingRun
from ..runs.scored_views import frames_in_map
from ..seeding import Cells
from ..tsdf import TsdfVolume
from ..types import Frame
from .map_pictures import map_picture
from .panels.tsdf import slice_picture
from .viewpoint import places_of, viewing_camera

WIDTH_PX = 240
"""Width of one picture."""
_MOST_DRAWN = 200_000
"""The picture of a map shows at most this many Gaussians, evenly picked."""


def html_summary(thing: Any) -> str:
    """HTML of a frame, a TSDF volume, quadtree cells, a Gaussian map, or a run; Jupyter calls it.

    Raises:
        TypeError: there is no summary for an object of this type.
    """
    for kind, make in _SUMMARIES.items():
        if isinstance(thing, kind):
            picture, rows = make(thing)
            image = "" if picture is None else data_uri(picture)
            return fill("summary.html", title=type(thing).__name__, picture=image, rows=rows)
    raise TypeError(
        f"no summary for {type(thing).__name__}; there are summaries for {', '.join(k.__name__ for k in _SUMMARIES)}"
    )


def _frame(frame: Frame) -> tuple[Picture, dict[str, str]]:
    depth_m, known = frame.depth_m.cpu(), frame.depth_m.cpu() > 0
    near, far = depth_range_m(depth_m)
    x, y, z = frame.T_WC[:3, 3].tolist()
    c = frame.camera
    return side_by_side(
        [fit_width(frame.colour.cpu(), WIDTH_PX), fit_width(colour_depth(depth_m, near, far), WIDTH_PX)]
    ), {
        "frame": f"{frame.index}, at {frame.timestamp_s:.3f} s",
        "size": f"{c.width} × {c.height}, focal length {c.fx:.1f}, {c.fy:.1f} px",
        "depth": f"{near:.2f} to {far:.2f} m (blue to red), {100 * float(known.float().mean()):.0f} % of the pixels",
        "camera at": f"({x:.2f}, {y:.2f}, {z:.2f}) m",
    }


def _volume(volume: TsdfVolume) -> tuple[Picture | None, dict[str, str]]:
    config = volume.config
    rows = {
        "voxel": f"{config.voxel_size_m * 100:g} cm, truncation {config.truncation_m * 100:g} cm",
        "blocks of 8³ voxels": f"{volume.n_blocks:,}",
        "memory": f"{volume.memory_bytes / 1e6:.1f} MB on {volume.device}",
    }
    if not volume.n_blocks:
        return None, rows | {"extent": "empty"}
    low, high = ((volume.block_coords.cpu() + i).float() * volume.block_size_m for i in (0, 1))
    low, high = low.amin(0), high.amax(0)
    size = high - low
    middle_m = float(volume.block_coords[:, 2].float().median() + 0.5) * volume.block_size_m
    picture = slice_picture(
        volume,
        height_m=middle_m,
        x_m=(float(low[0]), float(high[0])),
        y_m=(float(low[1]), float(high[1])),
        px_per_m=WIDTH_PX / float(size[:2].max()),
    )
    extent = " × ".join(f"{float(s):.2f}" for s in size)
    return picture, rows | {
        "extent": f"{extent} m",
        "picture": f"TSDF at z = {middle_m:.2f} m: blue free, red behind a surface, striped unobserved",
    }


def _cells(cells: Cells) -> tuple[Picture | None, dict[str, str]]:
    levels, counts = cells.level.unique(return_counts=True)
    rows = {"cells": f"{len(cells):,}"} | {
        f"level {level}": f"{count:,}" for level, count in zip(levels.tolist(), counts.tolist(), strict=True)
    }
    if not len(cells):
        return None, rows
    width, height = (int((a + b).max()) for a, b in ((cells.x0, cells.width), (cells.y0, cells.height)))
    blank = np.full((height, width, 3), 245, np.uint8)
    return fit_width(paint_cells(blank, cells, strength=1.0), 2 * WIDTH_PX), rows


def _gaussians(model: GaussianModel) -> tuple[Picture | None, dict[str, str]]:
    rows = {
        "Gaussians": f"{len(model):,}, SH degree {model.sh_degree}",
        "as PLY": f"{model.size_bytes / 1e6:.1f} MB",
    }
    if not len(model):
        return None, rows
    params = model.params[:: 1 + (len(model) - 1) // _MOST_DRAWN]
    camera = viewing_camera(None, WIDTH_PX, WIDTH_PX * 3 // 4)
    pose = places_of(params, camera, None, torch.tensor([0.0, 0.0, 1.0]))["photo"].T_WC
    size_cm, opacity = 100 * model.scale_m.median(), model.opacity.median()
    return map_picture(params, camera, pose.to(model.device)), rows | {
        "median": f"standard deviation {float(size_cm):.2f} cm, opacity {float(opacity):.2f}",
        "added": f"in frames {int(model.birth_frame.min())} to {int(model.birth_frame.max())}",
        "picture": "seen from 35 degrees above",
    }


def _run(run: MappingRun) -> tuple[Picture | None, dict[str, str]]:
    mapper, steps = run.mapper, run.steps
    rows = {"system": run.system, "frames": f"{len(steps):,} mapped, {len(run.warnings)} warnings"}
    fidelity = mapper.fidelity_of(mapper.config)
    rows |= {"fidelity": fidelity} if fidelity else {}
    if not steps:
        return None, rows
    seconds = sum(s.total_seconds for s in steps)
    rows |= {
        "Gaussians": f"{len(mapper.gaussians):,}",
        "keyframes": f"{sum(s.is_keyframe for s in steps):,}",
        "speed": f"{len(steps) / max(seconds, 1e-9):.1f} frames/s while mapping",
    }
    return _photo_and_render(run), rows


def _finished(finished: FinishedRun) -> tuple[Picture | None, dict[str, str]]:
    picture, rows = _run(finished.run)
    names = {
        "psnr_held_out_db": ("PSNR, held-out views", "{:.2f} dB"),
        "psnr_mapped_db": ("PSNR, mapped views", "{:.2f} dB"),
        "mesh_accuracy_m": ("mesh to the true surface", "{:.4f} m"),
        "ate_rmse_m": ("ATE RMSE", "{:.4f} m"),
    }
    for key, (label, form) in names.items():
        value = finished.metrics.get(key)
        if isinstance(value, (int, float)):
            rows[label] = form.format(value)
    return picture, rows | {"files": Markup("<code>{}</code>").format(finished.folder)}


def _photo_and_render(run: MappingRun) -> Picture | None:
    """The last frame beside the map rendered from its pose; None if the frame cannot be read again."""
    frames = list(frames_in_map(run.mapped_views(2), run.mapper.localiser, run.sequence.mapping))
    if not frames:
        return None
    frame = frames[-1]
    rendered = run.mapper.render(frame.camera, frame.T_WC.to(run.mapper.device)).rgb
    return side_by_side([fit_width(to_uint8(image), WIDTH_PX) for image in (frame.colour, rendered)])


_SUMMARIES: dict[type, Any] = {
    Frame: _frame,
    TsdfVolume: _volume,
    Cells: _cells,
    GaussianModel: _gaussians,
    MappingRun: _run,
    FinishedRun: _finished,
}
