"""Map frames as they arrive, with one call: from a camera, a growing folder or any iterable."""

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from ..data import Sequence
from ..data.stream import Policy
from ..mapping import Mapper
from ..types import Frame
from ..work import ProgressDisplay
from .checkpoint import CheckpointEvery
from .map_sequence import FinishedRun, drive
from .mapping_run import MappingRun, RunWatcher
from .run_folder import RunFolder, new_folder
from .stop_request import StopRequest
from .stream_run import StreamRun


def map_stream(
    frames: Iterable[Frame] | Sequence,
    mapper: Mapper,
    *,
    policy: Policy | None = None,
    queue_frames: int = 4,
    folder: Path | str | None = None,
    evaluate: bool = True,
    on_stop: Literal["save", "finish"] = "save",
    checkpoints: CheckpointEvery | None = None,
    watch: RunWatcher | None = None,
) -> FinishedRun:
    """Map frames as they arrive, optimise over the keyframes after the last, score, and write everything to a folder.

    A second thread receives the frames; ``policy`` says what happens when mapping is slower than the source. A frame
    that cannot be used is skipped, with a warning. If the source breaks off, or after Ctrl-C or an exception, what was
    mapped so far is in the folder. Memory grows with the map, not with the number of frames: besides the mapper's
    keyframes only a few frames are kept, for scoring.

    Args:
        frames: Any iterable: a list, a generator, a camera (``RealSense``, ``AzureKinect``), a ``GrowingFolder``.
        mapper: The mapper, such as ``GSFusion(config)``; one that has a map already continues it.
        policy: "all", "queue", "latest" or "drop" (``gsfusion_nb.data.stream.POLICIES``); the source's own by
            default ("latest" for cameras, "all" for anything else).
        queue_frames: Largest number of waiting frames, for "all" and "queue".
        folder: New or empty folder for the results; ``runs/<name>-<time>`` by default.
        evaluate: Score the frames that were kept and write the report.
        on_stop: What Ctrl-C does: "save" ends the run; "finish" ends only the stream, and the optimisation and the
            report follow as usual, unless Ctrl-C is pressed again.
        checkpoints: How often to save a checkpoint; every 30 s by default.
        watch: Sees every mapped frame and the finished maps, as for ``run_mapping``.

    Returns:
        The run with its folder and numbers; ``n_frames_received`` and ``n_frames_dropped`` are among them.

    Raises:
        SequenceError: No frame could be mapped; the message gives the first reason.
        Exception: Raised by the source; everything mapped was saved before.
    """

    def map_frames(run: MappingRun, stop: StopRequest) -> None:
        _with_progress(run, stop)
        if stop and on_stop == "finish":
            run.warnings.append(f"the stream was ended by hand after {len(run.steps)} frames")
            stop.wanted = False

    with RunFolder(new_folder(getattr(frames, "name", "stream"), folder)) as place:
        run = StreamRun(frames, mapper, policy=policy, queue_frames=queue_frames)
        run.watchers += [watch] if watch is not None else []
        return drive(run, place, evaluate, map_frames, every=checkpoints)


def _with_progress(run: MappingRun, stop: StopRequest) -> None:
    assert isinstance(run, StreamRun)
    run.until = lambda: bool(stop)
    seconds = 0.0
    with ProgressDisplay("mapping", unit="frame") as progress, contextlib.closing(run.online()) as reports:
        for n, report in enumerate(reports, start=1):
            seconds += report.total_seconds
            dropped = run.extra_metrics()["n_frames_dropped"]
            note = f"{n / max(seconds, 1e-9):.1f} frames/s, {report.in_words}, {dropped} frames dropped"
            progress.show(n, note=note)
            if stop:
                return
