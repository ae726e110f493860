"""Map a whole sequence, or frames as they arrive, with one call, from a notebook or the command
line."""

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch

from ..checks import shown
from ..config import DataConfig, SystemConfig
from ..data import OpenedSequence, Sequence, apply_options, open_sequence
from ..data.adjust.selection import ExtraOf
from ..data.stream import Policy
from ..errors import ArgumentError, KindError
from ..export import read_gaussian_ply
from ..mapping import LossFunction, Mapper, get_system, make_mapper
from ..mapping.moved_surfaces import MovedSurfaces
from ..mapping.training import given_functions
from ..optim import UpdateFunction
from ..seeding import SeedingRule
from ..types import Frame
from .driver import FinishedRun, drive, map_with_progress
from .mapping_run import MappingRun
from .onto import mapper_onto, named_system, read_parent, settings_onto
from .resume import load_run
from .run_clock import RunClock
from .run_folder import (
    CheckpointEvery,
    RunFolder,
    StopRequest,
    new_folder,
)
from .run_watchers import RunWatcher
from .stream_run import StreamRun

log = logging.getLogger(__name__)


def run_mapping(
    data: str | Path | Sequence,
    config: SystemConfig | str | None = None,
    *,
    system: str | type[Mapper] = "gsfusion",
    folder: Path | str | None = None,
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    evaluate: bool = True,
    checkpoints: CheckpointEvery | None = None,
    from_gaussians: Path | str | None = None,
    onto: Path | str | None = None,
    keep_moved: bool = False,
    watch: RunWatcher | None = None,
    loss: LossFunction | None = None,
    optimiser: UpdateFunction | None = None,
    extra: ExtraOf | Mapping[str, str] | None = None,
    **reader_options: Any,
) -> FinishedRun:
    """Map a sequence online, optimise over its keyframes, score it and write everything to a
    folder.

    Args:
        data: Folder of a sequence, "room" for the built-in scene, or any ``Sequence``.
        config: Settings, or the name of a preset; by default "room" for the built-in scene, else
            "replica".
        system: Name of the system, "FILE.py:Name", or its class (``get_system``); used only if
            ``config`` is not a settings object.
        folder: New or empty folder for the results; ``runs/<name>-<time>`` by default.
        seeding: Name of a seeding rule, "FILE.py:name", or the rule itself.
        device: Device of the maps.
        evaluate: Score mapped and held-out views and write the report; the maps are always written.
        checkpoints: How often to save a checkpoint, so that the run can be resumed if it is killed;
            every 30 s by default.
        from_gaussians: File of Gaussians (``read_gaussian_ply``) that the map begins with, in the
            frame of the poses.
        onto: Folder of a finished run: the camera is located in its map, and the run goes on in a
            copy of it. The files of that run stay as they are. ``config`` is that of the run, with
            tracked poses, by default.
        keep_moved: With ``onto``: leave surfaces in the map that the recording sees through.
        watch: Sees every mapped frame and the finished maps; ``docs/outputs.md`` has one for the
            Rerun viewer.
        loss, optimiser: Instead of the system's own loss and Adam (``Mapper``); metrics.json and
            config.json name them.
        extra: Further images of the frames, as for ``open_sequence``; ``extra.npz`` then has a
            label or a mean of each Gaussian. A run can be resumed if they are named by patterns of
            files.
        reader_options: For ``open_sequence``: ``format``, options of the reader.

    Returns:
        The run with its folder and numbers. After Ctrl-C everything mapped so far is in the folder,
        and ``resume_mapping(folder)`` continues the run.
    """
    clock = RunClock()
    is_room = str(data) == "room"
    parent = None if onto is None else read_parent(onto, named_system(config, system))
    if parent is not None and from_gaussians is not None:
        raise ArgumentError("a map begins with that of a run or with Gaussians, not with both")
    if isinstance(config, SystemConfig):
        settings: Any = config
    elif parent is not None and config is None:
        settings = settings_onto(parent.config)
    else:
        settings = get_system(system).preset(config or ("room" if is_room else "replica"))
    with clock("opening"):
        sequence, source = _opened(data, settings.data, extra, reader_options)
        given = {"seeding": seeding, "device": device, "loss": loss, "optimiser": optimiser}
        mapper = (
            make_mapper(settings, **given)
            if parent is None
            else mapper_onto(parent, settings, sequence.camera, **given)
        )
        if from_gaussians is not None:
            mapper.files.begin_with(
                read_gaussian_ply(from_gaussians, keep_place=True), Path(from_gaussians).name
            )
        run = MappingRun(
            sequence,
            mapper,
            source=source,
            clock=clock,
            parent=None if parent is None else parent.as_json,
        )
        if parent is not None:
            run.moved = MovedSurfaces(mapper, keeps=keep_moved)
    with RunFolder(new_folder(sequence.name, folder)) as place:
        return drive(run, place.path, evaluate, watch=watch, every=checkpoints)


def _opened(
    data: str | Path | Sequence,
    settings: DataConfig,
    extra: ExtraOf | Mapping[str, str] | None,
    reader_options: dict[str, Any],
) -> tuple[OpenedSequence, dict[str, Any]]:
    """The sequence, and how ``open_sequence`` opens it again; empty if it cannot, because frames or
    their further images are made in Python."""
    if not (extra is None or callable(extra) or isinstance(extra, Mapping)):
        raise KindError(
            f"extra must be a function of a frame, or name -> pattern of files, got {shown(extra)}"
        )
    if isinstance(data, (str, Path)):
        is_folder = str(data) != "room" and Path(data).expanduser().is_dir()
        source = {
            "path_or_name": str(Path(data).expanduser().resolve() if is_folder else data),
            **reader_options,
        }
        if isinstance(extra, Mapping):
            source["extra"] = dict(extra)
            return open_sequence(**source, data=settings), source
        return open_sequence(**source, data=settings, extra=extra), {} if extra else source
    patterns = {"extra": extra} if isinstance(extra, Mapping) else {}
    if reader_options or patterns:
        raise ArgumentError(
            "an open sequence takes no options of a reader and no patterns of files: leave out "
            f"{', '.join([*reader_options, *patterns])}, or give them to open_sequence"
        )
    return apply_options(data, settings, extra if callable(extra) else None), {}


def resume_mapping(
    folder: Path | str,
    *,
    seeding: "str | SeedingRule | None" = None,
    system: str | type[Mapper] | None = None,
    device: torch.device | str = "cpu",
    evaluate: bool = True,
    checkpoints: CheckpointEvery | None = None,
    watch: RunWatcher | None = None,
    loss: LossFunction | None = None,
    optimiser: UpdateFunction | None = None,
) -> FinishedRun:
    """Continue a run that was interrupted or killed, in the same folder; other arguments as for
    ``run_mapping``.

    The final maps are equal, bit for bit, to those of a run without interruption.

    Args:
        folder: Of the run.
        seeding: The rule, if it is not part of the package. Of one in a file the name is wanted,
            "RUN/rule.py:name" or your own "FILE.py:name" with the same content: code in a run's
            folder is not executed unless it is named.
        system: The same of a system in a file, "RUN/system.py:Name" or your own "FILE.py:Name"; or
            the class of one that was defined in Python.

    Raises:
        CodeNotNamedError: The run's rule or system came from a file, and ``seeding`` or ``system``
            names none.
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
        given = given_functions(loss, optimiser)
        run = load_run(folder, seeding=seeding, system=system, device=device, **given)
        return drive(run, place.path, evaluate, watch=watch, every=checkpoints)


def map_stream(
    frames: Iterable[Frame] | Sequence | StreamRun,
    mapper: Mapper | None = None,
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
        frames: Any iterable: a list, a generator, a camera (``RealSense``), a ``GrowingFolder``; or
            the run of a stream with its mapper, such as ``stream_onto(camera, "runs/first")``.
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
        ValueError: Frames without a mapper, or a run with another mapper or policy.
        Exception: Raised by the source; everything mapped was saved before.
    """
    run = _run_of_stream(frames, mapper, policy)

    def map_frames(run: MappingRun, stop: StopRequest) -> None:
        assert isinstance(run, StreamRun)
        run.until = lambda: bool(stop)
        map_with_progress(run, stop)
        if stop and on_stop == "finish":
            run.warnings.append(f"the stream was ended by hand after {len(run.steps)} frames")
            stop.wanted = False

    with RunFolder(new_folder(run.sequence.name, folder)) as place:
        return drive(run, place.path, evaluate, map_frames, watch=watch, every=checkpoints)


def _run_of_stream(
    frames: Iterable[Frame] | Sequence | StreamRun,
    mapper: Mapper | None,
    policy: Policy | None,
) -> StreamRun:
    """The run that maps the frames, if it is not a run already."""
    if not isinstance(frames, StreamRun):
        if mapper is None:
            raise ArgumentError("expected a mapper for the frames, such as GSFusion(config)")
        return StreamRun(frames, mapper, policy=policy)
    if mapper is not None or policy is not None:
        raise ArgumentError("the run of a stream has a mapper and a policy; leave out others")
    return frames
