"""What a run is worth: scores of its views, mesh and trajectory; its sizes, speed and memory."""

import sys
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import torch

from ..data.adjust.repair import as_read
from ..evaluation import (
    NotComputed,
    centres_to_own_mesh,
    cull_unseen,
    disc_scores,
    frame_rates,
    mesh_psnr,
    mesh_scores,
    trajectory_scores,
)
from ..gaussians import PLY_BYTES
from ..mapping.moved_surfaces import MovedSurfaces
from ..types import Mesh
from .mapping_run import MappingRun
from .poses_in_map import ground_truth_poses, readable_frames
from .scored_views import score_in_map, scored_views

SURFACE_SAMPLES = 200_000
"""Number of points sampled on each of the two surfaces that are compared."""

MESH_VIEWS = 50
"""At most this many held-out views are compared with the mesh, spread evenly."""


def score(
    run: MappingRun,
    suffix: str = "",
    *,
    with_lpips: bool = False,
) -> dict[str, Any]:
    """PSNR, SSIM, LPIPS and depth error of the current map on mapped and held-out views."""
    params = run.mapper.parts.params_now()
    mapper = run.mapper
    with run.clock("view_scores"):
        draw = mapper.files.drawn_as_stored()
        aligns = mapper.config.data.align_held_out and not suffix
        align = None
        if aligns:
            align = partial(mapper.files.aligned_pose, draw, params, config=mapper.config)
        views = scored_views(run)
        metrics = score_in_map(
            draw, views, run.sequence, suffix, with_lpips=with_lpips, align=align
        )
    for sentence in nan_views(metrics, [f"{name}{suffix}" for name in views]):
        if suffix:  # of the map before the passes, which is scored once
            run.warnings.warn_once(sentence)
        else:
            run.warnings.note_ending(sentence)
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


def map_metrics(run: MappingRun, mesh: Mesh) -> dict[str, Any]:
    """Sizes, speed and memory."""
    seconds = [s.total_seconds for s in run.steps]
    return {
        "n_gaussians": len(run.mapper.gaussians),
        "n_not_finite": run.mapper.lost.total,
        "model_size_mb": PLY_BYTES * len(run.mapper.gaussians) / 1e6,
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
        **({} if run.moved is None or run.moved.keeps else moved_metrics(run.moved)),
        "seconds_online": sum(seconds),
        "seconds_global": run.global_passes.seconds,
        "peak_memory_mb": peak_memory_mb(run.mapper.device),
    }


def moved_metrics(moved: MovedSurfaces) -> dict[str, int]:
    """What was taken out of the map of an earlier run."""
    return {
        "n_voxels_moved": moved.n_voxels,
        "n_gaussians_moved": moved.n_gaussians,
        "n_keyframes_moved": moved.n_keyframes,
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
    trajectory = run.mapper.trajectory
    has_moved = localiser.is_tracking or trajectory.is_refined
    poses = run.poses
    frame_indices = trajectory.frame_indices[run.n_earlier :]
    truth = ground_truth_poses(frame_indices, run.sequence.mapping) if has_moved else None
    if truth is None or len(poses) < 3:
        return {}
    scores = trajectory_scores(torch.stack(poses), truth)
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
    truth = getattr(as_read(run.sequence.source), "mesh", None)
    if truth is None:
        return metrics
    n_samples = n_samples or SURFACE_SAMPLES
    visible_surface = cull_unseen(truth(), readable_frames(run.views.covering(50)))
    generator = torch.Generator().manual_seed(run.mapper.config.seed if seed is None else seed)
    scores = mesh_scores(mesh, visible_surface, generator=generator, n_samples=n_samples)
    metrics |= _named("mesh", scores)
    if run.mapper.description.gaussians_are_discs:
        discs = run.mapper.parts.params_now()
        scores = disc_scores(discs, visible_surface, generator=generator, n_samples=n_samples)
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
    distance = centres_to_own_mesh(mapper.parts.params_now(), mesh, generator=generator)
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
