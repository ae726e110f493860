"""All of a frame or nothing: what a frame changes in a mapper, and how it is undone."""

import contextlib
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any

from ..backends import runs_learners_code
from ..errors import BadFrameError
from ..interrupts import DelayedInterrupt, undisturbed
from ..seeding import copy_memory
from .after_scan import KeyframePasses
from .frame_guard import FrameGuard
from .lost_rows import remove_lost

Undo = Callable[[], None]
"""Brings back what was there when it was made."""


class Transaction:
    """Makes a frame, or a step after the scan, change all of a mapper or nothing.

    A frame is mapped in the context ``with transaction:``, inside ``guard.while_mapping``. If it
    fails before ``changes``, or in changes that can be undone, all is as it was.

    What a frame reads and cannot change goes first, then ``changes``. A part of a mapper that a
    frame changes is undone by its snapshot: those of every mapper are taken here, a system
    ``protect``s its own.

    Args:
        mapper: The ``Mapper``.
    """

    def __init__(self, mapper: Any):
        self.guard = FrameGuard()
        """Lets one frame in at a time, and knows whether what it changed can be undone."""
        self._mapper = mapper
        self._snapshots: list[Callable[[], Undo]] = []
        self._ends: list[Callable[[], None]] = []
        self._random_numbers: dict[str, Any] = {}
        self._rule_memory: dict[str, Any] = {}
        """As they were before the frame that is mapped."""

    def protect(self, snapshot: Callable[[], Undo], end: Callable[[], None] | None = None) -> None:
        """Undo one more part of the mapper with a frame.

        Args:
            snapshot: Called before a change; what it returns undoes the change.
            end: Called when the change stays.
        """
        self._snapshots.append(snapshot)
        if end is not None:
            self._ends.append(end)

    @undisturbed
    def __enter__(self) -> None:
        mapper = self._mapper
        self._random_numbers = mapper.random.state_dict()
        self._rule_memory = copy_memory(mapper.rule_in_use.memory)
        mapper.lost.begin_frame()

    @undisturbed
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        mapper = self._mapper
        if error is not None and self.guard.undo():
            mapper.gaussians.undo_log.end()
            mapper.random.load_state_dict(self._random_numbers)
            mapper.rule_in_use.set_memory(self._rule_memory)
            mapper.localiser.take_back(was_refused=isinstance(error, BadFrameError))
        self._rule_memory = {}
        mapper.after_steps.frame_ends()
        mapper.parts.end_frame()
        if error is None and mapper.passes.begun:
            mapper.passes = KeyframePasses()  # with more frames, the passes start again

    @contextlib.contextmanager
    def changes(self, *, undoable: bool = False) -> Iterator[None]:
        """Context in which a frame changes the map.

        Args:
            undoable: Keep what changes until the end of the context (``UndoLog.will_change``).
                A failure in it then leaves the map as it was, and Ctrl-C takes effect between two
                gradient steps. While foreign code runs that is always so, and the whole map is
                kept.
        """
        DelayedInterrupt.delay()
        mapper = self._mapper
        runs_foreign_code = (
            mapper.after_steps.edits or mapper.training.names or runs_learners_code()
        )
        is_first = not mapper.n_frames  # kernels are compiled in it, which Ctrl-C ends
        can_undo = undoable or runs_foreign_code or is_first
        self.guard.changes_begin(self.snapshot() if can_undo else None)
        if runs_foreign_code:
            mapper.gaussians.undo_log.will_change()
        yield
        remove_lost(mapper)
        if not is_first:
            self.keep()

    @contextlib.contextmanager
    def step_after_scan(self) -> Iterator[None]:
        """Context of a step of the optimisation after the scan; if it fails, all is as before."""
        mapper = self._mapper
        undo_changes = self.snapshot()
        passes = mapper.passes.state_dict()
        random_numbers = mapper.random.state_dict()
        memory = copy_memory(mapper.rule_in_use.memory) if mapper.after_steps.edits else None

        def undo() -> None:
            undo_changes()
            mapper.passes.load_state_dict(passes)
            mapper.random.load_state_dict(random_numbers)
            if memory is not None:
                mapper.rule_in_use.set_memory(memory)

        with self.guard.while_optimising(undo):
            yield

    def keep(self) -> None:
        """What was changed until now stays; Ctrl-C waits."""
        DelayedInterrupt.delay()
        self.guard.changes_stay()
        self._mapper.gaussians.undo_log.end()
        for end in self._ends:
            end()

    def snapshot(self) -> Undo:
        """A function that undoes what is changed in the mapper from now on."""
        mapper = self._mapper
        undo_rows = mapper.gaussians.undo_log.begin()
        n_steps = mapper.after_steps.n_steps
        keyframes = mapper.keyframes.snapshot()
        lost_counts = mapper.lost.counts
        undo_parts = mapper.parts.snapshot()
        undo_others = [snapshot() for snapshot in self._snapshots]

        def undo() -> None:
            undo_rows()
            mapper.gaussians.undo_log.end()
            mapper.after_steps.n_steps = n_steps
            mapper.lost.counts = lost_counts
            undo_parts()
            mapper.keyframes.restore(keyframes)
            for undo_other in undo_others:
                undo_other()

        return undo
