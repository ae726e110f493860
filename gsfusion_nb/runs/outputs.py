"""The files a run writes: maps, trajectory, settings, metrics and a report, each file written
atomically."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from ..config import to_dict
from ..data import sequence_fingerprint
from ..drawing.shading import shaded_view
from ..evaluation import (
    metrics_as_json,
)
from ..export import write_gaussian_ply, write_mesh_ply, write_trajectory_tum
from ..files import write_file
from ..seeding import is_built_in, rule_name, rule_source
from ..seeding.code_files import RULE_MODULES, beside_sources, file_source
from ..tracking import PLACES, write_places
from ..types import Mesh
from .map_hashes import map_hashes
from .map_state import STATE, write_map_state
from .mapped_views import evenly
from .mapping_run import MappingRun
from .poses_in_map import frames_in_map
from .ran_on import ran_on
from .report import ReportData, write_report
from .report_map import opening_of
from .report_panel import ReportPanel
from .run_folder import METRICS, RULE
from .scored_views import VIEWS, scored_views, views_as_json
from .system_of_run import about_system, write_system

FILES = {
    "gaussians.ply": "The Gaussians, in the standard 3DGS layout: SuperSplat, antimatter15/splat, "
    "PlayCanvas, plug-ins of Blender and Unity",
    "extra.npz": "What each Gaussian, row for row, shows of the frames' further images: its label, "
    "or the mean of an image: numpy.load",
    "mesh.ply": "The surface of the TSDF, a coloured triangle mesh in metres: MeshLab, "
    "CloudCompare, Blender, pyvista.read",
    "tsdf.npz": "The coloured TSDF, in which gsfusion-nb locate finds a camera; GPS-SLAM draws its "
    "Gaussians over it, and gaussians.ply alone shows them over black",
    "places.npz": "What keyframes look like and where they were: gsfusion-nb locate finds another "
    "recording by them",
    "state.zip": "Keyframes and the rule's memory: gsfusion-nb map --onto goes on in this map",
    "trajectory.txt": "Poses, camera to world, TUM format: evo_traj tum trajectory.txt --plot",
    "trajectory_given.txt": "The poses before they were refined, if they were",
    "config.json": "All settings: gsfusion-nb map DATA --from-config config.json repeats the run",
    "metrics.json": "The numbers of this page, and a row for each frame: json.load",
    "rule.py": "Source of the seeding rule, if it is not part of the package: run_mapping(data, "
    "config, seeding=rule) repeats the run",
    "rule_modules": "Modules that rule.py imports from beside it",
    "system.py": "Source of the system, if it came from a file",
    "system_modules": "Modules that system.py imports from beside it",
    "views.json": "The scored views and their poses: gsfusion-nb eval scores exactly these again",
}
"""File of a run -> what it holds, and what opens it."""


def write_maps(run: MappingRun, folder: Path) -> Mesh:
    """Write both maps, the trajectory and the settings, before the evaluation.

    Raises:
        DiskFullError: The disk has no space for a file; those before it are written.
    """
    try:
        with run.clock("mesh"):
            mesh = run.mapper.mesh()
    except torch.OutOfMemoryError as e:
        mesh = Mesh(
            vertices_W=torch.zeros(0, 3),
            faces=torch.zeros(0, 3, dtype=torch.int64),
            rgb=torch.zeros(0, 3),
        )
        reason = str(e).splitlines()[0]
        run.warnings.note_ending(f"no mesh was made, because GPU memory was full: {reason}")
    with run.clock("writing"):
        _write_maps(run, folder, mesh)
    return mesh


def _write_maps(run: MappingRun, folder: Path, mesh: Mesh) -> None:
    run.hashes = map_hashes(run, mesh)
    settings = {
        "gsfusion_nb": __version__,
        **about_system(run.mapper),
        "source": run.source,
        "camera": dataclasses.asdict(run.sequence.mapping.camera),
        "data_content": sequence_fingerprint(run.sequence) if run.source else "",
        "device": str(run.mapper.device),
        "rule": rule_name(run.mapper.rule),
        "rule_from_file": bool(file_source(run.mapper.rule)),
        "fidelity": run.mapper.description.fidelity_of(run.mapper.config),
        "training": run.mapper.training.names,
        "config": to_dict(run.mapper.config),
        **({"onto": run.parent} if run.parent else {}),
    }
    write_json(folder / "config.json", settings)
    write_rule(run, folder)
    write_system(run.mapper, folder)
    write_json(folder / VIEWS, views_as_json(scored_views(run)))
    _write_trajectory(run, folder)
    write_gaussian_ply(folder / "gaussians.ply", run.mapper.parts.params_now())
    run.mapper.files.write_besides(folder)
    places = run.mapper.localiser.places()
    if places is not None:
        write_places(folder / PLACES, places)
    write_map_state(folder / STATE, run.mapper)
    write_mesh_ply(folder / "mesh.ply", mesh)


def write_rule(run: MappingRun, folder: Path) -> None:
    """Write the source of a seeding rule that is not part of the package; it is needed to repeat
    the run.

    Of a rule that was given as FILE.py:name it is the whole file, with the modules that it imports
    from beside it, which a resumed run uses.
    """
    rule = run.mapper.rule
    if not is_built_in(rule):
        unknown = "# unknown: the rule was not defined in a file or a notebook cell"
        write_file(folder / RULE, file_source(rule) or rule_source(rule) or unknown)
        for name, content in beside_sources(rule).items():
            write_file(folder / RULE_MODULES / name, content)


def _write_trajectory(run: MappingRun, folder: Path) -> None:
    if run.poses:
        write_trajectory_tum(folder / "trajectory.txt", run.timestamps_s, torch.stack(run.poses))
    trajectory = run.mapper.trajectory
    if trajectory.is_refined:
        write_trajectory_tum(
            folder / "trajectory_given.txt",
            run.timestamps_s,
            torch.stack(trajectory.given_poses[run.n_earlier :]),
        )


def write_numbers(
    run: MappingRun,
    folder: Path,
    metrics: dict[str, Any],
    status: str = "",
) -> None:
    """Write metrics.json: status (by default that of the run), warnings, a hash of each map, the
    metrics, the processor time of each stage, and a row per frame.
    """
    rows = [
        vars(s) | {"losses": list(s.losses), "total_seconds": s.total_seconds} for s in run.steps
    ]
    document = {
        "status": status or run.status,
        "warnings": run.warnings,
        "sha256": run.hashes,
        "ran_on": ran_on(run.mapper.device),
        **({"onto": run.parent} if run.parent else {}),
        "metrics": metrics_as_json(metrics),
        "processor_seconds": run.clock.cpu_seconds,
        "frames": rows,
    }
    write_json(folder / METRICS, document)


def write_page(
    run: MappingRun,
    folder: Path,
    metrics: dict[str, Any],
    mesh: Mesh,
) -> ReportData:
    """Write report.html, and return what it shows.

    Args:
        run: When its maps are complete.
        folder: Of the run.
        metrics: Numbers to show.
        mesh: Of the run.
    """
    fidelity = run.mapper.description.fidelity_of(run.mapper.config)
    config = run.mapper.config
    about = [
        f"{len(run.steps)} frames",
        f"SH degree {config.sh_degree}",
        *(f"{kind} {name}" for kind, name in run.mapper.training.names.items()),
        f"rule {rule_name(run.mapper.rule)}",
        *([f"in the map of {Path(run.parent['run']).name}"] if run.parent else []),
    ]
    views = report_views(run)
    data = ReportData(
        title=f"{run.mapper.description.title} on {run.sequence.name}",
        about=_about(run),
        opening=opening_of(run, views, mesh),
        subtitle=", ".join([*about, f"fidelity {fidelity}"] if fidelity else about),
        metrics=metrics,
        config=to_dict(config),
        frames=run.steps,
        states=run.mapper.description.states,
        global_losses=run.global_passes.losses,
        views=views,
        mesh_pictures=mesh_pictures(run),
        warnings=_headline_warnings(run),
        environment=ran_on(run.mapper.device) | {"threads": str(torch.get_num_threads())},
        files={name: text for name, text in FILES.items() if (folder / name).exists()},
    )
    write_report(folder / "report.html", data)
    return data


def _about(run: MappingRun) -> str:
    """What a run did, in a sentence without terms of the field."""
    return (
        f"A camera gave {len(run.steps)} pictures, each in colour and with the distance of every "
        f"point. {run.mapper.description.title} made a map of {len(run.mapper.gaussians):,} small "
        "soft discs of colour from them, 3D Gaussians, which shows the place from any side."
    )


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically; NaN and infinity, which JSON does not have,
    become text."""
    write_file(path, json.dumps(_strict(value), indent=1, allow_nan=False))


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _strict(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(v) for v in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def report_views(run: MappingRun) -> list[ReportPanel]:
    """A few held-out and mapped views: input image and render."""
    panels = []
    map_views = run.views.sample(1000)
    map_views = dataclasses.replace(
        map_views, positions=[map_views.positions[i] for i in evenly(len(map_views), 3)]
    )
    held_out_frames = scored_views(run)["held_out"].spread(3).frames(run.sequence)
    mapped_frames = frames_in_map(map_views, run.mapper.localiser, run.sequence.mapping)
    for frames, held_out in ((held_out_frames, True), (mapped_frames, False)):
        for frame in frames:
            output = run.mapper.render(frame.camera, frame.T_WC)
            panels.append(
                ReportPanel.of(
                    frame, output, held_out=held_out, cells=run.mapper.files.quadtree_cells(frame)
                )
            )
    return panels


def mesh_pictures(run: MappingRun) -> dict[str, torch.Tensor]:
    """The surface seen from two mapped views: in its colours, and grey."""
    pictures = {}
    poses = run.poses
    for i, T_WC in enumerate([poses[0], poses[-1]] if poses else []):
        T_WC = T_WC.to(run.mapper.device)
        surface = run.mapper.surface(run.sequence.camera, T_WC)
        normal_C = surface.normal_W @ T_WC[:3, :3]
        is_seen = surface.depth_m > 0
        colour = shaded_view(normal_C, is_seen, surface.rgb.clamp(0, 1))
        pictures[f"colour, view {i + 1}"] = colour.cpu()
        pictures[f"shape, view {i + 1}"] = shaded_view(normal_C, is_seen).cpu()
    return pictures


def _headline_warnings(run: MappingRun, most: int = 10) -> list[str]:
    """The first warnings, and the number of further ones."""
    if len(run.warnings) <= most:
        return run.warnings
    return [*run.warnings[:most], f"and {len(run.warnings) - most} more; all are in metrics.json"]
