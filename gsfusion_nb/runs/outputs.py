"""The files a run writes: maps, trajectory, settings, metrics and a report, each file written
atomically."""

import dataclasses
import hashlib
import json
import math
import platform
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import __version__
from ..config import to_dict
from ..data import sequence_fingerprint
from ..evaluation import (
    NotComputed,
    centres_to_own_mesh,
    cull_unseen,
    disc_scores,
    frame_rates,
    mesh_psnr,
    mesh_scores,
    metrics_as_json,
    trajectory_scores,
)
from ..export import write_gaussian_ply, write_mesh_ply, write_trajectory_tum
from ..files import write_file
from ..resources import MAP_MEMORY
from ..seeding import is_built_in, rule_name, rule_source
from ..seeding.rule_code import RULE_MODULES, beside_sources, file_source
from ..types import Mesh
from .mapping_run import MappingRun, evenly
from .ran_on import ran_on
from .report import ReportData, ReportView, write_report
from .run_folder import METRICS, RULE
from .scored_views import (
    VIEWS,
    frames_in_map,
    ground_truth_poses,
    readable_frames,
    score_in_map,
    scored_views,
    views_as_json,
)

FILES = {
    "gaussians.ply": "Gaussian map, standard 3DGS layout: SuperSplat, antimatter15/splat, Blender "
    "and Unity plug-ins",
    "mesh.ply": "TSDF surface with vertex colours: MeshLab, Blender, CloudCompare",
    "tsdf.npz": "the coloured TSDF that GPS-SLAM draws its Gaussians over; gaussians.ply alone "
    "shows them over black",
    "trajectory.txt": "poses, TUM format: evo_traj tum trajectory.txt",
    "trajectory_given.txt": "the poses before they were refined, if they were",
    "config.json": "all settings: gsfusion-nb map --from-config config.json repeats the run",
    "metrics.json": "all metrics, and one row per frame",
    "rule.py": "source of the seeding rule, if it is not part of the package",
    "rule_modules": "modules that rule.py imports from beside it",
    "views.json": "the scored views and their poses: gsfusion-nb eval scores them again",
}

SURFACE_SAMPLES = 200_000
"""Number of points sampled on each of the two surfaces that are compared."""

_ROWS_AT_A_TIME = 8192
"""Of a map that is hashed, which limits the memory."""

MESH_VIEWS = 50
"""At most this many held-out views are compared with the mesh, spread evenly."""


def score(
    run: MappingRun,
    suffix: str = "",
    *,
    with_lpips: bool = False,
) -> dict[str, Any]:
    """PSNR, SSIM, LPIPS and depth error of the current map on mapped and held-out views."""
    params = run.mapper.params_now()
    mapper = run.mapper
    with run.clock("view_scores"):
        draw = mapper.files.drawn_as_stored()
        wanted = mapper.config.data.align_held_out and not suffix
        align = (lambda frame: mapper.files.aligned_pose(draw, params, frame)) if wanted else None
        views = scored_views(run)
        metrics = score_in_map(
            draw, views, run.sequence, suffix, with_lpips=with_lpips, align=align
        )
    for sentence in nan_views(metrics, [f"{name}{suffix}" for name in views]):
        if suffix:  # of the map before the passes, which is scored once
            run.warn_once(sentence)
        else:
            run.note_ending(sentence)
    return metrics


def nan_views(
    metrics: Mapping[str, Any],
    groups: Iterable[str],
) -> list[str]:
    """A sentence for each group of views of which some are not numbers."""
    counts = {group: metrics.get(f"n_views_nan_{group}", 0) for group in groups}
    return [
        f"{n:.0f} of the views {group} have a render with a NaN: no mean of scores counts them"
        for group, n in counts.items()
        if n
    ]


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
        run.note_ending(f"no mesh was made, because GPU memory was full: {str(e).splitlines()[0]}")
    with run.clock("writing"):
        _write_maps(run, folder, mesh)
    return mesh


def _write_maps(run: MappingRun, folder: Path, mesh: Mesh) -> None:
    run.hashes = map_hashes(run, mesh)
    settings = {
        "gsfusion_nb": __version__,
        "system": run.system,
        "source": run.source,
        "camera": dataclasses.asdict(run.sequence.mapping.camera),
        "data_content": sequence_fingerprint(run.sequence) if run.source else "",
        "device": str(run.mapper.device),
        "rule": rule_name(run.mapper.rule),
        "rule_from_file": bool(file_source(run.mapper.rule)),
        "fidelity": run.mapper.description.fidelity_of(run.mapper.config),
        "training": run.mapper.training.names,
        "config": to_dict(run.mapper.config),
    }
    write_json(folder / "config.json", settings)
    write_rule(run, folder)
    write_json(folder / VIEWS, views_as_json(scored_views(run)))
    _write_trajectory(run, folder)
    write_gaussian_ply(folder / "gaussians.ply", run.mapper.params_now())
    run.mapper.files.write_besides(folder)
    write_mesh_ply(folder / "mesh.ply", mesh)


def map_hashes(run: MappingRun, mesh: Mesh | None = None) -> dict[str, str]:
    """SHA-256 of each map of a run, by name: "gaussians", "trajectory", "tsdf" if the system has
    one, and "mesh" if it is given; it follows from the others."""
    trajectory = {
        "frame_index": torch.tensor(run.mapper.localiser.frame_indices, dtype=torch.int64),
        "T_WC": torch.stack(run.mapper.localiser.poses)
        if run.mapper.localiser.poses
        else torch.zeros(0, 4, 4),
    }
    maps = (
        run.mapper.files.maps()
        | {"trajectory": trajectory}
        | ({} if mesh is None else {"mesh": vars(mesh)})
    )
    return {
        name: hash_of(tensors, run.mapper.files.order_of_rows(name))
        for name, tensors in maps.items()
    }


def hash_of(tensors: Mapping[str, Tensor], order: Tensor | None = None) -> str:
    """SHA-256 of named tensors, sorted by name. Of each tensor the name, type and shape are hashed
    as text, then its numbers, row by row, in little-endian byte order; ``order``: row numbers, if
    not as they are."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(
            f"{name} {str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}\n".encode()
        )
        rows = (tensor if order is None else order).split(_ROWS_AT_A_TIME)
        for part in rows if order is None else (tensor[places] for places in rows):
            values = part.detach().cpu().contiguous().numpy()
            digest.update(
                values.astype(values.dtype.newbyteorder("<"), copy=False)
                .reshape(-1)
                .view("uint8")
                .data
            )
            MAP_MEMORY.give_back()
    return digest.hexdigest()


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
    localiser = run.mapper.localiser
    if localiser.is_refined:
        write_trajectory_tum(
            folder / "trajectory_given.txt", run.timestamps_s, torch.stack(localiser.given)
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
        "metrics": metrics_as_json(metrics),
        "processor_seconds": run.clock.cpu_seconds,
        "frames": rows,
    }
    write_json(folder / METRICS, document)


def write_page(run: MappingRun, folder: Path, metrics: dict[str, Any]) -> Path:
    """Write report.html."""
    fidelity = run.mapper.description.fidelity_of(run.mapper.config)
    config = run.mapper.config
    about = [
        f"{len(run.steps)} frames",
        f"SH degree {config.sh_degree}",
        *(f"{kind} {name}" for kind, name in run.mapper.training.names.items()),
        f"rule {rule_name(run.mapper.rule)}",
    ]
    data = ReportData(
        title=f"{run.mapper.description.title} on {run.sequence.name}",
        subtitle=", ".join([*about, f"fidelity {fidelity}"] if fidelity else about),
        metrics=metrics,
        config=to_dict(config),
        frames=run.steps,
        states=run.mapper.description.states,
        global_losses=run.global_losses,
        views=report_views(run),
        mesh_pictures=mesh_pictures(run),
        warnings=_headline_warnings(run),
        environment=ran_on(run.mapper.device) | {"threads": str(torch.get_num_threads())},
        files={name: text for name, text in FILES.items() if (folder / name).exists()},
    )
    return write_report(folder / "report.html", data)


def map_metrics(run: MappingRun, mesh: Mesh) -> dict[str, Any]:
    """Sizes, speed and memory."""
    seconds = [s.total_seconds for s in run.steps]
    return {
        "n_gaussians": len(run.mapper.gaussians),
        "n_not_finite": run.mapper.lost.total,
        "model_size_mb": run.mapper.gaussians.size_bytes / 1e6,
        "n_keyframes": sum(s.is_keyframe for s in run.steps),
        "n_frames": len(run.steps),
        **run.mapper.reports.counts(),
        **run.mapper.reports.run_metrics(run.steps),
        **run.mapper.training.names,
        "n_triangles": len(mesh.faces),
        **({} if run.mapper.mesh_share is None else {"mesh_share": run.mapper.mesh_share}),
        **frame_rates(seconds),
        **tracking_rates(run),
        **run.extra_metrics(),
        "seconds_online": sum(seconds),
        "seconds_global": run.seconds_global,
        "peak_memory_mb": peak_memory_mb(run.mapper.device),
    }


def tracking_rates(run: MappingRun) -> dict[str, float]:
    """Frames per second of tracking alone and of mapping alone; empty if poses were not tracked."""
    tracking = sum(s.seconds.get("tracking", 0.0) for s in run.steps)
    if not run.mapper.localiser.is_tracking or not tracking:
        return {}
    mapping = sum(s.total_seconds for s in run.steps) - tracking
    return {
        "fps_tracking": len(run.steps) / tracking,
        "fps_mapping": len(run.steps) / max(mapping, 1e-9),
    }


def score_trajectory(run: MappingRun) -> dict[str, Any]:
    """Absolute trajectory error of tracked or refined poses against the true ones, where the data
    knows them, else the data's own; empty if no pose moved, or there are none to compare."""
    localiser = run.mapper.localiser
    moved = localiser.is_tracking or localiser.is_refined
    truth = ground_truth_poses(localiser, run.sequence.mapping) if moved else None
    if truth is None or len(localiser.poses) < 3:
        return {}
    scores = trajectory_scores(torch.stack(localiser.poses), truth)
    if not localiser.is_tracking:
        return scores
    status = [s.tracking.get("status") for s in run.steps]
    return scores | {
        "n_recovered": status.count("recovered"),
        "n_degenerate": status.count("degenerate"),
    }


def score_mesh(
    run: MappingRun,
    mesh: Mesh,
    *,
    seed: int | None = None,
    n_samples: int | None = None,
) -> dict[str, Any]:
    """PSNR of the mesh's vertices at held-out views, at most ``MESH_VIEWS`` of them; and if
    ``source.mesh()`` gives the true surface, accuracy and completion of the mesh and of RTG-SLAM's
    discs.

    Only the part of the true surface that the mapped frames saw is compared.

    Args:
        run: The run.
        mesh: Its mesh.
        seed: Of the points that are drawn on the surfaces; the seed of the run by default.
        n_samples: Number of points drawn on each surface; ``SURFACE_SAMPLES`` by default.
    """
    if not len(mesh.faces):
        return {}
    held_out = scored_views(run)["held_out"].spread(MESH_VIEWS)
    metrics: dict[str, Any] = {}
    if len(held_out.positions):
        metrics["mesh_psnr_held_out_db"] = mesh_psnr(mesh, held_out.frames(run.sequence))
    truth = getattr(run.sequence.source, "mesh", None)
    if truth is None:
        return metrics
    n_samples = n_samples or SURFACE_SAMPLES
    seen = cull_unseen(truth(), readable_frames(run.covering_views(50)))
    generator = torch.Generator().manual_seed(run.mapper.config.seed if seed is None else seed)
    scores = mesh_scores(mesh, seen, generator=generator, n_samples=n_samples)
    metrics |= _named("mesh", scores)
    if run.mapper.description.gaussians_are_discs:
        discs = run.mapper.params_now()
        scores = disc_scores(discs, seen, generator=generator, n_samples=n_samples)
        metrics |= _named("disc", scores)
    return metrics


def _named(
    what: str,
    scores: dict[str, float] | NotComputed,
) -> dict[str, Any]:
    """Scores of a surface with the names of the metrics table."""
    if isinstance(scores, NotComputed):
        return {f"{what}_accuracy_m": scores}
    return {f"{what}_{name}": value for name, value in scores.items()}


def score_centres(run: MappingRun, mesh: Mesh) -> dict[str, Any]:
    """Distance of the Gaussian centres from the run's own mesh; empty for discs, which the mesh is
    made from."""
    mapper = run.mapper
    if mapper.description.gaussians_are_discs:
        return {}
    generator = torch.Generator().manual_seed(mapper.config.seed)
    distance = centres_to_own_mesh(mapper.params_now(), mesh, generator=generator)
    names = ("centres_to_own_mesh_m", "centres_to_own_mesh_m2")
    return (
        {names[0]: distance}
        if isinstance(distance, NotComputed)
        else dict(zip(names, distance, strict=True))
    )


def peak_memory_mb(device: torch.device) -> float | NotComputed:
    """Peak memory so far, MB: of the GPU if the maps are there, else resident memory of the
    process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    try:
        import resource
    except ImportError:
        return NotComputed("this operating system does not report it")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def environment() -> dict[str, str]:
    """Versions and threads of this process."""
    return {
        "gsfusion_nb": __version__,
        "Python": platform.python_version(),
        "PyTorch": torch.__version__,
        "threads": str(torch.get_num_threads()),
        "system": f"{platform.system()} {platform.machine()}",
    }


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


def report_views(run: MappingRun) -> list[ReportView]:
    """A few held-out and mapped views: input image and render."""
    panels = []
    mapped = run.mapped_views(1000)
    mapped = dataclasses.replace(
        mapped, positions=[mapped.positions[i] for i in evenly(len(mapped), 3)]
    )
    held_out_frames = scored_views(run)["held_out"].spread(3).frames(run.sequence)
    mapped_frames = frames_in_map(mapped, run.mapper.localiser, run.sequence.mapping)
    for frames, held_out in ((held_out_frames, True), (mapped_frames, False)):
        for frame in frames:
            rendered = run.mapper.render(frame.camera, frame.T_WC)
            panels.append(
                ReportView.of(
                    frame, rendered, held_out=held_out, cells=run.mapper.files.quadtree_cells(frame)
                )
            )
    return panels


def mesh_pictures(run: MappingRun) -> dict[str, torch.Tensor]:
    """The surface seen from two mapped views: in colour, and grey, lit from the camera."""
    pictures = {}
    poses = run.poses
    for i, T_WC in enumerate([poses[0], poses[-1]] if poses else []):
        T_WC = T_WC.to(run.mapper.device)
        seen = run.mapper.surface(run.sequence.camera, T_WC)
        towards = -(seen.normal_W * T_WC[:3, 2]).sum(-1)  # cosine to the optical axis
        shaded = (0.15 + 0.85 * towards.clamp(0, 1)) * (seen.depth_m > 0)
        pictures[f"colour, view {i + 1}"] = seen.rgb.clamp(0, 1).cpu()
        pictures[f"shape, view {i + 1}"] = shaded[..., None].expand(-1, -1, 3).cpu()
    return pictures


def _headline_warnings(run: MappingRun, most: int = 10) -> list[str]:
    """The first warnings, and the number of further ones."""
    if len(run.warnings) <= most:
        return run.warnings
    return [*run.warnings[:most], f"and {len(run.warnings) - most} more; all are in metrics.json"]
