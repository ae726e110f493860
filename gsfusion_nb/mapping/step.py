"""What every frame step needs: checks of the frame, all of it or nothing, the clock, and the
report."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import also_observing
from ..checks import check_colours, check_finite, check_pose
from ..errors import ArgumentError, BadFrameError, ForeseenError
from ..geometry.operands import check_place, check_plausible_camera
from ..interrupts import DelayedInterrupt, undisturbed, while_compiling
from ..types import Frame


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """Report on one mapped frame."""

    frame_index: int
    n_seeds: int
    """Number of new Gaussians from this frame."""
    n_gaussians: int
    """Number of Gaussians in the map after the step."""
    is_keyframe: bool
    losses: tuple[float, ...]
    """Loss before each optimisation step on this frame."""
    psnr_before_db: float = math.nan
    """PSNR of this view before its optimisation, dB; NaN if not measured. Each system decides
    whether its new Gaussians are drawn for it (GSFusion draws them, RTG-SLAM does not)."""
    psnr_after_db: float = math.nan
    """PSNR of this view after its optimisation, dB; NaN if not measured. A system may take the last
    value that needs no extra rendering (GSFusion: just before the last optimisation step; RTG-SLAM
    renders at the end of the step)."""
    n_steps: int = 0
    """Number of gradient steps in this frame, on any view."""
    n_not_finite: int = 0
    """Number of Gaussians that became NaN or infinite in these steps, and were removed."""
    n_blocks: int = 0
    """Number of voxel blocks in the TSDF map after the step, if there is one."""
    counts: dict[str, int] = field(default_factory=dict)
    """What only this system counts, by name, such as the number of Gaussians by state and of
    changes of state."""
    tracking: dict[str, Any] = field(default_factory=dict)
    """How the frame was tracked: status, rms_m, inlier_share. Empty for given poses."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time by stage. Each system names its stages, such as tsdf, seeding, optimise; "tracking"
    is the time for the pose, which a run reports separately."""

    @property
    def total_seconds(self) -> float:
        """Wall time of the whole step."""
        return sum(self.seconds.values())

    @property
    def in_words(self) -> str:
        """For a line of progress: the PSNR, if it was measured, and the number of Gaussians."""
        psnr = "" if math.isnan(self.psnr_after_db) else f"PSNR {self.psnr_after_db:.1f} dB, "
        return f"{psnr}{self.n_gaussians:,} Gaussians"


@dataclass(frozen=True, kw_only=True, eq=False)
class GlobalStep:
    """One step on one keyframe in the optimisation after the scan."""

    pass_index: int
    """Number of the pass over the keyframes, from 0."""
    step: int
    """Steps done so far in this optimisation, from 1."""
    n_steps: int
    """Steps in total."""
    loss_value: Float[Tensor, ""]
    """Loss before the step, on the device of the map."""

    @property
    def loss(self) -> float:
        """Loss before the step. On a GPU this waits until the step is done."""
        return float(self.loss_value)


class StageClock:
    """Adds up wall time by stage name: ``with clock("tsdf"): ...``."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    @contextlib.contextmanager
    def operation(self, name: str, *, of: str) -> Iterator[None]:
        """Context in which the time of an operation counts as a stage of its own, not as part of
        stage ``of``."""
        seconds = 0.0

        def time_calls(called: str, f: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
            nonlocal seconds
            start = time.perf_counter()
            try:
                return f(*args, **kwargs)
            finally:
                seconds += time.perf_counter() - start if called == name else 0.0

        try:
            with also_observing(time_calls):
                yield
        finally:
            self.seconds[of] = self.seconds.get(of, 0.0) - seconds
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds


ViewStep = tuple[Float[Tensor, ""], Float[Tensor, ""]]
"""Loss, and mean squared error of the picture, before a gradient step on one view."""


def as_floats(steps: list[ViewStep]) -> list[list[float]]:
    """Loss and mean squared error of each step as numbers. A GPU is waited for once."""
    return torch.stack([torch.stack(step) for step in steps]).tolist() if steps else []


def psnr_from_mse(mse: float) -> float:
    """PSNR in dB of images in 0..1; at most 100, also for equal images."""
    return -10 * math.log10(max(mse, 1e-10))


BLACK = 2.5 / 255
"""A frame without any brighter pixel counts as black."""


def check_frame(
    frame: Frame, device: torch.device | None = None, *, needs_depth: bool = False
) -> Frame:
    """The frame itself on ``device``, if it can be mapped.

    Args:
        frame: The frame to check.
        device: Device to move it to; by default it stays where it is. The host waits for a GPU
            once.
        needs_depth: Refuse a frame without any depth.

    Raises:
        BadFrameError: the pose is not rigid or too far away, the camera is impossible
            (``check_plausible_camera``), an image holds a NaN or colours outside 0..1, the picture
            is black, or it has no depth with ``needs_depth``.
    """
    try:
        check_pose(f"T_WC of frame {frame.index}", frame.T_WC_cpu)
        check_place(f"T_WC of frame {frame.index}", frame.T_WC_cpu)
        check_plausible_camera("its camera", frame.camera)
        frame = frame if device is None else frame.to(device)
        _check_images(frame, needs_depth)
    except ValueError as e:
        raise BadFrameError(f"frame {frame.index} cannot be mapped: {e}") from None
    return frame


def _check_images(frame: Frame, needs_depth: bool) -> None:
    extremes = torch.stack(
        [x.float() for image in (frame.depth_m, frame.colour) for x in torch.aminmax(image)]
    )
    depth_low, depth_high, low, high = extremes.tolist()  # NaN if any value is
    if frame.is_8_bit:
        low = low / 255
        high = high / 255
    if not (math.isfinite(depth_low) and math.isfinite(depth_high)):
        check_finite(f"depth_m of frame {frame.index}", frame.depth_m)
    check_colours(f"rgb of frame {frame.index}", frame.colour, (low, high))
    if high < BLACK:
        raise ArgumentError("its picture is black; expected a picture with brighter pixels")
    if needs_depth and not depth_high > 0:
        raise ArgumentError("it has no depth at all; expected pixels with depth above 0")


class HalfMappedError(ForeseenError, RuntimeError):
    """A map contains only a part of a frame; it cannot map more frames, because the rest of that
    frame is lost."""


class FrameUndone(KeyboardInterrupt):
    """A frame was undone because the program is asked to stop; the map is as before it."""


class FrameGuard:
    """Lets a mapper map one frame at a time, and remembers a frame that it could not finish.

    What can fail because of the user's code or data comes before ``changes_begin``; if it fails,
    the map is unchanged. From there until ``changes_stay`` a frame can be undone, if the mapper has
    given a function for it. Otherwise only a failure of the machine (memory) or of the program can
    leave a frame half mapped; the map then refuses more frames.
    """

    def __init__(self):
        self.stop_wanted: Callable[[], bool] = lambda: False
        """Whether the program is asked to stop; a frame that can be undone is then given up. A run
        sets it."""
        self.end_wanted: Callable[[], bool] = lambda: False
        """Likewise, also where nothing is mapped yet; asked while kernels are compiled."""
        self.half_mapped = ""
        """Which frame was only half mapped, and why; empty if none was."""
        self._lock = threading.Lock()
        self._index = -1
        self._changing = False
        self._undo: Callable[[], None] | None = None

    @contextlib.contextmanager
    def while_mapping(self, index: int) -> Iterator[None]:
        """Context for the step of a mapper on the frame with this index.

        After ``changes_begin``, Ctrl-C takes effect only when the frame is mapped, or at
        ``may_stop``.

        Raises:
            RuntimeError: another thread is in a step. HalfMappedError: an earlier frame was only
                half mapped.
        """
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                f"frame {index} was given while another thread maps frame {self._index}; give one "
                "frame at a time"
            )
        try:
            if self.half_mapped:
                raise HalfMappedError(
                    f"{self.half_mapped}; this map takes no more frames: continue from the run's "
                    "last checkpoint (resume_mapping), or with a new mapper"
                )
            self._index = index
            self._changing = False
            self._undo = None
            with DelayedInterrupt() as interrupt:
                interrupt.allow()
                try:
                    with self._heard_while_compiling():
                        yield
                except BaseException as e:
                    if self._changing:
                        self.half_mapped = (
                            f"frame {index} was only half mapped ({type(e).__name__}: {e})"
                        )
                    raise
        finally:
            self._undo = None
            self._lock.release()

    @contextlib.contextmanager
    def while_optimising(self, undo: Callable[[], None]) -> Iterator[None]:
        """Context for a step after the scan; if it fails, ``undo`` brings back the map before it.

        Ctrl-C takes effect after the step, or at ``may_stop``.
        """
        with DelayedInterrupt():
            self.changes_begin(undo)
            try:
                with self._heard_while_compiling():
                    yield
            except BaseException:
                self.undo()
                raise
            finally:
                self._changing = False
                self._undo = None

    @contextlib.contextmanager
    def _heard_while_compiling(self) -> Iterator[None]:
        """Context in which Ctrl-C ends the compilation of a kernel, if what was changed by then can
        be undone."""

        def may_end() -> None:
            if self._changing and self._undo is None:
                return
            DelayedInterrupt.deliver()
            if self.stop_wanted():
                raise FrameUndone
            if self.end_wanted():
                raise KeyboardInterrupt

        while_compiling.append(may_end)
        try:
            yield
        finally:
            while_compiling.remove(may_end)

    def changes_begin(self, undo: Callable[[], None] | None = None) -> None:
        """Declare that the frame changes the map from here on; ``undo`` would bring back the map of
        now."""
        DelayedInterrupt.delay()
        self._changing = True
        self._undo = undo

    def may_stop(self) -> None:
        """Called between two gradient steps. If the frame can be undone, Ctrl-C and SIGTERM take
        effect here.

        Raises:
            FrameUndone: the program is asked to stop. KeyboardInterrupt: Ctrl-C, where nobody else
                handles it.
        """
        if self._undo is None:
            return
        DelayedInterrupt.deliver()
        if self.stop_wanted():
            raise FrameUndone

    def changes_stay(self) -> None:
        """Declare that what follows cannot be undone."""
        self._undo = None

    @undisturbed
    def undo(self) -> bool:
        """Undo what the frame has changed; returns whether the map is now as it was before the
        frame."""
        DelayedInterrupt.delay()
        if self._undo is not None:
            self._undo()
            self._changing = False
        return not self._changing
