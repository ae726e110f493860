"""Exercises of the quickstart: which cells get a Gaussian, what PSNR measures, and which frames are
held out."""

import math
from typing import Any

import torch
from torch import Tensor

from ..data import open_sequence
from ..evaluation import image
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


def _first_seen(weight: Tensor, depth_m: Tensor) -> Tensor:
    return (weight == 1) & (depth_m > 0)


def _never_seen(weight: Tensor, depth_m: Tensor) -> Tensor:
    return (weight == 0) & (depth_m > 0)


def _up_to_one(weight: Tensor, depth_m: Tensor) -> Tensor:
    return (weight <= 1) & (depth_m > 0)


def _depth_or_not(weight: Tensor, depth_m: Tensor) -> Tensor:
    return weight == 1


def _as_first_seen(yours: Yours, weight: Tensor, required_weight: float) -> Any:
    """Yours for the cells that have depth; the reference, where another weight is asked for."""
    if required_weight != 1:
        return NotImplemented
    return yours(weight, torch.ones_like(weight), gives={"true or false": weight > 0})


@exercise(
    chapter=0,
    difficulty=1,
    minutes=5,
    solution=_first_seen,
    becomes=Becomes("first_seen", _as_first_seen),
    hints=(
        "Fusion comes before seeding. A voxel that this frame was the first to see has been "
        "averaged once.",
        "A cell whose middle has no depth has no point in space, so no Gaussian can be placed.",
    ),
    wrong=(
        Wrong(_never_seen, says="Fusion comes first"),
        Wrong(_up_to_one, says="weight 0, outside the map"),
        Wrong(_depth_or_not, says="no depth, no Gaussian"),
    ),
)
def first_seen(attempt: Attempt) -> None:
    """Which cells get a Gaussian: true or false for each, from its voxel's weight and its depth."""
    depth_m = torch.tensor([1.0, 1.0, 1.0])
    why = (
        "Fusion comes first: the weight is already 1 when this frame is the first. All three "
        "have depth"
    )
    got = attempt.on("weights 1, 2 and 7, all with depth")(torch.tensor([1.0, 2.0, 7.0]), depth_m)
    attempt.close(
        torch.as_tensor(got).double(),
        [1, 0, 0],
        "weight 1 gives a Gaussian, a larger weight none",
        why=why,
    )
    got = attempt.on("weight 0: a point outside the volume")(torch.tensor([0.0, 1.0]), depth_m[:2])
    attempt.close(
        torch.as_tensor(got).double(), [0, 1], "weight 0, outside the map, gives no Gaussian"
    )
    got = attempt.on("weight 1, depth 0")(torch.tensor([1.0, 1.0]), torch.tensor([0.0, 2.0]))
    attempt.close(torch.as_tensor(got).double(), [0, 1], "no depth, no Gaussian")


def _psnr(rendered: Tensor, photo: Tensor) -> Tensor:
    return -10 * torch.log10((rendered - photo).square().mean())


def _psnr_of_the_mean_error(rendered: Tensor, photo: Tensor) -> Tensor:
    return -10 * torch.log10((rendered - photo).abs().mean())


def _twice_the_log_of_the_mean_error(rendered: Tensor, photo: Tensor) -> Tensor:
    return -20 * torch.log10((rendered - photo).abs().mean())


def _mean_of_pixels(rendered: Tensor, photo: Tensor) -> Tensor:
    return (-10 * torch.log10((rendered - photo).square().mean(-1).clamp_min(1e-12))).mean()


def _negative(rendered: Tensor, photo: Tensor) -> Tensor:
    return 10 * torch.log10((rendered - photo).square().mean())


@exercise(
    chapter=0,
    difficulty=2,
    minutes=8,
    solution=_psnr,
    replaces=(image.psnr,),
    hints=(
        "Peak signal to noise: the peak is 1 here. Noise is the mean of the squared differences.",
        "10 log10(peak^2 / MSE). With peak 1 that is -10 log10(MSE).",
        "Take the mean over all pixels and channels first, then one logarithm.",
    ),
    wrong=(
        Wrong(_psnr_of_the_mean_error, says="off by 0.1 everywhere is 20 dB"),
        Wrong(_twice_the_log_of_the_mean_error, says="squared before they are averaged"),
        Wrong(_mean_of_pixels, says="one mean over the whole picture"),
        Wrong(_negative, says="more is better"),
    ),
)
def psnr(attempt: Attempt) -> None:
    """PSNR of two pictures with values from 0 to 1, in dB."""
    generator = torch.Generator().manual_seed(0)
    photo = torch.rand(6, 8, 3, generator=generator, dtype=torch.float64)
    got = torch.as_tensor(
        attempt.on("a picture that is too bright by 0.1 everywhere")(photo + 0.1, photo)
    ).double()
    sum_db = 20 - 10 * math.log10(photo.numel())
    detail = f"got {float(got.mean()):.1f} dB, which is that of the sum"
    attempt.holds(
        abs(float(got.mean()) - sum_db) > 1e-3,
        "it is a mean over all values, not a sum",
        detail=detail,
    )
    attempt.holds(
        float(got.mean()) > 0,
        "more is better, and 0 dB is very bad",
        detail=f"got {float(got.mean()):.1f} dB",
    )
    why = "-10 log10(0.1^2) = 20"
    attempt.close(got, 20.0, "off by 0.1 everywhere is 20 dB: the differences are squared", why=why)
    half = photo.clone()
    half[:3] += 0.1
    attempt.on("a picture of which one half is right and one half 0.1 too bright")
    why = "The logarithm comes after the mean; otherwise one perfect pixel dominates all others"
    reference = -10 * torch.log10(torch.tensor(0.005, dtype=torch.float64))
    got = torch.as_tensor(attempt(half, photo)).double()
    not_squared = abs(float(got.mean()) + 20 * math.log10(0.05)) < 1e-3
    detail = f"got {float(got.mean()):.2f} dB, which is that of the mean absolute difference"
    attempt.holds(
        not not_squared, "the differences are squared before they are averaged", detail=detail
    )
    attempt.close(got, reference, "one mean over the whole picture", why=why)


def _exam(n: int, every: int, offset: int) -> list[int]:
    return [i for i in range(n) if i % every == offset]


def _from_the_first(n: int, every: int, offset: int) -> list[int]:
    return list(range(0, n, every))


def _the_last_ones(n: int, every: int, offset: int) -> list[int]:
    return list(range(n - n // every, n))


def _all_others(n: int, every: int, offset: int) -> list[int]:
    return [i for i in range(n) if i % every != offset]


@exercise(
    chapter=0,
    difficulty=1,
    minutes=5,
    solution=_exam,
    hints=(
        "print(sequence.held_out.positions) shows them.",
        "range(start, stop, step) counts in steps; or ask every i for its remainder, i % every.",
    ),
    wrong=(
        Wrong(_from_the_first, says="the first frame is mapped"),
        Wrong(_the_last_ones, says="spread over the whole walk"),
        Wrong(_all_others, says="one in every eight"),
    ),
)
def exam_frames(attempt: Attempt) -> None:
    """Which of n frames are held out: every n-th one, counted from an offset."""

    def chosen(
        case: str,
        n: int,
        every: int,
        offset: int,
    ) -> list[int]:
        return [int(i) for i in attempt.on(case)(n, every, offset)]

    got = chosen("80 frames, every 8th, offset 4", 80, 8, 4)
    detail = f"got {len(got)} frames: {str(got[:8])[1:-1]} ..."
    attempt.holds(
        len(got) <= 40, "one in every eight is held out, the others are mapped", detail=detail
    )
    attempt.holds(
        not got or max(got) - min(got) > 40,
        "the held-out frames are spread over the whole walk",
        detail=detail,
    )
    attempt.holds(0 not in got, "the first frame is mapped: the map begins there", detail=detail)
    attempt.close(
        got,
        open_sequence("room", n_frames=80).held_out.positions,
        "the held-out frames are those of the library",
    )
    case = "3 frames, every 8th, offset 4: the walk ends before the first held-out frame"
    attempt.close(len(chosen(case, 3, 8, 4)), 0, "a short walk has no held-out frame")
    attempt.close(
        chosen("11 frames, every 5th, offset 2", 11, 5, 2), [2, 7], "counted from the offset"
    )
    case = "9 frames, every 4th, offset 0"
    attempt.close(
        chosen(case, 9, 4, 0), [0, 4, 8], "with offset 0, frame 0 is the first held-out frame"
    )
