"""One run from the first frame to the report: interrupted, out of memory or complete."""

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..data import FrameStore, RecordedSequence
from ..data.adjust.repair import as_read
from ..errors import DiskFullError, MemoryFullError, memory_is_full
from ..evaluation import ONLINE
from ..export import CheckpointStore
from ..progress import ProgressDisplay
from ..resources import MAP_MEMORY
from ..types import Mesh
from . import outputs, scores
from .checkpoint import save_checkpoint
from .explanations import describe_full, why_empty
from .extra_columns import EXTRA_COLUMNS, write_extra_columns
from .mapped_views import evenly
from .mapping_run import MappingRun, lost_in_words
from .report import ReportData
from .resume import resume_command
from .run_folder import (
    CHECKPOINTS,
    NOT_SAVED,
    Autosave,
    CheckpointEvery,
    StopRequest,
)
from .run_watchers import RunWatcher
from .system_of_run import write_system

log = logging.getLogger(__name__)

KEPT_BYTES = 1 << 28
"""Images of frames that are kept to be scored and shown: 128 frames of 640x480."""


@dataclass(frozen=True, eq=False, repr=False)
class FinishedRun:
    """The folder of a run's files, its metrics, and the run itself with its maps
    (``run.mapper``)."""

    run: MappingRun
    folder: Path
    metrics: dict[str, Any]
    report: ReportData | None = None
    """What ``report.html`` shows; None if nothing was scored."""

    @property
    def mapper(self):
        """The mapper: ``mapper.gaussians``, ``mapper.volume``, ``mapper.render(camera, T_WC)``,
        ``mapper.mesh()``."""
        return self.run.mapper

    def __repr__(self) -> str:
        return (
            f"FinishedRun({self.run.status}, {len(self.run.steps)} frames, files in {self.folder})"
        )


def drive(
    run: MappingRun,
    folder: Path,
    evaluate: bool,
    map_frames: "Callable[[MappingRun, StopRequest], None] | None" = None,
    *,
    watch: RunWatcher | None = None,
    every: CheckpointEvery | None = None,
) -> FinishedRun:
    """Do a run from the first frame to the report. If anything ends it early, what was mapped is
    saved first.

    Args:
        run: The run to do.
        folder: Its folder, locked.
        evaluate: Score views and write the report.
        map_frames: Does the online part until the frames end or a stop is requested; by default
            with a progress bar.
        watch: Sees every mapped frame and the finished maps.
        every: How often to save a checkpoint.
    """
    run.warnings.go_on()
    if watch is not None:
        run.watchers.append(watch)
    stop = StopRequest()
    if evaluate:
        _keep_frames(run)
    outputs.write_rule(run, folder)
    write_system(run.mapper, folder)
    run.after_step = Autosave(
        run.mapper, lambda: _checkpoint(run, folder, stop), every or CheckpointEvery()
    )
    with stop.listening():
        try:
            _work(run, stop, evaluate, map_frames or map_with_progress)
            if stop:
                about_scores = (
                    ", and the scores are computed (Ctrl-C once more leaves them out)"
                    if evaluate
                    else ""
                )
                log.warning("interrupted: the maps are being written%s", about_scores)
            _checkpoint_before_files(run, folder, stop)
            mesh = _save(run, folder, stop)
            _write_columns(run, folder, stop)
        except BaseException as e:
            _rescue(run, folder, stop, e)
            raise
        metrics: dict[str, Any] = scores.map_metrics(run, mesh) | run.online_scores
        report: ReportData | None = None
        if evaluate:
            _score(run, folder, stop, mesh, metrics)
            with run.clock("report"):
                report = outputs.write_page(run, folder, metrics | run.clock.metrics(), mesh)
        for watcher in run.watchers:
            watcher.finished(run.mapper, mesh, metrics)
        _forget_pictures(run)
        metrics |= run.clock.metrics()
        # after all other files: its status says that they are there
        outputs.write_numbers(run, folder, metrics)
        if run.status != "interrupted" or not run.resumable:
            CheckpointStore(folder / CHECKPOINTS).remove()
            run.store = None
    return FinishedRun(run, folder, metrics, report)


def _keep_frames(run: MappingRun) -> None:
    """Keep frames that are read, so that those that are scored and shown are read once.

    Frames that are in memory, or made by code of others, are not kept.
    """
    source = as_read(run.sequence.source)
    if not (isinstance(source, RecordedSequence) or hasattr(source, "content")):
        return
    limit_bytes = KEPT_BYTES
    if MAP_MEMORY.limit_bytes is not None:
        limit_bytes = min(limit_bytes, MAP_MEMORY.limit_bytes // 8)
    store = FrameStore(limit_bytes, lambda: run.clock("reading"))
    positions = run.sequence.mapping.positions
    limit = run.mapper.config.data.scored_views
    scored_positions = [positions[i] for i in evenly(len(positions), limit)]
    store.wanted = frozenset([*scored_positions, *run.sequence.held_out.positions])
    run.sequence = run.sequence.keeping(store)


def _forget_pictures(run: MappingRun) -> None:
    """Give back the memory of what was kept to score and show the same views again."""
    if run.sequence.kept is not None:
        run.sequence.kept.clear()
    run.mapper.files.forget_drawn()


def _work(
    run: MappingRun,
    stop: StopRequest,
    evaluate: bool,
    map_frames: Callable[[MappingRun, StopRequest], None],
) -> None:
    """Map and optimise until finished or asked to stop; sets the run's status.

    A request to stop takes effect between two gradient steps of a frame, except of the first.
    """
    with _heard_between_steps(run, stop):
        map_frames(run, stop)
    if (
        evaluate
        and not (stop or run.mapper.passes.begun or run.global_passes.is_finished)
        and run.mapper.n_passes
    ):
        with stop.ending_at_once():
            online = scores.score(run, "_online")
            run.online_scores = {k: online[k] for k in ONLINE if isinstance(online[k], float)}
    if run.status == "running" and not (stop or run.global_passes.is_finished):
        with _heard_between_steps(run, stop):
            _with_progress_of_passes(run, stop)
    if stop:
        run.status = "interrupted"
        of_all = f" of {len(run.sequence.mapping)}" if run.resumable else ""
        run.warnings.note_ending(
            f"interrupted after {len(run.steps)}{of_all} frames and "
            f"{run.mapper.passes.done} global passes; everything mapped so far is saved"
        )
    elif run.status == "running":
        run.status = "complete"
    if not stop:
        for note in run.mapper.reports.run_notes(run.steps):
            run.warnings.note_ending(note)
        if run.moved is not None and (sentence := run.moved.in_words()):
            run.warnings.note_ending(sentence)
    if run.steps and not len(run.mapper.gaussians):
        run.warnings.note_ending(why_empty(run))


@contextlib.contextmanager
def _heard_between_steps(run: MappingRun, stop: StopRequest) -> Iterator[None]:
    """Context in which a request to stop takes effect between two gradient steps, if there is a
    map; and while kernels are compiled, also if there is none."""
    guard = run.mapper.guard
    guard.stop_wanted = lambda: bool(stop) and len(run.steps) > 0
    guard.end_wanted = lambda: bool(stop)
    try:
        yield
    finally:
        guard.stop_wanted = guard.end_wanted = lambda: False


def _score(
    run: MappingRun, folder: Path, stop: StopRequest, mesh: Mesh, metrics: dict[str, Any]
) -> None:
    """Add the scores to ``metrics``; if stopped halfway, the scores computed so far are kept."""
    was_stopped = bool(stop)
    stop.wanted = False
    with stop.ending_at_once():
        metrics |= scores.score(run)
        metrics |= scores.score_trajectory(run)
        with run.clock("mesh_scores"):
            metrics |= scores.score_mesh(run, mesh)
            metrics |= scores.score_centres(run, mesh)
    if stop and not was_stopped:
        run.status = "interrupted"
        run.warnings.note_ending("interrupted while the views were scored; the maps are complete")
        _checkpoint(run, folder, stop)


def _rescue(run: MappingRun, folder: Path, stop: StopRequest, error: BaseException) -> None:
    """Save what can be saved of a run that ends with ``error``, and say so in a note added to the
    error."""
    run.status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
    run.warnings.note_ending(f"ended by {type(error).__name__}: {error}")
    if run.mapper.guard.half_mapped:
        run.warnings.note_ending(run.mapper.guard.half_mapped)
    notes: list[str] = []
    attempts: list[Callable[[], Any]] = [
        lambda: _checkpoint(run, folder, stop),
        lambda: _save(run, folder, stop),
    ]
    for attempt in attempts if run.steps else ():
        try:
            attempt()
        except DiskFullError as e:
            if str(e) != str(error):
                notes.append(str(e))
        except Exception as e:
            if not memory_is_full(e):
                raise
            notes.append("There is too little memory to write all files.")
    if run.steps:
        extent = "saved" if not notes else "saved as far as there is room"
        notes.insert(0, f"The {len(run.steps)} frames mapped before are {extent} in {folder}.")
    if run.resumable and CheckpointStore(folder / CHECKPOINTS).exists:
        notes.append(f"To continue from the last checkpoint: {resume_command(folder, run.mapper)}")
    if memory_is_full(error):
        raise MemoryFullError(" ".join([f"{describe_full(run.mapper)}.", *notes])) from error
    for note in notes:
        error.add_note(note)


def _checkpoint(run: MappingRun, folder: Path, stop: StopRequest) -> None:
    """Save a checkpoint if possible."""
    if run.can_be_saved:
        with stop.held_back(), run.clock("checkpoints"):
            save_checkpoint(run, folder)


def _checkpoint_before_files(run: MappingRun, folder: Path, stop: StopRequest) -> None:
    """Save a checkpoint before the maps are written, so that a run that is killed then is not
    lost."""
    try:
        _checkpoint(run, folder, stop)
    except DiskFullError as e:
        if run.status == "interrupted":
            raise
        log.warning(NOT_SAVED, e)


def _save(run: MappingRun, folder: Path, stop: StopRequest) -> Mesh:
    """Write the maps and the numbers."""
    with stop.held_back():
        mesh = outputs.write_maps(run, folder)
        status = "running" if run.status == "complete" else run.status  # not scored yet
        outputs.write_numbers(
            run, folder, scores.map_metrics(run, mesh) | run.online_scores, status
        )
        return mesh


def _write_columns(run: MappingRun, folder: Path, stop: StopRequest) -> None:
    """Write what each Gaussian shows of the frames' further images, unless the run is asked to
    stop."""
    if stop:
        return
    with stop.ending_at_once(), run.clock("writing"):
        write_extra_columns(run, folder)
    if stop:
        run.status = "interrupted"
        run.warnings.note_ending(
            f"interrupted while {EXTRA_COLUMNS} was made; the maps are complete"
        )
        _checkpoint(run, folder, stop)


def map_with_progress(run: MappingRun, stop: StopRequest) -> None:
    """Map the frames that are left; of a stream it is not known how many there are."""
    total = len(run.sequence.mapping) if run.resumable else None
    seconds = 0.0
    with (
        ProgressDisplay("mapping", total=total, unit="frame", first=run.next_position) as progress,
        contextlib.closing(run.frame_by_frame()) as reports,
    ):
        n = 0
        for report in reports:
            if report is None:
                progress.show(run.next_position, note=lost_in_words(run))
                if stop and run.steps:
                    return
                continue
            n += 1
            seconds += report.total_seconds
            # a system may not time its stages
            rate = f"{n / seconds:.1f} frames/s, " if seconds > 0 else ""
            n_dropped = run.extra_metrics().get("n_frames_dropped")
            note = f", {n_dropped} frames dropped" if n_dropped else ""
            progress.show(run.next_position, note=f"{rate}{report.in_words}{note}")
            if stop:
                return


def _with_progress_of_passes(run: MappingRun, stop: StopRequest) -> None:
    with ProgressDisplay("optimising", unit="view", visible=bool(run.mapper.n_passes)) as progress:
        for step in run.optimise():
            progress.show(step.step, total=step.n_steps, note=f"loss {step.loss:.4f}")
            if stop:
                return
