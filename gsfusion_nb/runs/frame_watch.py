"""An observer beside a run: do the frames agree with each other as those of a right recording do?

It measures what ``gsfusion-nb check`` measures first, on small copies of the frames that are mapped
anyway, and says one sentence where they do not agree. It draws no random number and changes
nothing.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ..data.adjust.first_frames import (
    FirstAgreement,
    SmallFrame,
    agreement_of,
    pairs_of,
    stands_still,
)
from ..data.adjust.reprojection import Reprojection
from ..data.adjust.steps import (
    JUMP_ERROR,
    STEPS_AROUND,
    STILL_DEG,
    STILL_M,
    find_jumps,
    repeated_image,
)
from ..geometry import se3
from ..mapping.pose_jumps import jump_from
from ..mapping.usual_torch import usual_torch
from ..types import Frame

ADVICE = "run `gsfusion-nb check DATA`"
"""How each sentence ends."""

COMPARED = 12
"""Frames that are compared with each other: the first dozen, then every second of twice as many,
and so on."""
WIDEST = 8
"""The last comparison takes every eighth frame, up to the 89th."""
FEWEST = 4
"""Frames to compare."""
BETTER = 0.02
"""Frames that agree this much better under another reading are doubted: right recordings gain at
most 0.007, wrong ones 0.2 to 0.5 in the middle (docs/check.md has the distributions)."""
BETTER_OF_FEW = 0.1
"""The same for a run that ends before a whole dozen: four to eleven frames of a right recording
gain up to 0.053."""
LEAST_OVERLAP = 0.2
"""With fewer of the points on a measured depth, a chance agreement of few points ..."""
FAR_BETTER = 0.3
"""... must be this much better."""
LEAST_SHARE = 0.7
"""Of the points that fall on a measured depth so many agree with it: of right recordings 0.86 and
more."""
MOST_COLOUR = 0.75
"""Pictures that do not move as depth does differ so much of what they would if nothing had moved:
of right recordings at most 0.54, of pictures in another order 0.82 and more."""
_EXPLAINED = 0.5
"""Another reading explains frames that do not agree if it agrees to this share of the points on a
depth."""
_SETTLED = 3
"""Steps after one before it is judged."""
_CHANGE = 0.02
_CHANGE_OF_USUAL = 3.0
"""Depth that differs from that of the frame before, pixel by pixel, by less than this share, or
this many times the usual difference, has not changed as at another place."""
_LEAST_POINTS = 50
"""Of a pair of frames, to compare their depth."""


class FrameWatch:
    """Looks at every mapped frame of a run until it has said something.

    Args:
        is_tracking: Whether the poses are tracked. They may then jump where the camera is found
            again, and an image may be repeated.
    """

    def __init__(self, *, is_tracking: bool):
        self._is_tracking = is_tracking
        self._compared: list[tuple[int, SmallFrame]] = []
        """Frames to compare with each other, each with its number among those that were mapped."""
        self._spacing = 1
        self._is_judged = False
        """Whether these were compared as they are now."""
        self._n = 0
        self._last: Frame | None = None
        self._last_small: SmallFrame | None = None
        self._steps: list[dict[str, Any]] = []
        """The last steps from frame to frame."""

    def see(self, frame: Frame, poses: list[Float[Tensor, "4 4"]]) -> str:
        """Look at the frame that was mapped last; returns a sentence for the user, or "".

        Args:
            frame: The frame.
            poses: Camera-to-world poses of all frames mapped so far, as given or tracked.
        """
        with usual_torch():
            number = len(poses) - 1
            small = SmallFrame.of(frame)
            if self._last_small is not None and self._last_small.camera != small.camera:
                self._begin_again()
            sentence = self._step(frame, small, poses)
            self._last = frame
            self._last_small = small
            return sentence or self._keep(number, small, poses)

    def look_again(
        self,
        n: int,
        read: Callable[[int], Frame],
        poses: list[Float[Tensor, "4 4"]],
    ) -> None:
        """Be where a watch is that has seen the last ``n`` frames: look again at those it would
        still know.

        Args:
            n: Number of frames.
            read: Number among all mapped frames -> the frame.
            poses: Camera-to-world poses of all mapped frames.
        """
        first = len(poses) - n
        spacing = 1
        last_judged = -1
        while n > (COMPARED - 1) * spacing:
            last_judged = (COMPARED - 1) * spacing
            spacing *= 2
        compared_frames = set(range(0, n, spacing)) if spacing <= WIDEST else set()
        latest = range(max(0, n - 2 * STEPS_AROUND - 2), n)
        with usual_torch():
            for i in sorted(compared_frames.union(latest)):
                frame = read(first + i)
                small = SmallFrame.of(frame)
                if i in latest:
                    self._step(frame, small, poses[: first + i + 1])
                    self._last = frame
                    self._last_small = small
                if i in compared_frames:
                    self._compared.append((first + i, small))
        self._n = n
        self._spacing = spacing
        self._is_judged = max(compared_frames, default=0) <= last_judged

    def end(self, poses: list[Float[Tensor, "4 4"]]) -> str:
        """No more frames will come; returns a sentence for the user, or ""."""
        with usual_torch():
            return self._jump(n_after=0) or ("" if self._is_judged else self._judge(poses))

    def _begin_again(self) -> None:
        self._compared = []
        self._spacing = 1
        self._n = 0
        self._is_judged = False
        self._last = None
        self._last_small = None
        self._steps = []

    def _keep(
        self,
        number: int,
        small: SmallFrame,
        poses: list[Float[Tensor, "4 4"]],
    ) -> str:
        """Take every ``_spacing``-th frame, and compare when there are enough."""
        if self._spacing <= WIDEST and self._n % self._spacing == 0:
            self._compared.append((number, small))
            self._is_judged = False
        self._n += 1
        if len(self._compared) < COMPARED:
            return ""
        sentence = self._judge(poses)
        self._is_judged = True
        self._spacing *= 2
        self._compared = self._compared[::2] if self._spacing <= WIDEST else []
        return sentence

    def _judge(self, poses: list[Float[Tensor, "4 4"]]) -> str:
        if len(self._compared) < FEWEST:
            return ""
        frames = [small for _, small in self._compared]
        agreement = agreement_of(frames, [poses[number] for number, _ in self._compared])
        better = BETTER if len(frames) >= COMPARED else BETTER_OF_FEW
        doubt = doubt_of(agreement, better=better)
        return doubt and f"frames {frames[0].index} to {frames[-1].index} {doubt}; {ADVICE}"

    def _step(
        self,
        frame: Frame,
        small: SmallFrame,
        poses: list[Float[Tensor, "4 4"]],
    ) -> str:
        """Compare with the frame before."""
        if self._last is None or self._last_small is None:
            return ""
        turned_deg, moved_m = se3.motion(poses[-2], poses[-1])
        repeat = repeated_image(self._last, frame)
        pair = pairs_of(
            [self._last_small, small],
            poses[-2:],
            [(0, 1)],
        )
        previous = {
            "index": self._last.index,
            "timestamp_s": self._last.timestamp_s,
            "T_WC": poses[-2],
        }
        step = {
            "from": self._last.index,
            "to": frame.index,
            "turned_deg": turned_deg,
            "moved_m": moved_m,
            "seconds": frame.timestamp_s - self._last.timestamp_s,
            "is_told": bool(jump_from(previous, frame)),
            "error": _median_error(pair.moved()),
            "still": _median_error(stands_still(pair)),
            "repeated": bool(repeat),
        }
        self._steps = [*self._steps[-2 * STEPS_AROUND :], step]
        is_still = turned_deg <= STILL_DEG and moved_m <= STILL_M
        if not repeat or is_still or (self._is_tracking and repeat == "colour and depth"):
            return self._jump(n_after=_SETTLED)
        return (
            f"frame {frame.index} has the {repeat} of frame {self._last.index}, pixel by pixel, "
            f"although its pose is {100 * moved_m:.2g} cm and {turned_deg:.2g} degrees away "
            f"(usual: no image is repeated while the camera moves); {ADVICE}"
        )

    def _jump(self, *, n_after: int) -> str:
        """The first step that depth does not confirm, if ``n_after`` others came after it.

        A step over a pause may be longer. One that no camera makes is told by the mapper. Where the
        depth image changes, too, much more than in the other steps, the recording goes on at
        another place.
        """
        if self._is_tracking or all(step["error"] <= JUMP_ERROR for step in self._steps):
            return ""
        turn_deg, step_m, seconds, error, error_at_rest, is_repeat, is_told = (
            np.array([step[name] for step in self._steps])
            for name in (
                "turned_deg",
                "moved_m",
                "seconds",
                "error",
                "still",
                "repeated",
                "is_told",
            )
        )
        usual = float(np.nanmedian(error_at_rest)) if np.isfinite(error_at_rest).any() else 0.0
        goes_on = ~(error_at_rest <= max(_CHANGE, _CHANGE_OF_USUAL * usual))
        longer = np.maximum(1.0, seconds / max(float(np.median(seconds)), 1e-6))
        frozen = is_repeat | np.append(is_repeat[1:], False)
        candidates = find_jumps(turn_deg / longer, step_m / longer, error, frozen)
        jumps = [
            i
            for i in candidates
            if i < len(self._steps) - n_after and not is_told[i] and not goes_on[i]
        ]
        if not jumps:
            return ""
        i = min(jumps)
        step = self._steps[i]
        return (
            f"the pose jumps by {step_m[i]:.2g} m and {turn_deg[i]:.2g} degrees from frame "
            f"{step['from']} to {step['to']}, and depth does not follow (usual here: "
            f"{np.median(step_m):.2g} m and {np.median(turn_deg):.2g} degrees a frame); {ADVICE}"
        )


def _median_error(points: Reprojection) -> float:
    """Median relative difference in depth; NaN of too few points."""
    residuals = points.residual[points.known]
    return float(residuals.abs().median()) if len(residuals) >= _LEAST_POINTS else math.nan


def doubt_of(agreement: FirstAgreement, *, better: float = BETTER) -> str:
    """What is doubtful of an agreement, beside what is usual; "" if nothing is. Another reading has
    to gain more than ``better``."""
    disagrees = (
        agreement.overlap >= LEAST_OVERLAP and agreement.share < LEAST_SHARE * agreement.overlap
    )
    explains = not disagrees or agreement.other > _EXPLAINED * agreement.overlap
    if explains and agreement.gain > (better if agreement.overlap >= LEAST_OVERLAP else FAR_BETTER):
        return (
            f"agree in depth to {agreement.as_read:.0%} as read, but to {agreement.other:.0%} with "
            f"{agreement.reading} (usual: best as read)"
        )
    if disagrees:
        return (
            "do not agree: of the points that fall on a depth of another one, "
            f"{agreement.share / agreement.overlap:.0%} agree "
            f"with it within 3 % (usual: at least {LEAST_SHARE:.0%})"
        )
    if agreement.colour > MOST_COLOUR:
        return (
            "agree in depth, but their pictures do not follow: the same points differ by "
            f"{agreement.colour:.0%} of what "
            f"they would if nothing moved (usual: at most {MOST_COLOUR:.0%})"
        )
    return ""
