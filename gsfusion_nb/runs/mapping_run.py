"""One run over a sequence: the loop over frames, timing, interruption, state. ``driver`` does it
from the first frame to the report, and ``outputs`` writes the results."""

import contextlib
import copy
import logging
from collections.abc import Callable, Generator, Iterator
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from ..data import (
    FrameSubset,
    OpenedSequence,
    RecordedSequence,
    SequenceError,
    data_files,
)
from ..data.stream import read_ahead
from ..errors import KindError
from ..export import CheckpointStore
from ..interrupts import DelayedInterrupt
from ..mapping import FrameUndone, GlobalStep, Mapper, StepReport
from ..mapping.moved_surfaces import MovedSurfaces
from ..mapping.systems import know_system
from ..types import Frame
from .global_passes import GlobalPasses
from .mapped_views import MappedViews, RecordedViews
from .quiet_watch import QuietWatch
from .range_watch import RangeWatch
from .run_clock import RunClock
from .run_folder import StepLog, packed, unpacked
from .run_warnings import RunWarnings
from .run_watchers import PassWatcher, RunWatcher

log = logging.getLogger(__name__)

MAX_BAD_FRAMES_IN_A_ROW = 20
"""After more unusable frames in a row than this, the run stops; a lost camera is looked for until
the end."""
READ_AHEAD = 4
"""Number of frames of a recording on disk that another thread decodes in advance."""
_PLAIN = ("online_scores", "next_position", "bad_in_a_row")
"""Fields of a run that a checkpoint holds as they are."""


@runtime_checkable
class Frames(Protocol):
    """Frames in order; one that cannot be used raises a ``SequenceError``, and reading can continue
    after it."""

    def __next__(self) -> Frame: ...

    def close(self) -> None:
        """Stop: no more frames will be read."""
        ...


class MappingRun:
    """A sequence and the mapper that maps it.

    ``online()`` and ``optimise()`` are generators: the caller (a progress bar, a widget, a plain
    loop) sees every step and may stop after any of them. Between two steps the state is complete,
    so a run can be saved and resumed there.

    Args:
        sequence: The sequence to map, from ``open_sequence`` or ``apply_options``.
        mapper: The mapper, such as ``GSFusion(config)``; one that has a map already continues it.
        source: How the sequence was opened (path, format), written to config.json so that it can be
            opened again.
        clock: Of the run, if it began before, to open the data.
        parent: The run whose map the mapper began with, as results name it.

    Raises:
        SequenceError: The data has no poses, and the settings do not ask to track them.
    """

    resumable = True
    """Whether an interrupted run can be continued from its checkpoint."""

    def __init__(
        self,
        sequence: OpenedSequence,
        mapper: Mapper,
        *,
        source: dict[str, Any] | None = None,
        clock: RunClock | None = None,
        parent: dict[str, Any] | None = None,
    ):
        if not isinstance(mapper, Mapper):
            raise KindError(
                f"expected a mapper, such as GSFusion(config), got {type(mapper).__name__}"
            )
        know_system(mapper)
        self.mapper: Any = mapper
        if self.mapper.config.tracking.poses == "given" and not has_poses(sequence):
            raise SequenceError(
                f"{sequence.name} has no poses; set tracking.poses = 'tracked' to track the camera"
            )
        self.clock = clock or RunClock()
        """Where the time of the run goes."""
        self.sequence = sequence
        self.source = source or {}
        self.parent = parent or {}
        """The run whose map this one goes on in: its folder and the hashes of its maps; empty if
        there is none."""
        self.data_files = data_files(sequence) if source else {}
        """Path -> hash of the content of every file of the recording that the run reads, when it
        began."""
        self._data_files = packed(self.data_files)
        self.steps: list[StepReport] = []
        self._step_log = StepLog()
        self.online_scores: dict[str, float] = {}
        """PSNR of the map after the scan, before the global optimisation."""
        self.timestamps_s: list[float] = []
        self.hashes: dict[str, str] = {}
        """SHA-256 of each written map."""
        self.warnings = RunWarnings()
        self.global_passes = GlobalPasses(self.mapper, self.clock, self.warnings)
        """The optimisation after the scan."""
        self.views: MappedViews = RecordedViews(self)
        """The mapped frames that can be read again."""
        for note in self.mapper.notes:
            self.warnings.warn(note)
        if not has_poses(sequence) and len(sequence.held_out):
            self.warnings.warn(
                f"{sequence.name} has no poses: each held-out frame is scored where depth and "
                "brightness fit the map (--data.hold-out-every 0 maps all frames)"
            )
        self.localised: tuple[Any, dict[int, Tensor]] | None = None
        """A state of the map, and frame -> pose of the held-out frames that were aligned with
        it."""
        self.moved: MovedSurfaces | None = None
        """Takes out of the map of an earlier run what its frames see through, or keeps it; None in
        a run with a map of its own."""
        self.next_position = 0
        self.bad_in_a_row = 0
        """Number of unusable frames directly before ``next_position``."""
        self.after_step: Callable[[], None] = lambda: None
        """Called after every frame and every step of the optimisation, when the state is
        complete."""
        self.watchers: list[RunWatcher] = []
        self._watch = QuietWatch()
        self._range_watch = RangeWatch()
        self.store: CheckpointStore | None = None
        """Where the last checkpoint was saved, or read; it knows what need not be written again."""
        self.status = "running"
        """"running", "complete", "interrupted" (by the user) or "stopped" (the data ended with an
        error)."""

    def __repr__(self) -> str:
        return f"MappingRun({self.sequence.name}, {self.status}, {self.mapper!r})"

    @property
    def poses(self) -> list[torch.Tensor]:
        """Camera-to-world pose of every frame of this run, as given or as tracked and corrected so
        far."""
        return self.mapper.trajectory.poses[self.n_earlier :]

    @property
    def n_earlier(self) -> int:
        """Number of frames that the mapper mapped before this run."""
        return self.mapper.n_frames - len(self.steps)

    def online(self) -> Generator[StepReport, None, None]:
        """Map the remaining frames one by one; those that cannot be used are skipped and listed in
        ``warnings``.

        It ends early if a frame was undone because ``mapper.guard.stop_wanted`` asks for it; that
        frame is then the next one.

        Raises:
            SequenceError: No frame could be mapped; the message gives the first reason.
        """
        with contextlib.closing(self.frame_by_frame()) as reports:
            for report in reports:
                if report is not None:
                    yield report

    def frame_by_frame(self) -> Generator[StepReport | None, None, None]:
        """As ``online``, and None for each frame that was skipped: while the camera is looked for,
        the caller can say so, or stop."""
        frames = self.frames()
        self._watch.begin(self)
        try:
            while (outcome := self._next_step(frames)) != "end":
                if isinstance(outcome, StepReport):
                    self.after_step()
                    yield outcome
                else:
                    yield None
            self._watch.look(self, None)
            self._range_watch.look(self, None)
        except FrameUndone:  # the run is asked to stop
            return
        finally:
            frames.close()
        if not self.steps:
            raise SequenceError(self._why_nothing())

    def _next_step(self, frames: Frames) -> StepReport | Literal["skipped", "end"]:
        """Map the next frame and count it, or skip it; Ctrl-C takes effect before both or after
        both."""
        try:
            with self.clock("reading"):
                frame = next(frames)
        except StopIteration:
            return "end"
        except SequenceError as e:
            return self._skip(e)
        with DelayedInterrupt():
            try:
                with self.clock("mapping"):
                    report = self.mapper.step(frame)
            except SequenceError as e:
                return self._skip(e)
            self.bad_in_a_row = 0
            self.steps.append(report)
            self.timestamps_s.append(frame.timestamp_s)
            self._passed(frame)
            if self.moved is not None:
                with self.clock("mapping"):
                    self.moved.look(frame)
            for sentence in self.mapper.reports.step_warnings(frame, report):
                self.warnings.warn(sentence)
            self._watch.look(self, frame)
            self._range_watch.look(self, frame)
        for watcher in self.watchers:
            watcher.frame_mapped(self.mapper, frame, report)
        return report

    def _skip(self, error: SequenceError) -> Literal["skipped", "end"]:
        """Record a frame that could not be used; "end": there were too many in a row.

        Raises:
            SequenceError: ``error``, if it concerns more than one frame.
        """
        if not self._can_go_on(error):
            raise error
        self.bad_in_a_row += 1
        self._passed(None)
        if self.bad_in_a_row <= MAX_BAD_FRAMES_IN_A_ROW:
            self.warnings.warn(f"skipped a frame: {error}")
            return "skipped"
        if self.mapper.localiser.frames_lost:
            if self.bad_in_a_row == MAX_BAD_FRAMES_IN_A_ROW + 1:
                is_looking = self.mapper.localiser.is_before_first_look
                state = "not located yet" if is_looking else "lost"
                self.warnings.warn(
                    f"the camera is {state}; it is looked for in every frame until the recording "
                    "ends"
                )
            return "skipped"
        self.status = "stopped"
        self.warnings.warn(
            f"stopped after {self.bad_in_a_row} unusable frames in a row; everything mapped before "
            "is kept"
        )
        return "end"

    def frames(self) -> Frames:
        """The remaining frames; those on disk are decoded in advance."""
        view = self.sequence.mapping
        return read_ahead(
            view, start=self.next_position, depth=READ_AHEAD if _is_on_disk(view) else 0
        )

    def extra_metrics(self) -> dict[str, Any]:
        """Metrics that only this kind of run has."""
        return {}

    def optimise(self) -> Iterator[GlobalStep]:
        """Run the remaining passes of the global optimisation, continuing an interrupted pass."""
        for step in self.global_passes.steps():
            self.after_step()
            for watcher in self.watchers:
                if isinstance(watcher, PassWatcher):
                    watcher.optimised(self.mapper, step)
            yield step

    def constant_tensors(self) -> list[Tensor]:
        """Tensors of the state that never change."""
        kept = [] if self.moved is None else list(self.moved.kept or ())
        files = self.mapper.files.constant_tensors()
        return [*files, self._data_files, *self._step_log.blocks, *kept]

    def stream(self) -> dict[str, Any]:
        """Description of a source that cannot be opened again, if the run can be finished without
        it; else empty."""
        return {}

    @property
    def can_be_saved(self) -> bool:
        """Whether a checkpoint can be saved now and used later."""
        return self.resumable and not self.mapper.guard.half_mapped

    def state_dict(self) -> dict[str, Any]:
        """The state of the run without its mapper, as tensors and plain values."""
        return {
            "data_files": self._data_files,
            "onto": packed(self.parent),
            "moved": None if self.moved is None else self.moved.state_dict(),
            "steps": self._step_log.state_dict(self.steps),
            "timestamps_s": torch.tensor(self.timestamps_s, dtype=torch.float64),
            "clock": self.clock.state_dict(),
            **self.warnings.state_dict(),
            **self.global_passes.state_dict(),
            **{name: copy.copy(getattr(self, name)) for name in _PLAIN},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.parent = unpacked(state["onto"]) if "onto" in state else {}
        if state.get("moved") is not None:
            self.moved = MovedSurfaces(self.mapper)
            self.moved.load_state_dict(state["moved"])
        self.steps = self._step_log.load_state_dict(state["steps"])
        self.timestamps_s = state["timestamps_s"].tolist()
        self.clock.load_state_dict(state.get("clock", {}))
        for name in _PLAIN:
            setattr(self, name, state[name])
        self.warnings.load_state_dict(state)
        self.global_passes.load_state_dict(state)

    def _passed(self, frame: Frame | None) -> None:
        """Count a frame that was mapped, or could not be used (None)."""
        self.next_position += 1

    def _can_go_on(self, error: SequenceError) -> bool:
        """Whether the error concerns only one frame."""
        return True

    def _why_nothing(self) -> str:
        n = len(self.sequence.mapping)
        if not self.warnings:
            return f"none of the {n} frames could be mapped"
        reason = self.warnings[0].removeprefix("skipped a frame: ")
        return f"none of the {n} frames could be mapped, the first because {reason}"


def has_poses(view: FrameSubset) -> bool:
    """Whether the data came with poses."""
    return getattr(view.source, "has_poses", True)


def lost_in_words(run: MappingRun) -> str:
    """That the camera is looked for, and since how many frames; "" if it is not."""
    localiser = run.mapper.localiser
    since = f": {run.bad_in_a_row} frames so far" if run.bad_in_a_row else ""
    if localiser.is_before_first_look:
        return f"looking for the place in the map{since}"
    return f"the camera is lost, looking for it{since}" if localiser.frames_lost > 0 else ""


def _is_on_disk(view: FrameSubset) -> bool:
    """Whether the frames are decoded from files, even if they are changed afterwards."""
    source: Any = view
    while not isinstance(source, RecordedSequence) and hasattr(source, "source"):
        source = source.source
    return isinstance(source, RecordedSequence)
