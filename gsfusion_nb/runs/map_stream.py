"""Map frames as they come with one call: a camera, a folder that grows, any iterable."""

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from ..data import Sequence
from ..data.stream import Policy
from ..mapping import Mapper
from ..progress import ProgressDisplay
from ..types import Frame
from .autosave import CheckpointEvery
from .map_sequence import FinishedRun, drive
from .mapping_run import MappingRun
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
) -> FinishedRun:
    """Map frames as they come, optimise over the keyframes after the last, score, and write everything to a folder.

    Frames are got on a thread of their own, so that neither waits for the other more than the policy says. One that
    cannot be used is skipped and named. A source that breaks off, Ctrl-C, and an exception all leave what was mapped so
    far in the folder. Memory does not grow with the number of frames, but with the map: besides the mapper's keyframes
    only a few frames are kept, to score by.

    Args:
        frames: Any iterable: a list, a generator, a camera (``RealSense``, ``AzureKinect``), a ``GrowingFolder``.
        mapper: Who maps them, such as ``GSFusion(config)``; one that has mapped already goes on with its map.
        policy: "all", "queue", "latest" or "drop" (``gsfusion_nb.data.stream.POLICIES``); the source's own by
            default ("latest" for cameras, "all" for anything else).
        queue_frames: Frames that may wait, for "all" and "queue".
        folder: New or empty folder for the results; ``runs/<name>-<time>`` by default.
        evaluate: Score the frames that were kept and write the report.
        on_stop: What Ctrl-C does: "save" ends the run; "finish" ends only the stream, and the optimisation and the
            report follow as after its last frame, unless it is pressed again.
        checkpoints: How often to save where the run stands; every 30 s by default.

    Returns:
        The run with its folder and numbers; ``n_frames_received`` and ``n_frames_dropped`` are among them.

    Raises:
        SequenceError: no frame could be mapped; names the first reason.
        Exception: what the source raised, after everything was saved.
    """

    def map_frames(run: MappingRun, stop: StopRequest) -> None:
        _with_progress(run, stop)
        if stop and on_stop == "finish":
            run.warnings.append(f"the stream was ended by hand after {len(run.steps)} frames")
            stop.wanted = False

    with RunFolder(new_folder(getattr(frames, "name", "stream"), folder)) as place:
        run = StreamRun(frames, mapper, policy=policy, queue_frames=queue_frames)
        return drive(run, place, evaluate, map_frames, every=checkpoints)


def _with_progress(run: MappingRun, stop: StopRequest) -> None:
    assert isinstance(run, StreamRun)
    run.until = lambda: bool(stop)
    seconds = 0.0
    with ProgressDisplay("mapping", unit="frame") as progress, contextlib.closing(run.online()) as reports:
        for n, report in enumerate(reports, start=1):
            seconds += report.total_seconds
            dropped = run.extra_metrics()["n_frames_dropped"]
            note = (
                f"{n / max(seconds, 1e-9):.1f} frames/s, PSNR {report.psnr_after_db:.1f} dB, "
                f"{report.n_gaussians:,} Gaussians, {dropped} frames dropped"
            )
            progress.show(n, note=note)
            if stop:
                return
