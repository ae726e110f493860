"""The watch of a run, as the run calls it: it warns once, and whatever happens in it, the run goes
on."""

import dataclasses
from typing import Any, Protocol, runtime_checkable

from ..types import Frame
from .frame_watch import ADVICE, FrameWatch
from .run_warnings import RunWarnings


@runtime_checkable
class WatchedRun(Protocol):
    """What a watch needs to know of a run."""

    mapper: Any
    sequence: Any
    steps: list[Any]
    warnings: RunWarnings
    resumable: bool


class QuietWatch:
    """The watch of one run, until it has said something; whatever happens in it, the run goes
    on."""

    def __init__(self):
        self._watch: FrameWatch | None = None
        self._is_over = False

    def begin(self, run: WatchedRun) -> None:
        """Before the first frame, or the first one after a checkpoint."""
        self._is_over = any(sentence.endswith(ADVICE) for sentence in run.warnings)

    def look(self, run: WatchedRun, frame: Frame | None) -> None:
        """Look at the frame that was mapped last; None: no more will come. What is doubtful the run
        warns of."""
        if self._is_over:
            return
        try:
            sentence = self._look(run, frame)
        except Exception as e:
            sentence = (
                f"whether the frames agree is not watched any further ({type(e).__name__}: "
                f"{e}); {ADVICE}"
            )
        if sentence:
            self._is_over = True
            self._watch = None
            run.warnings.warn_once(sentence)

    def _look(self, run: WatchedRun, frame: Frame | None) -> str:
        poses = run.mapper.trajectory.poses[run.mapper.n_frames - len(run.steps) :]
        if self._watch is None:
            self._watch = FrameWatch(is_tracking=run.mapper.localiser.is_tracking)
            earlier = len(run.steps) - (frame is not None)
            if earlier > 0 and run.resumable:
                earlier_poses = poses if frame is None else poses[:-1]
                self._watch.look_again(
                    earlier, lambda number: _frame_of(run, number), earlier_poses
                )
        return self._watch.end(poses) if frame is None else self._watch.see(frame, poses)


def _frame_of(run: WatchedRun, number: int) -> Frame:
    """A frame that was mapped, read once more."""
    n_earlier = run.mapper.n_frames - len(run.steps)
    index = run.mapper.trajectory.frame_indices[n_earlier + number]
    return dataclasses.replace(run.sequence.mapping, positions=[index])[0]
