"""Map a whole sequence, or frames as they arrive, with one call, from a notebook or the command
line."""

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from ..config import SystemConfig
from ..data import Sequence, SequenceError, apply_options, open_sequence
from ..data.stream import Policy
from ..errors import DiskFullError, MemoryFullError, memory_is_full
from ..evaluation import ONLINE
from ..export import CheckpointStore, read_gaussian_ply
from ..mapping import LossFunction, Mapper, get_system, make_mapper
from ..optim import UpdateFunction
from ..progress import ProgressDisplay
from ..seeding import SeedingRule, rule_name
from ..types import Frame, Mesh
from . import outputs
from .mapping_run import MappingRun, RunWatcher
from .resume import load_run, resume_command
from .run_clock import RunClock
from .run_folder import (
    CHECKPOINTS,
    NOT_SAVED,
    Autosave,
    CheckpointEvery,
    RunFolder,
    StopRequest,
    new_folder,
)
from .stream_run import StreamRun

log = logging.getLogger(__name__)


def run_mapping(
    data: str | Path | Sequence,
    config: SystemConfig | str | None = None,
    *,
    system: str = "gsfusion",
    folder: Path | str | None = None,
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    evaluate: bool = True,
    checkpoints: CheckpointEvery | None = None,
    from_gaussians: Path | str | None = None,
    watch: RunWatcher | None = None,
    loss: LossFunction | None = None,
    optimiser: UpdateFunction | None = None,
    **reader_options: Any,
) -> "FinishedRun":
    """Map a sequence online, optimise over its keyframes, score it and write everything to a
    folder.

    Args:
        data: Folder of a sequence, "room" for the built-in scene, or any ``Sequence``.
        config: Settings, or the name of a preset; by default "room" for the built-in scene, else
            "replica".
        system: Name of the system (``gsfusion_nb.mapping.SYSTEMS``), used only if ``config`` is not
            a settings object.
        folder: New or empty folder for the results; ``runs/<name>-<time>`` by default.
        seeding: Name of a seeding rule, "FILE.py:name", or the rule itself.
        device: Device of the maps.
        evaluate: Score mapped and held-out views and write the report; the maps are always written.
        checkpoints: How often to save a checkpoint, so that the run can be resumed if it is killed;
            every 30 s by default.
        from_gaussians: File of Gaussians (``read_gaussian_ply``) that the map begins with, in the
            frame of the poses.
        watch: Sees every mapped frame and the finished maps; ``docs/outputs.md`` has one for the
            Rerun viewer.
        loss, optimiser: Instead of the system's own loss and Adam (``Mapper``); metrics.json and
            config.json name them.
        reader_options: For ``open_sequence``: ``format``, options of the reader.

    Returns:
        The run with its folder and numbers. After Ctrl-C everything mapped so far is in the folder,
        and ``resume_mapping(folder)`` continues the run.
    """
    clock = RunClock()
    is_room = str(data) == "room"
    preset = "room" if is_room else "replica"
    settings = (
        config if isinstance(config, SystemConfig) else get_system(system).preset(config or preset)
    )
    with clock("opening"):
        if isinstance(data, (str, Path)):
            is_folder = Path(data).expanduser().is_dir() and not is_room
            source = {
                "path_or_name": str(Path(data).expanduser().resolve() if is_folder else data),
                **reader_options,
            }
            sequence = open_sequence(**source, data=settings.data)
        else:
            source = {}
            sequence = apply_options(data, settings.data)
        mapper = make_mapper(
            settings, seeding=seeding, device=device, loss=loss, optimiser=optimiser
        )
        if from_gaussians is not None:
            mapper.files.begin_with(
                read_gaussian_ply(from_gaussians, keep_place=True), Path(from_gaussians).name
            )
        run = MappingRun(sequence, mapper, source=source, clock=clock)
    with RunFolder(new_folder(sequence.name, folder)) as place:
        return drive(run, place.path, evaluate, watch=watch, every=checkpoints)


def resume_mapping(
    folder: Path | str,
    *,
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    evaluate: bool = True,
    checkpoints: CheckpointEvery | None = None,
    watch: RunWatcher | None = None,
    loss: LossFunction | None = None,
    optimiser: UpdateFunction | None = None,
) -> "FinishedRun":
    """Continue a run that was interrupted or killed, in the same folder; other arguments as for
    ``run_mapping``.

    The final maps are equal, bit for bit, to those of a run without interruption.

    Args:
        folder: Of the run.
        seeding: The rule, if it is not part of the package. Of one in a file the name is wanted,
            "RUN/rule.py:name" or your own "FILE.py:name" with the same content: code in a run's
            folder is not executed unless it is named.

    Raises:
        RuleNotNamedError: The run's rule came from a file, and ``seeding`` names none.
        FileNotFoundError: The folder holds no checkpoint. FileExistsError: The run is still
            running.
        SequenceError: Files of the recording were changed, added or deleted since the run began;
            the first are named.
    """
    if not Path(folder).is_dir():
        raise FileNotFoundError(
            f"{folder} does not exist; expected the folder of an interrupted run"
        )
    with RunFolder(folder) as place:
        run = load_run(folder, seeding=seeding, device=device, loss=loss, optimiser=optimiser)
        return drive(run, place.path, evaluate, watch=watch, every=checkpoints)


@dataclass(frozen=True, eq=False, repr=False)
class FinishedRun:
    """The folder of a run's files, its metrics, and the run itself with its maps
    (``run.mapper``)."""

    run: MappingRun
    folder: Path
    metrics: dict[str, Any]

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
    run.go_on()
    run.watchers += [watch] if watch is not None else []
    stop = StopRequest()
    if evaluate:
        run.keep_frames()
    outputs.write_rule(run, folder)
    run.after_step = Autosave(
        run.mapper, lambda: _checkpoint(run, folder, stop), every or CheckpointEvery()
    )
    with stop.listening():
        try:
            _work(run, stop, evaluate, map_frames or _with_progress)
            if stop:
                scores = (
                    ", and the scores are computed (Ctrl-C once more leaves them out)"
                    if evaluate
                    else ""
                )
                log.warning("interrupted: the maps are being written%s", scores)
            _checkpoint_before_files(run, folder, stop)
            mesh = _save(run, folder, stop)
        except BaseException as e:
            _rescue(run, folder, stop, e)
            raise
        metrics: dict[str, Any] = outputs.map_metrics(run, mesh) | run.online_scores
        if evaluate:
            _score(run, folder, stop, mesh, metrics)
            with run.clock("report"):
                outputs.write_page(run, folder, metrics | run.clock.metrics())
        for watcher in run.watchers:
            watcher.finished(run.mapper, mesh, metrics)
        run.forget_pictures()
        metrics |= run.clock.metrics()
        # after all other files: its status says that they are there
        outputs.write_numbers(run, folder, metrics)
        if run.status != "interrupted" or not run.resumable:
            CheckpointStore(folder / CHECKPOINTS).remove()
            run.store = None
    return FinishedRun(run, folder, metrics)


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
        and not (stop or run.mapper.passes.begun or run.is_optimised)
        and run.mapper.n_passes
    ):
        with stop.ending_at_once():
            online = outputs.score(run, "_online")
            run.online_scores = {k: online[k] for k in ONLINE if isinstance(online[k], float)}
    if run.status == "running" and not (stop or run.is_optimised):
        with _heard_between_steps(run, stop):
            _with_progress_of_passes(run, stop)
    if stop:
        run.status = "interrupted"
        of_all = f" of {len(run.sequence.mapping)}" if run.resumable else ""
        run.note_ending(
            f"interrupted after {len(run.steps)}{of_all} frames and "
            f"{run.mapper.passes.done} global passes; everything mapped so far is saved"
        )
    elif run.status == "running":
        run.status = "complete"
    if not stop:
        for note in run.mapper.reports.run_notes(run.steps):
            run.note_ending(note)
    if run.steps and not len(run.mapper.gaussians):
        run.note_ending(_why_empty(run))


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
    already = bool(stop)
    stop.wanted = False
    with stop.ending_at_once():
        metrics |= outputs.score(run)
        metrics |= outputs.score_trajectory(run)
        with run.clock("mesh_scores"):
            metrics |= outputs.score_mesh(run, mesh)
            metrics |= outputs.score_centres(run, mesh)
    if stop and not already:
        run.status = "interrupted"
        run.note_ending("interrupted while the views were scored; the maps are complete")
        _checkpoint(run, folder, stop)


def _rescue(run: MappingRun, folder: Path, stop: StopRequest, error: BaseException) -> None:
    """Save what can be saved of a run that ends with ``error``, and say so in a note added to the
    error."""
    run.status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
    run.note_ending(f"ended by {type(error).__name__}: {error}")
    if run.mapper.guard.half_mapped:
        run.note_ending(run.mapper.guard.half_mapped)
    notes: list[str] = []
    attempts: list[Callable[[], Any]] = [
        lambda: _checkpoint(run, folder, stop),
        lambda: _save(run, folder, stop),
    ]
    for attempt in attempts if run.steps else ():
        try:
            attempt()
        except DiskFullError as e:
            notes += [str(e)] if str(e) != str(error) else []
        except Exception as e:
            if not memory_is_full(e):
                raise
            notes.append("There is too little memory to write all files.")
    if run.steps:
        saved = "saved" if not notes else "saved as far as the disk has space"
        notes.insert(0, f"The {len(run.steps)} frames mapped before are {saved} in {folder}.")
    if run.resumable and CheckpointStore(folder / CHECKPOINTS).exists:
        notes.append(
            f"To continue from the last checkpoint: {resume_command(folder, run.mapper.rule)}"
        )
    if memory_is_full(error):
        raise MemoryFullError(" ".join([f"{_describe_full(run.mapper)}.", *notes])) from error
    for note in notes:
        error.add_note(note)


def _checkpoint(run: MappingRun, folder: Path, stop: StopRequest) -> None:
    """Save a checkpoint if possible."""
    if run.can_be_saved:
        with stop.held_back(), run.clock("checkpoints"):
            run.save_checkpoint(folder)


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
            run, folder, outputs.map_metrics(run, mesh) | run.online_scores, status
        )
        return mesh


def _with_progress(run: MappingRun, stop: StopRequest) -> None:
    """Map the frames that are left; of a stream it is not known how many there are."""
    total = len(run.sequence.mapping) if run.resumable else None
    seconds = 0.0
    with (
        ProgressDisplay("mapping", total=total, unit="frame", first=run.next_position) as progress,
        contextlib.closing(run.online()) as reports,
    ):
        for n, report in enumerate(reports, start=1):
            seconds += report.total_seconds
            # a system may not time its stages
            rate = f"{n / seconds:.1f} frames/s, " if seconds > 0 else ""
            dropped = run.extra_metrics().get("n_frames_dropped")
            note = f", {dropped} frames dropped" if dropped else ""
            progress.show(run.next_position, note=f"{rate}{report.in_words}{note}")
            if stop:
                return


def _with_progress_of_passes(run: MappingRun, stop: StopRequest) -> None:
    with ProgressDisplay("optimising", unit="view", visible=bool(run.mapper.n_passes)) as progress:
        for step in run.optimise():
            progress.show(step.step, total=step.n_steps, note=f"loss {step.loss:.4f}")
            if stop:
                return


def map_stream(
    frames: Iterable[Frame] | Sequence,
    mapper: Mapper,
    *,
    policy: Policy | None = None,
    folder: Path | str | None = None,
    evaluate: bool = True,
    on_stop: Literal["save", "finish"] = "save",
    checkpoints: CheckpointEvery | None = None,
    watch: RunWatcher | None = None,
) -> FinishedRun:
    """Map frames as they arrive, optimise over the keyframes after the last, score, and write
    everything to a folder.

    A second thread receives the frames; ``policy`` says what happens when mapping is slower than
    the source. A frame that cannot be used is skipped, with a warning. If the source breaks off, or
    after Ctrl-C or an exception, what was mapped so far is in the folder. Memory grows with the
    map, not with the number of frames: besides the mapper's keyframes only a few frames are kept,
    for scoring.

    Args:
        frames: Any iterable: a list, a generator, a camera (``RealSense``), a ``GrowingFolder``.
        mapper: The mapper, such as ``GSFusion(config)``; one that has a map already continues it.
        policy: "all" or "latest" (``gsfusion_nb.data.stream.POLICIES``); the source's own by
            default ("latest" for cameras, "all" for anything else).
        folder: New or empty folder for the results; ``runs/<name>-<time>`` by default.
        evaluate: Score the frames that were kept and write the report.
        on_stop: What Ctrl-C does: "save" ends the run; "finish" ends only the stream, and the
            optimisation and the report follow as usual, unless Ctrl-C is pressed again.
        checkpoints: How often to save a checkpoint; every 30 s by default.
        watch: Sees every mapped frame and the finished maps, as for ``run_mapping``.

    Returns:
        The run with its folder and numbers; ``n_frames_received`` and ``n_frames_dropped`` are
        among them.

    Raises:
        SequenceError: No frame could be mapped; the message gives the first reason.
        Exception: Raised by the source; everything mapped was saved before.
    """

    def map_frames(run: MappingRun, stop: StopRequest) -> None:
        assert isinstance(run, StreamRun)
        run.until = lambda: bool(stop)
        _with_progress(run, stop)
        if stop and on_stop == "finish":
            run.warnings.append(f"the stream was ended by hand after {len(run.steps)} frames")
            stop.wanted = False

    with RunFolder(new_folder(getattr(frames, "name", "stream"), folder)) as place:
        run = StreamRun(frames, mapper, policy=policy)
        return drive(run, place.path, evaluate, map_frames, watch=watch, every=checkpoints)


def _why_empty(run: MappingRun) -> str:
    """A sentence that explains why the map has no Gaussians after at least one frame."""
    n_seeds = sum(step.n_seeds for step in run.steps)
    rule = rule_name(run.mapper.rule)
    if n_seeds:
        why = (
            f"all {n_seeds:,} that were created were removed again (see the settings under states)"
        )
        return f"the map has no Gaussians: {why}"
    text = (
        f"the map has no Gaussians: the seeding rule {rule!r} proposed none for any of the "
        f"{len(run.steps)} frames"
    )
    with contextlib.suppress(SequenceError, StopIteration):
        frame = next(iter(run.mapped_views(1)))
        known = frame.depth_m[frame.depth_m > 0]
        low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
        text += f"; the depth of frame {frame.index} is from {low:.4g} to {high:.4g} m"
    return f"{text}; the rule's options are {run.mapper.config.seeding.options or 'the defaults'}"


def _describe_full(mapper: Mapper) -> str:
    """A sentence that says what fills the memory, and which settings need less."""
    less = ["smaller images (data.width)", *mapper.description.memory_savers]
    if mapper.config.keyframes_on == "device":
        less.append("keyframes in CPU memory (keyframes_on = 'cpu')")
    return f"the memory of {mapper.device} is full of {mapper!r}; try {', '.join(less)}"
