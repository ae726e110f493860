"""One run over a sequence: the loop, the clock, interruption, checkpoints. What comes out is written by ``outputs``."""

import dataclasses
import logging
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from ..checks import check_number, check_saved, check_whole
from ..data import OpenedSequence, RecordedSequence, SequenceError, SequenceView
from ..data.stream import read_ahead
from ..errors import shown
from ..export import CheckpointStore, Saved
from ..mapping import DelayedInterrupt, GlobalStep, Mapper, StepReport, system_of
from ..types import Frame
from .posed_frames import has_poses
from .random_state import random_state
from .run_folder import CHECKPOINTS
from .step_log import StepLog

log = logging.getLogger(__name__)

MAX_BAD_FRAMES_IN_A_ROW = 20
"""After this many unusable frames in a row the rest of the recording counts as broken."""
READ_AHEAD = 4
"""This many frames of a recording on disk are decoded in advance, on another thread."""


@runtime_checkable
class Frames(Protocol):
    """Frames in order; one that cannot be used raises a ``SequenceError``, and the next can follow."""

    def __next__(self) -> Frame: ...

    def close(self) -> None:
        """No more are wanted."""
        ...


class MappingRun:
    """A sequence and the mapper that works through it.

    ``online()`` and ``optimise()`` are generators: the caller (a progress bar, a widget, a plain loop) sees every
    step and may stop after any. Between two steps the state is complete, so a run can be saved and resumed there.

    Args:
        sequence: What to map, from ``open_sequence`` or ``apply_options``.
        mapper: Who maps it, such as ``GSFusion(config)``; one that has mapped already goes on with its map.
        source: How the sequence was opened (path, format), written to config.json so that it can be opened again.

    Raises:
        SequenceError: the data has no poses, and the settings do not ask to track them.
    """

    resumable = True
    """A run that was interrupted can go on from its checkpoint."""

    def __init__(
        self,
        sequence: OpenedSequence,
        mapper: Mapper,
        *,
        source: dict[str, Any] | None = None,
    ):
        if not isinstance(mapper, Mapper):
            raise TypeError(f"expected a mapper, such as GSFusion(config), got {type(mapper).__name__}")
        self.mapper: Any = mapper
        if self.mapper.config.tracking.poses == "given" and not has_poses(sequence):
            raise SequenceError(
                f"{sequence.name} came without poses; expected tracking.poses = 'tracked' in the settings"
            )
        self.sequence = sequence
        self.source = source or {}
        self.steps: list[StepReport] = []
        self._step_log = StepLog()
        self.global_losses: list[float] = []
        """Mean loss of each finished pass of the global optimisation."""
        self._pass_losses: list[torch.Tensor] = []
        self.online_scores: dict[str, float] = {}
        """PSNR of the map as the scan left it, before the global optimisation."""
        self.timestamps_s: list[float] = []
        self.hashes: dict[str, str] = {}
        """SHA-256 of each map, once it is written."""
        self.warnings: list[str] = []
        self.next_position = 0
        self.bad_in_a_row = 0
        """Frames just before ``next_position`` that could not be used."""
        self.seconds_global = 0.0
        self.is_optimised = False
        """The optimisation after the scan is done."""
        self.after_step: Callable[[], None] = lambda: None
        """Called after every frame and every step of the optimisation, when the state is complete."""
        self._stores: dict[Path, CheckpointStore] = {}
        self.status = "running"
        """"running", "complete", "interrupted" (asked to stop) or "stopped" (the data broke off)."""

    def __repr__(self) -> str:
        return f"MappingRun({self.sequence.name}, {self.status}, {self.mapper!r})"

    @property
    def system(self) -> str:
        """Name of the system that maps."""
        return system_of(self.mapper.config)

    @property
    def poses(self) -> list[torch.Tensor]:
        """Camera-to-world pose of every mapped frame, as given or as tracked and corrected so far."""
        return self.mapper.localiser.poses

    def online(self) -> Generator[StepReport, None, None]:
        """Map the frames that are left, one by one; those that cannot be used are skipped and named in ``warnings``.

        Raises:
            SequenceError: not one of the frames could be mapped; names the first reason.
        """
        frames = self.frames()
        try:
            while True:
                try:
                    frame = next(frames)
                    report = self._map(frame)
                except StopIteration:
                    break
                except SequenceError as e:
                    if not self._can_go_on(e):
                        raise
                    if self._skip(e):
                        continue
                    break
                for sentence in self.mapper.step_warnings(frame, report):
                    self._warn(sentence)
                self.after_step()
                yield report
        finally:
            frames.close()
        if not self.steps:
            raise SequenceError(self._why_nothing())

    def _map(self, frame: Frame) -> StepReport:
        """Map a frame and count it, both or neither: Ctrl-C in between waits."""
        with DelayedInterrupt():
            report = self.mapper.step(frame)
            self.bad_in_a_row = 0
            self.steps.append(report)
            self.timestamps_s.append(frame.timestamp_s)
            self._passed(frame)
        return report

    def _skip(self, error: SequenceError) -> bool:
        """A frame could not be used; whether to go on with the next."""
        self.bad_in_a_row += 1
        self._passed(None)
        self._warn(f"skipped a frame: {error}")
        if self.bad_in_a_row <= MAX_BAD_FRAMES_IN_A_ROW:
            return True
        self.status = "stopped"
        self._warn(f"stopped after {self.bad_in_a_row} unusable frames in a row; everything mapped before is kept")
        return False

    def frames(self) -> Frames:
        """The frames that are left; those on disk are decoded in advance."""
        view = self.sequence.mapping
        return read_ahead(view, start=self.next_position, depth=READ_AHEAD if _is_on_disk(view) else 0)

    def mapped_views(self, limit: int) -> SequenceView:
        """At most ``limit`` of the frames mapped so far, evenly spread; 0: all of them."""
        mapped, n = self.sequence.mapping, self.next_position
        few = limit and n > limit
        picks = [round(i * (n - 1) / max(limit - 1, 1)) for i in range(limit)] if few else range(n)
        return dataclasses.replace(mapped, positions=[mapped.positions[i] for i in picks])

    def extra_metrics(self) -> dict[str, Any]:
        """Numbers that only this kind of run has."""
        return {}

    def optimise(self) -> Iterator[GlobalStep]:
        """Run the passes of the global optimisation that are left, beginning where an interrupted one stood."""
        passes = self.mapper.n_passes - self.mapper.passes.done
        start = time.perf_counter()
        for step in self.mapper.global_optimise(passes):
            self._pass_losses.append(step.loss_value)
            if not self.mapper.passes.queue:
                self.global_losses.append(float(torch.stack(self._pass_losses).mean()))
                self._pass_losses = []
            self.seconds_global += time.perf_counter() - start
            self.after_step()
            yield step
            start = time.perf_counter()
        self.is_optimised = True

    def save_checkpoint(self, folder: Path) -> Saved:
        """Write everything needed to resume to ``folder``: only what has changed since the last time."""
        document = {
            "system": self.system,
            "run": self.state_dict(),
            "source": self.source or self.stream(),
            "mapper": self.mapper.state_dict(),
            "random": random_state(),
        }
        store = self._stores.setdefault(folder, CheckpointStore(folder / CHECKPOINTS))
        return store.save(document, constant=self.constant_tensors())

    def constant_tensors(self) -> list[Tensor]:
        """Tensors of the state that never change."""
        return [*self.mapper.constant_tensors(), *self._step_log.blocks]

    def stream(self) -> dict[str, Any]:
        """What a checkpoint says of a source that cannot be opened again, if the run can be finished without it."""
        return {}

    @property
    def can_be_saved(self) -> bool:
        """A checkpoint can be taken now, and something can be made of it."""
        return self.resumable and not self.mapper.guard.half_mapped

    def has_checkpoint(self, folder: Path) -> bool:
        """Whether a checkpoint is in ``folder``."""
        return CheckpointStore(folder / CHECKPOINTS).exists

    def remove_checkpoints(self, folder: Path) -> None:
        """The run is complete: nothing is to be resumed."""
        self._stores.pop(folder, CheckpointStore(folder / CHECKPOINTS)).remove()

    def state_dict(self) -> dict[str, Any]:
        """Where the run stands, beside its mapper, as tensors and plain values."""
        return {
            "steps": self._step_log.state_dict(self.steps),
            "global_losses": list(self.global_losses),
            "pass_losses": torch.stack(self._pass_losses) if self._pass_losses else torch.zeros(0),
            "online_scores": dict(self.online_scores),
            "timestamps_s": torch.tensor(self.timestamps_s, dtype=torch.float64),
            "warnings": list(self.warnings),
            "next_position": self.next_position,
            "bad_in_a_row": self.bad_in_a_row,
            "seconds_global": self.seconds_global,
            "is_optimised": self.is_optimised,
        }

    def use_store(self, folder: Path, store: CheckpointStore) -> None:
        """Checkpoints in ``folder`` go on in this store."""
        self._stores[folder] = store

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` gave.

        Raises:
            ValueError: numbers that do not fit together.
        """
        self.steps = self._step_log.load_state_dict(state["steps"])
        check_saved("timestamps_s", state["timestamps_s"], (len(self.steps),), torch.float64)
        check_whole("next_position", state["next_position"], len(self.steps))
        check_whole("bad_in_a_row", state["bad_in_a_row"], 0)
        check_number("seconds_global", state["seconds_global"], 0)
        check_saved("pass_losses", state["pass_losses"], ("N",), finite=False)
        if not all(isinstance(text, str) for text in state["warnings"]):
            raise ValueError("warnings must be sentences")
        if not isinstance(state["is_optimised"], bool):
            raise ValueError(f"is_optimised must be True or False, got {shown(state['is_optimised'])}")
        self.global_losses = state["global_losses"]
        self._pass_losses = list(state["pass_losses"].to(self.mapper.device))
        self.online_scores = state["online_scores"]
        self.timestamps_s = state["timestamps_s"].tolist()
        self.warnings = state["warnings"]
        self.next_position = state["next_position"]
        self.bad_in_a_row = state["bad_in_a_row"]
        self.seconds_global = state["seconds_global"]
        self.is_optimised = state["is_optimised"]

    def _passed(self, frame: Frame | None) -> None:
        """A frame was mapped, or could not be used."""
        self.next_position += 1

    def _can_go_on(self, error: SequenceError) -> bool:
        """The error is of one frame."""
        return True

    def _why_nothing(self) -> str:
        reason = self.warnings[0].removeprefix("skipped a frame: ") if self.warnings else "there are none"
        return f"none of the {len(self.sequence.mapping)} frames could be mapped, the first because {reason}"

    def _warn(self, sentence: str) -> None:
        self.warnings.append(sentence)
        log.warning(sentence)


def _is_on_disk(view: SequenceView) -> bool:
    """Frames are decoded from files, whatever is applied to them afterwards."""
    source: Any = view
    while not isinstance(source, RecordedSequence) and hasattr(source, "source"):
        source = source.source
    return isinstance(source, RecordedSequence)
