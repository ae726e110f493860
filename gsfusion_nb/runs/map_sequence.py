"""Map a whole sequence with one call, from a notebook or the command line."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from ..config import SystemConfig
from ..data import Sequence, SequenceError, apply_options, open_sequence
from ..data.checkup.quick_check import check_sequence
from ..mapping import get_system, make_mapper
from ..progress import ProgressDisplay
from ..seeding import SeedingRule
from ..types import Mesh
from . import outputs
from .mapping_run import CHECKPOINT, MappingRun, StopRequest, new_folder
from .memory import describe_full
from .posed_frames import has_poses

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
    **reader_options: Any,
) -> "FinishedRun":
    """Map a sequence online, optimise over its keyframes, score it and write everything to a folder.

    Args:
        data: Folder of a sequence, "room" for the built-in scene, or any ``Sequence``.
        config: Settings, or the name of a preset; the built-in scene's or Replica's by default.
        system: Name of the system (``gsfusion_nb.mapping.SYSTEMS``), used only where ``config`` holds no settings.
        folder: New or empty folder for the results; ``runs/<name>-<time>`` by default.
        seeding: Name of a seeding rule, or the rule itself.
        device: Where the maps live.
        evaluate: Score mapped and held-out views and write the report; the maps are written in any case.
        reader_options: For ``open_sequence``: ``format``, ``split``, options of the reader.

    Returns:
        The run with its folder and numbers. After Ctrl-C everything mapped so far is saved in it, and
        ``resume_mapping(folder)`` goes on.
    """
    settings = _settings(config, system, is_room=str(data) == "room")
    if isinstance(data, (str, Path)):
        is_folder = Path(data).expanduser().is_dir()
        place = str(Path(data).expanduser().resolve()) if is_folder and str(data) != "room" else str(data)
        source = {"path_or_name": place, **reader_options}
        sequence = open_sequence(**source, data=settings.data)
    else:
        source, sequence = {}, apply_options(data, settings.data)
    run = MappingRun(sequence, make_mapper(settings, seeding=seeding, device=device), source=source)
    if source and str(data) != "room" and has_poses(sequence):
        run.warnings += _doubts(sequence.mapping)
    return drive(run, new_folder(sequence.name, folder), evaluate)


def resume_mapping(
    folder: Path | str,
    *,
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    evaluate: bool = True,
) -> "FinishedRun":
    """Go on with a run that was interrupted, in the same folder.

    Raises:
        FileNotFoundError: the folder holds no checkpoint.
    """
    run = MappingRun.resume(folder, seeding=seeding, device=device)
    run.warnings = [w for w in run.warnings if not w.startswith("interrupted after ")]
    return drive(run, Path(folder), evaluate)


def _settings(config: SystemConfig | str | None, system: str, *, is_room: bool) -> SystemConfig:
    """Settings as given, or the preset of that name."""
    if config is None or isinstance(config, str):
        return get_system(system).preset(config or ("room" if is_room else "replica"))
    return config


def _doubts(sequence: Sequence) -> list[str]:
    """A sentence if another reading of poses or depth fits the data better, from a few pairs of frames."""
    try:
        verdict = check_sequence(sequence)
    except SequenceError:
        return []
    return [] if verdict.ok else [f"depth and poses look {verdict}"]


class FinishedRun:
    """Where a run's files are, its numbers, and the run itself with both maps (``run.mapper``)."""

    def __init__(self, run: MappingRun, folder: Path, metrics: dict[str, Any]):
        self.run = run
        self.folder = folder
        self.metrics = metrics

    @property
    def mapper(self):
        """The mapper: ``mapper.gaussians``, ``mapper.volume``, ``mapper.render(camera, T_WC)``, ``mapper.mesh()``."""
        return self.run.mapper

    def __repr__(self) -> str:
        return f"FinishedRun({self.run.status}, {len(self.run.steps)} frames, files in {self.folder})"


def drive(
    run: MappingRun,
    folder: Path,
    evaluate: bool,
    map_frames: "Callable[[MappingRun, StopRequest], None] | None" = None,
) -> FinishedRun:
    """Everything from the first frame to the report. Whatever ends it early, what was mapped is in the folder first.

    ``map_frames`` does the online part until the frames end or a stop is wanted; by default with a progress bar over
    the sequence.
    """
    stop = StopRequest()
    with stop.listening():
        try:
            _work(run, stop, evaluate, map_frames or _with_progress)
        except BaseException as e:
            run.status = "interrupted" if isinstance(e, KeyboardInterrupt) else "failed"
            run.warnings.append(f"ended by {type(e).__name__}: {e}")
            note = f"The {len(run.steps)} frames mapped before are saved in {folder}." if run.steps else ""
            if run.steps:
                _save(run, folder, stop)
            if isinstance(e, torch.OutOfMemoryError):
                raise MemoryError(f"{describe_full(run.mapper)}. {note}".rstrip()) from e
            if note:
                e.add_note(note)
            raise
        mesh = _save(run, folder, stop)
        metrics: dict[str, Any] = outputs.map_metrics(run, mesh) | run.online_scores
        if evaluate:
            stop.at_once = True
            metrics |= outputs.score(run) | outputs.score_trajectory(run) | outputs.score_mesh(run, mesh)
            outputs.write_numbers(run, folder, metrics)
            outputs.write_page(run, folder, metrics)
    return FinishedRun(run, folder, metrics)


def _work(
    run: MappingRun, stop: StopRequest, evaluate: bool, map_frames: Callable[[MappingRun, StopRequest], None]
) -> None:
    """Map and optimise until done or asked to stop; sets the run's status."""
    map_frames(run, stop)
    if evaluate and not (stop or run.mapper.passes.begun) and run.mapper.n_passes:
        online = outputs.score(run, "_online")
        names = ("psnr_held_out_online_db", "psnr_mapped_online_db")
        run.online_scores = {k: online[k] for k in names if isinstance(online[k], float)}
    if run.status == "running" and not stop:
        _with_progress_of_passes(run, stop)
    if stop:
        run.status = "interrupted"
        of_all = f" of {len(run.sequence.mapping)}" if run.resumable else ""
        run.warnings.append(
            f"interrupted after {len(run.steps)}{of_all} frames and "
            f"{run.mapper.passes.done} global passes; everything so far is saved"
        )
    elif run.status == "running":
        run.status = "complete"


def _save(run: MappingRun, folder: Path, stop: StopRequest) -> Mesh:
    """Write the maps and the numbers, then, if there is more to do, the checkpoint, which is the largest."""
    stop.saving = True
    try:
        mesh = outputs.write_maps(run, folder)
        outputs.write_numbers(run, folder, outputs.map_metrics(run, mesh) | run.online_scores)
        if run.status == "interrupted" and run.resumable:
            run.save_checkpoint(folder)
        elif run.status != "failed":
            (folder / CHECKPOINT).unlink(missing_ok=True)
        return mesh
    finally:
        stop.saving = False


def _with_progress(run: MappingRun, stop: StopRequest) -> None:
    seconds = 0.0
    with ProgressDisplay("mapping", total=len(run.sequence.mapping), unit="frame", done=run.next_position) as progress:
        for n, report in enumerate(run.online(), start=1):
            seconds += report.total_seconds
            rate = f"{n / seconds:.1f} fps, " if seconds > 0 else ""  # a system may not time its stages
            note = f"{rate}PSNR {report.psnr_after_db:.1f} dB, {report.n_gaussians:,} Gaussians"
            progress.show(run.next_position, note=note)
            if stop:
                return


def _with_progress_of_passes(run: MappingRun, stop: StopRequest) -> None:
    steps: Iterator = run.optimise()
    with ProgressDisplay("optimising", unit="view", shown=bool(run.mapper.n_passes)) as progress:
        for step in steps:
            progress.show(step.step, total=step.n_steps, note=f"loss {step.loss:.4f}")
            if stop:
                return
