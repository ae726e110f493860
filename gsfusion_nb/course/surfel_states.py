"""Exercises of chapter 7 (RTG-SLAM): states of Gaussians, and fusion with the past."""

import math
from typing import Any

import torch
from torch import Tensor

from ..gaussians import surfel_states
from .exercise import Attempt, Becomes, Wrong, Yours, exercise

STABLE_CONFIDENCE = 100
ERROR_COUNT = 10
UNSTABLE_FRAMES = 120

STAYS = "stays"
BECOMES_STABLE = "becomes stable"
BECOMES_UNSTABLE = "becomes unstable"
DELETED = "is deleted"


def _next_state(stable: bool, eta: int, errors: int, age: int) -> str:
    if stable:
        return BECOMES_UNSTABLE if errors > 10 else STAYS
    if eta > 100:
        return BECOMES_STABLE
    return DELETED if age > 120 else STAYS


def _errors_kill(stable: bool, eta: int, errors: int, age: int) -> str:
    return DELETED if stable and errors > 10 else _next_state(stable, eta, errors, age)


def _old_first(stable: bool, eta: int, errors: int, age: int) -> str:
    return DELETED if not stable and age > 120 else _next_state(stable, eta, errors, age)


def _everything_ages(stable: bool, eta: int, errors: int, age: int) -> str:
    return DELETED if stable and age > 120 else _next_state(stable, eta, errors, age)


def _any_errors(stable: bool, eta: int, errors: int, age: int) -> str:
    return BECOMES_UNSTABLE if errors > 10 else _next_state(stable, eta, errors, age)


_CODES = {
    STAYS: surfel_states.STAYS,
    BECOMES_STABLE: surfel_states.BECOMES_STABLE,
    BECOMES_UNSTABLE: surfel_states.BECOMES_UNSTABLE,
    DELETED: surfel_states.DELETED,
}


def _as_next_states(
    yours: Yours,
    stable: Tensor,
    confidence: Tensor,
    errors: Tensor,
    age: Tensor,
    *,
    stable_confidence: float,
    error_count: int,
    unstable_frames: int,
) -> Any:
    """Yours for each row. Counts are given as shares of their limits, rounded up: half of delta_eta
    is 50 of 100."""
    if min(stable_confidence, error_count, unstable_frames) <= 0:
        return NotImplemented
    happens = torch.zeros_like(age)
    rows = zip(
        stable.tolist(),
        confidence.tolist(),
        errors.tolist(),
        age.tolist(),
        strict=True,
    )
    for k, (is_stable, eta, e, frames) in enumerate(rows):
        inputs = (
            is_stable,
            math.ceil(eta * STABLE_CONFIDENCE / stable_confidence),
            math.ceil(e * ERROR_COUNT / error_count),
            math.ceil(frames * UNSTABLE_FRAMES / unstable_frames),
        )
        word = yours(*inputs)
        if not isinstance(word, str) or word not in _CODES:
            yours.fail(
                f"returned {word!r}, which is none of {', '.join(map(repr, _CODES))}", inputs
            )
        happens[k] = _CODES[word]
    return happens


@exercise(
    chapter=7,
    difficulty=2,
    minutes=8,
    solution=_next_state,
    becomes=Becomes("next_states", _as_next_states),
    hints=(
        "Two cases, stable or not. Only a stable Gaussian has errors that matter, only an unstable "
        "one an age.",
        "An unstable one is asked first whether it has been optimised enough (eta > 100), then "
        "whether it is too old.",
        "In the paper, a stable one in error is not deleted: it becomes unstable and is optimised "
        "again.",
    ),
    wrong=(
        Wrong(_errors_kill, says="a stable one with errors becomes unstable again"),
        Wrong(_old_first, says="enough optimisation counts, even at the last moment"),
        Wrong(_everything_ages, says="a stable one is never too old"),
        Wrong(_any_errors, says="errors of an unstable one do not count"),
    ),
)
def next_state(attempt: Attempt) -> None:
    """What happens to one Gaussian at the end of a frame?"""
    cases = (
        ((False, 101, 0, 5), BECOMES_STABLE, "optimised more than 100 times, it is stable"),
        ((False, 100, 0, 5), STAYS, "exactly 100 is not more than 100"),
        ((False, 3, 0, 120), STAYS, "exactly 120 frames are not more than 120"),
        ((False, 3, 0, 121), DELETED, "unstable for more than 120 frames: it is deleted"),
        (
            (False, 101, 0, 121),
            BECOMES_STABLE,
            "enough optimisation counts, even at the last moment",
        ),
        ((False, 3, 11, 5), STAYS, "errors of an unstable one do not count"),
        ((True, 400, 10, 90), STAYS, "exactly 10 errors are not too many"),
        ((True, 400, 11, 90), BECOMES_UNSTABLE, "a stable one with errors becomes unstable again"),
        ((True, 400, 2, 1000), STAYS, "a stable one is never too old"),
    )
    for (stable, eta, errors, age), reference, prop in cases:
        attempt.on(
            f"{'stable' if stable else 'unstable'}, eta {eta}, {errors} errors, {age} frames old"
        )
        got = attempt(stable, eta, errors, age)
        attempt.holds(got == reference, prop, detail=f"got {got!r}, expected {reference!r}")


def _fuse(before: Tensor, after: Tensor, eta_before: Tensor, eta_after: Tensor) -> Tensor:
    w = (eta_after - eta_before) / eta_after.clamp_min(1)
    return before + w[:, None] * (after - before)


def _swapped(before: Tensor, after: Tensor, eta_before: Tensor, eta_after: Tensor) -> Tensor:
    return _fuse(after, before, eta_before, eta_after)


def _sum_of_counts(before: Tensor, after: Tensor, eta_before: Tensor, eta_after: Tensor) -> Tensor:
    w = eta_after / (eta_before + eta_after).clamp_min(1)
    return before + w[:, None] * (after - before)


def _unguarded(before: Tensor, after: Tensor, eta_before: Tensor, eta_after: Tensor) -> Tensor:
    w = (eta_after - eta_before) / eta_after
    return before + w[:, None] * (after - before)


def _as_fuse(
    yours: Yours,
    before: Tensor,
    after: Tensor,
    eta_before: Tensor,
    eta_after: Tensor,
    *,
    history_max_weight: float = 1.0,
) -> Any:
    """Yours for the rows that a step has changed; the others keep what the window made of them, as
    in the library. The reference, where the weight of the past has a limit (released code)."""
    if history_max_weight != 1:
        return NotImplemented
    rows = eta_after > 0
    values = after.clone()
    inputs = (before[rows], after[rows], eta_before[rows], eta_after[rows])
    values[rows] = yours(*inputs, gives={"the fused values": inputs[1]})
    return values


@exercise(
    chapter=7,
    difficulty=3,
    minutes=8,
    solution=_fuse,
    becomes=Becomes("fuse", _as_fuse),
    hints=(
        "eta_after already contains eta_before: a window with 20 steps raises it from 30 to 50.",
        "w_curr = (eta_after - eta_before) / eta_after is the share of the steps that this window "
        "made.",
        "Rows that no step ever touched have eta 0: clamp the divisor. w needs [:, None] to act on "
        "rows.",
    ),
    wrong=(
        Wrong(_swapped, says="a new Gaussian takes the values from the window"),
        Wrong(_sum_of_counts, says="the newer values are weighted by their share of the steps"),
        Wrong(_unguarded, says="a Gaussian never seen does not change"),
    ),
)
def fuse(attempt: Attempt) -> None:
    """Merge the values after an optimisation window with those before it (Eq. 9)."""
    old = torch.tensor([[0.0, 4.0]])
    new = torch.tensor([[1.0, 0.0]])
    got = attempt.on("eta 0 before, 20 after")(
        old,
        new,
        torch.tensor([0]),
        torch.tensor([20]),
    )
    attempt.close(got, new, "a new Gaussian takes the values from the window")
    got = attempt.on("eta 30 before, 40 after")(old, new, torch.tensor([30]), torch.tensor([40]))
    why = "10 of the 40 steps were made in this window: w_curr = 1/4"
    attempt.close(
        got, [[0.25, 3.0]], "the newer values are weighted by their share of the steps", why=why
    )
    attempt.on("eta 50 before and after: seen by no view of this window")
    got = attempt(
        old,
        new,
        torch.tensor([50]),
        torch.tensor([50]),
    )
    attempt.close(got, old, "without steps nothing changes")
    got = attempt.on("eta 0 before and after")(
        old,
        old,
        torch.tensor([0]),
        torch.tensor([0]),
    )
    attempt.close(got, old, "a Gaussian never seen does not change", why="do not divide by zero")
    got = attempt.on("eta 0 before and 1 after")(old, new, torch.tensor([0]), torch.tensor([1]))
    attempt.close(
        got,
        new,
        "one step is enough to take the values from the window",
        why="eta_after is 1: w_curr = 1",
    )
    both = [torch.cat([x, x]) for x in (old, new)]
    got = attempt.on("two rows at once")(
        *both,
        torch.tensor([0, 30]),
        torch.tensor([20, 40]),
    )
    attempt.close(got, [[1.0, 0.0], [0.25, 3.0]], "every row has its own weight")
