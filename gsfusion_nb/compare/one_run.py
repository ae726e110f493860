"""One run of the lab: reach the budget, map, score. The result follows from the spec alone."""

import dataclasses
import hashlib
import json
import math
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..data import frame_fingerprints, sequence_fingerprint
from ..drawing.encoding import encode_png
from ..errors import SequenceError
from ..evaluation import NotComputed, frame_rates
from ..evaluation.learned_distance import lpips_unavailable
from ..files import write_file
from ..gaussians import PLY_BYTES
from ..runs import MappingRun
from ..runs.map_hashes import map_hashes
from ..runs.ran_on import environment
from ..runs.scored_views import ScoredViews, scored_views
from ..runs.scores import (
    nan_views,
    score_mesh,
    score_trajectory,
    tracking_rates,
)
from ..seeding import published_training, rule_source
from .map_scene import Entry, Mapped, OnStep, budgeted, finished, map_scene
from .program import libraries, program_in_words
from .run_result import RunResult
from .spec import Budget, RunSpec
from .tune import is_tuned, tune, tuning_spec, with_tuned

MOST_PICTURES = 3
"""Held-out views of which pictures are saved."""
SURFACE_SAMPLES = 50_000
"""Points drawn on each of the two surfaces; with a quarter of those of a single run the numbers
differ by 1 %."""
MOST_MESHES = 100
_scored_meshes: dict[str, dict[str, Any]] = {}
"""Hashes of the maps that a mesh follows from and of the frames -> its scores."""


def run_spec(spec: RunSpec, folder: Path | None = None) -> RunResult:
    """Run ``spec`` and score it; the same on any machine that has the data, with the same programs.

    Args:
        spec: The run.
        folder: Where pictures of some held-out views are saved; None saves none.

    Returns:
        The result; a rule, or data, that raises an error gives a failed one with the reason.
    """
    return run_entry(Entry(spec=spec), folder)


def run_entry(
    entry: Entry,
    folder: Path | None = None,
    tuned: Mapping[str, Any] | None = None,
    on_step: OnStep = lambda report: None,
) -> RunResult:
    """``run_spec`` of a run that has objects of this process.

    A run that misses its number of Gaussians, because its seed differs from that of the tuning, is
    tuned once more with its own seed.

    Args:
        entry: The run.
        folder: Where pictures are saved; None saves none.
        tuned: What ``tune`` found for ``tuning_spec(entry.spec)``; it is tuned here if None.
        on_step: Called with the report of each frame of the scored run, and with None after other
            work.
    """
    try:
        budget = entry.spec.budget
        if is_tuned(entry.spec) and tuned is None:
            tuned = tune(dataclasses.replace(entry, spec=tuning_spec(entry.spec)), on_step)
        map_run = _map(entry, tuned, on_step)
        if tuned is not None and _error(map_run, budget) > budget.tolerance:
            second_tuning = tune(with_tuned(entry, tuned), on_step)
            tuned = second_tuning | {"n_runs": second_tuning["n_runs"] + tuned["n_runs"]}
            map_run = _map(entry, tuned, on_step)
        on_step(None)
        errors = {} if tuned is None else {"error_percent": 100 * _error(map_run, budget)}
        return _result(entry, map_run, {**(tuned or {}), **errors}, folder)
    except Exception as e:  # a user's rule may raise anything
        return RunResult(spec=entry.spec, status="failed", reason=f"{type(e).__name__}: {e}")


def _map(
    entry: Entry,
    tuned: Mapping[str, Any] | None,
    on_step: OnStep,
) -> Mapped:
    sized_entry = with_tuned(entry, tuned)
    return finished(map_scene(sized_entry, budgeted(sized_entry.spec)), on_step)


def _result(
    entry: Entry,
    map_run: Mapped,
    tuned: dict[str, Any],
    folder: Path | None,
) -> RunResult:
    views = scored_views(map_run.run)
    run = map_run.run
    content = (
        entry.spec.content if entry.sequence is not None else sequence_fingerprint(run.sequence)
    )
    if content != entry.spec.content:
        raise SequenceError(
            f"the files of {entry.spec.data} are not those for which this comparison was made: "
            "they changed, or this machine has others; start the comparison again"
        )
    with_lpips = lpips_unavailable() is None
    scores = {
        name: group.scores(run.mapper.render, run.sequence, with_lpips=with_lpips)
        for name, group in views.items()
    }
    numbers: dict[str, Any] = dict(map_run.online)
    for name, group in scores.items():
        numbers |= group.as_metrics(name)
    hashes = map_hashes(run)
    numbers |= _mesh_numbers(run, hashes, content) | score_trajectory(run) | _costs(map_run)
    numbers |= run.mapper.reports.run_metrics(run.steps)
    if entry.spec.online:
        numbers |= frame_rates([s.total_seconds for s in run.steps]) | tracking_rates(run)
    metrics = {
        name: float(value) for name, value in numbers.items() if not isinstance(value, NotComputed)
    }
    return RunResult(
        spec=entry.spec,
        status="done",
        metrics={name: value for name, value in metrics.items() if math.isfinite(value)},
        tuned=tuned,
        notes=[
            *map_run.notes,
            *run.mapper.reports.run_notes(run.steps),
            *_not_counted(metrics, scores),
        ],
        map_hash=hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest(),
        data_hash=content,
        frames=frame_fingerprints(run.sequence),
        rule_source=entry.spec.rule_source or rule_source(entry.found_rule()),
        training=_training(entry),
        image_size=f"{run.sequence.camera.width}x{run.sequence.camera.height}",
        versions=versions(),
        pictures=_pictures(entry, map_run, views["held_out"], folder, content)
        if folder is not None
        else {},
    )


def _training(entry: Entry) -> str:
    """``published_training`` of the rule, unless this run follows it: the system of that name, or
    its own steps."""
    spec = entry.spec
    rule = entry.found_rule()
    own_steps = any("iterations" in name for name in getattr(rule, "overrides", {}))
    if spec.rule_name == spec.system_name or (own_steps and spec.budget.steps == "own"):
        return ""
    return published_training(rule)


def _not_counted(
    metrics: Mapping[str, float],
    groups: Iterable[str],
) -> list[str]:
    """Sentences on views that no mean counts, of these groups, and on numbers that a result cannot
    hold."""
    nan = nan_views(metrics, [f"{group}{suffix}" for group in groups for suffix in ("", "_online")])
    return nan + [
        f"{name} is {value}: left out"
        for name, value in metrics.items()
        if not math.isfinite(value)
    ]


def _mesh_numbers(
    run: MappingRun,
    hashes: Mapping[str, str],
    content: str,
) -> dict[str, Any]:
    """Accuracy and completion of the mesh, and of discs. Runs with equal TSDFs have equal meshes,
    made and scored once; where Gaussians are discs, or there is no TSDF, the Gaussians must be
    equal too."""
    names = set(hashes) - (
        {"gaussians"}
        if "tsdf" in hashes and not run.mapper.description.gaussians_are_discs
        else set()
    )
    parts = [*sorted(f"{name} {hashes[name]}" for name in names), content]
    key = " ".join([*parts, repr(getattr(run.mapper.config, "tsdf", ""))])
    if key not in _scored_meshes:
        scores = score_mesh(run, run.mapper.mesh(), seed=0, n_samples=SURFACE_SAMPLES)
        if len(_scored_meshes) >= MOST_MESHES:
            _scored_meshes.clear()
        _scored_meshes[key] = scores
    return _scored_meshes[key]


def _error(map_run: Mapped, budget: Budget) -> float:
    """Relative deviation from the number of Gaussians."""
    assert budget.gaussians is not None
    return abs(len(map_run.run.mapper.gaussians) / budget.gaussians - 1)


def _costs(map_run: Mapped) -> dict[str, Any]:
    """Sizes, steps, times and memory."""
    run = map_run.run
    late_steps = run.steps[1:] or run.steps
    seeding_s = [s.seconds.get("seeding", 0.0) + s.seconds.get("quadtree", 0.0) for s in late_steps]
    return {
        "n_gaussians": len(run.mapper.gaussians),
        "n_keyframes": len(run.mapper.keyframes),
        "n_frames": len(run.steps),
        "n_steps": map_run.n_steps,
        "ms_per_frame": 1e3 * sum(s.total_seconds for s in late_steps) / len(late_steps),
        "cpu_ms_per_frame": 1e3 * sum(map_run.cpu_s[-len(late_steps) :]) / len(late_steps),
        "seeding_ms": 1e3 * sum(seeding_s) / len(late_steps),
        "seconds_global": run.global_passes.seconds,
        "seconds_total": map_run.seconds,
        "model_size_mb": PLY_BYTES * len(run.mapper.gaussians) / 1e6,
        "peak_memory_mb": NotComputed("not reported here")
        if map_run.peak_mb is None
        else map_run.peak_mb,
    }


def versions() -> dict[str, str]:
    """Versions of the programs that decide the numbers, and the kind of machine."""
    return (
        environment()
        | libraries()
        | {
            "processor": platform.processor() or platform.machine(),
            "program": program_in_words(),
        }
    )


def _pictures(
    entry: Entry, map_run: Mapped, views: ScoredViews, folder: Path, content: str
) -> dict[str, str]:
    """Save some held-out views as rendered and as recorded. Returns name -> file, relative to
    ``folder``."""
    run = map_run.run
    n = len(views.positions)
    picks = (
        sorted({round(i * (n - 1) / (MOST_PICTURES - 1)) for i in range(MOST_PICTURES)})
        if n
        else []
    )
    few = dataclasses.replace(
        views,
        positions=[views.positions[i] for i in picks],
        poses=[views.poses[i] for i in picks],
    )
    files = {}
    for frame in few.frames(run.sequence):
        picture = run.mapper.render(frame.camera, frame.T_WC).rgb.clamp(0, 1).cpu()
        files[f"held_out {frame.index}"] = f"pictures/{entry.spec.key[:12]}-{frame.index}.png"
        files[f"truth {frame.index}"] = f"pictures/truth-{content[:12]}-{frame.index}.png"
        write_file(folder / files[f"held_out {frame.index}"], encode_png(picture))
        write_file(folder / files[f"truth {frame.index}"], encode_png(frame.rgb))
    return files
