"""Exercises of chapter 10: Amdahl's law, the roofline, counting bytes, and a loop that a compiler
makes fast."""

import numpy as np

from .exercise import Attempt, Wrong, exercise


def _speedup(seconds: dict[str, float], stage: str, factor: float) -> float:
    total = sum(seconds.values())
    return total / (total - seconds[stage] + seconds[stage] / factor)


def _speedup_of_the_stage(seconds: dict[str, float], stage: str, factor: float) -> float:
    return factor


@exercise(
    chapter=10,
    difficulty=1,
    minutes=5,
    solution=_speedup,
    hints=(
        "What is the time of the frame before, and after?",
        "after = total - seconds[stage] + seconds[stage] / factor; the answer is total / after.",
    ),
    wrong=(Wrong(_speedup_of_the_stage, says="the other stages take as long as before"),),
)
def overall_speedup(attempt: Attempt) -> None:
    """Speed-up of a whole frame when one stage gets faster (Amdahl)."""
    attempt.on("one stage alone, 4 times as fast")
    attempt.close(
        attempt({"optimise": 0.2}, "optimise", 4.0),
        4.0,
        "with one stage, the whole frame gains as much as the stage",
    )
    attempt.on("50 ms optimise and 50 ms tsdf; optimise 5 times as fast")
    seconds = {"optimise": 0.05, "tsdf": 0.05}
    attempt.close(
        attempt(dict(seconds), "optimise", 5.0),
        100 / 60,
        "the other stages take as long as before",
        why="10 ms + 50 ms are left of 100 ms",
    )
    attempt.on("the same, a million times as fast")
    attempt.close(
        attempt(dict(seconds), "optimise", 1e6),
        2.0,
        "the other stages limit the speed-up",
        tolerance=1e-4,
    )
    attempt.close(
        attempt.on("a factor of 1")(dict(seconds), "tsdf", 1.0), 1.0, "no change, no gain"
    )


def _attainable(intensity: float, peak_gflops: float, gb_per_s: float) -> float:
    return min(peak_gflops, intensity * gb_per_s)


def _attainable_peak(intensity: float, peak_gflops: float, gb_per_s: float) -> float:
    return peak_gflops


@exercise(
    chapter=10,
    difficulty=1,
    minutes=5,
    solution=_attainable,
    hints=(
        "Bytes arrive at gb_per_s, and each allows `intensity` operations. How many operations a "
        "second is that?",
        "The smaller of the two limits: min(peak, intensity x bandwidth).",
    ),
    wrong=(Wrong(_attainable_peak, says="memory limits a kernel of low intensity"),),
)
def attainable_gflops(attempt: Attempt) -> None:
    """The roofline of a kernel: the most Gflop/s that it can reach."""
    attempt.on("0.5 flop per byte, 100 Gflop/s, 10 GB/s")
    attempt.close(attempt(0.5, 100.0, 10.0), 5.0, "memory limits a kernel of low intensity")
    attempt.on("50 flop per byte on the same machine")
    attempt.close(attempt(50.0, 100.0, 10.0), 100.0, "arithmetic limits a kernel of high intensity")
    attempt.on("3 flop per byte, 30 Gflop/s, 8 GB/s")
    attempt.close(
        attempt(3.0, 30.0, 8.0),
        24.0,
        "every machine has its own limits: intensity x bandwidth here",
    )
    attempt.close(
        attempt.on("the ridge, 10 flop per byte")(10.0, 100.0, 10.0),
        100.0,
        "at the ridge both limits agree",
    )


def _adam_traffic(n: int) -> tuple[int, float]:
    return 28 * n, 12 / 28


def _adam_reads_only(n: int) -> tuple[int, float]:
    return 16 * n, 12 / 16


def _adam_in_numbers(n: int) -> tuple[int, float]:
    return 7 * n, 12 / 7


def _adam_per_map(n: int) -> tuple[int, float]:
    return 28 * n, 12 / (28 * n)


@exercise(
    chapter=10,
    difficulty=2,
    minutes=8,
    solution=_adam_traffic,
    hints=(
        "Which arrays are read? Value, gradient, m, v. Which are written?",
        "Four reads and three writes, of 4 bytes each.",
        "Intensity is operations per byte: 12 operations for each number.",
    ),
    wrong=(
        Wrong(_adam_reads_only, says="writing moves bytes, too"),
        Wrong(_adam_in_numbers, says="4 bytes"),
        Wrong(_adam_per_map, says="does not depend on the size"),
    ),
)
def adam_traffic(attempt: Attempt) -> None:
    """Bytes that one step of Adam moves for n float32 numbers, and its intensity at 12 flop per
    number."""
    names = ("bytes", "intensity")
    traffic, intensity = attempt.unpack(attempt.on("one number")(1), names)
    attempt.holds(
        float(traffic) != 7,
        "a float32 has 4 bytes",
        detail="7 is how many numbers move, not how many bytes",
    )
    prop = "four arrays are read, three are written: writing moves bytes, too"
    attempt.close([traffic], [28], prop, names=names[:1])
    attempt.close(intensity, 12 / 28, "intensity is flop per byte", tolerance=1e-3)
    traffic, intensity = attempt.unpack(
        attempt.on("59 numbers for each of 10,000 Gaussians")(590_000), names
    )
    attempt.close(traffic, 28 * 590_000, "twice the numbers, twice the bytes")
    attempt.close(intensity, 12 / 28, "the intensity does not depend on the size", tolerance=1e-3)


def _average_loop(D, W, d, max_weight):
    new_D = D.copy()
    new_W = W.copy()
    for i in range(len(D)):
        if d[i] == d[i] and d[i] >= -1.0:
            new_W[i] = min(W[i] + 1, max_weight)
            new_D[i] = (D[i] * (new_W[i] - 1) + min(d[i], 1.0)) / new_W[i]
    return new_D, new_W


def _average_of_everything(D, W, d, max_weight):
    new_D = D.copy()
    new_W = W.copy()
    for i in range(len(D)):
        new_W[i] = min(W[i] + 1, max_weight)
        new_D[i] = (D[i] * (new_W[i] - 1) + min(d[i], 1.0)) / new_W[i]
    return new_D, new_W


def _average_in_place(D, W, d, max_weight):
    for i in range(len(D)):
        if d[i] == d[i] and d[i] >= -1.0:
            W[i] = min(W[i] + 1, max_weight)
            D[i] = (D[i] * (W[i] - 1) + min(d[i], 1.0)) / W[i]
    return D, W


def _average_uncapped(D, W, d, max_weight):
    new_D, new_W = _average_loop(D, W, d, 1e9)
    return new_D, new_W


def _average_unclamped(D, W, d, max_weight):
    new_D = D.copy()
    new_W = W.copy()
    for i in range(len(D)):
        if d[i] == d[i] and d[i] >= -1.0:
            new_W[i] = min(W[i] + 1, max_weight)
            new_D[i] = (D[i] * (new_W[i] - 1) + d[i]) / new_W[i]
    return new_D, new_W


def _average_of_more_than_the_cap(D, W, d, max_weight):
    new_D = D.copy()
    new_W = W.copy()
    for i in range(len(D)):
        if d[i] == d[i] and d[i] >= -1.0:
            new_D[i] = (D[i] * W[i] + min(d[i], 1.0)) / (W[i] + 1)
            new_W[i] = min(W[i] + 1, max_weight)
    return new_D, new_W


@exercise(
    chapter=10,
    difficulty=3,
    minutes=15,
    solution=_average_loop,
    hints=(
        "The same formulas as in chapter 2 (Eq. 7-9), for one voxel i at a time, in a plain for "
        "loop.",
        "NaN is the only number that is not equal to itself: `if d[i] == d[i]`.",
        "If d[i] >= -1: w = min(W[i] + 1, max_weight), new_W[i] = w, new_D[i] = (D[i] (w - 1) + "
        "min(d[i], 1)) / w.",
    ),
    wrong=(
        Wrong(_average_of_everything, says="behind the surface"),
        Wrong(_average_in_place, says="does not change its inputs"),
        Wrong(_average_uncapped, says="max_weight"),
        Wrong(_average_unclamped, says="at most 1"),
        Wrong(_average_of_more_than_the_cap, says="1 / max_weight"),
    ),
)
def average_loop(attempt: Attempt) -> None:
    """TSDF update of many voxels as a loop, to be compiled."""
    names = ("D", "W")

    def update(
        case: str,
        D: list[float],
        W: list[float],
        d: list[float],
        cap: float,
    ) -> tuple:
        inputs = (np.array(v, np.float32) for v in (D, W, d))
        return attempt.unpack(attempt.on(case)(*inputs, cap), names)

    D, W = update("D = 0.5 after 3 observations, and d = 0.1", [0.5], [3.0], [0.1], 100.0)
    attempt.close(D, [0.4], "the mean of all observations")
    attempt.close(W, [4.0], "one observation more")
    D, W = update(
        "d = -1.5 (far behind) and d = NaN (no depth)",
        [0.5, 0.5],
        [3.0, 3.0],
        [-1.5, float("nan")],
        100.0,
    )
    attempt.close(
        D, [0.5, 0.5], "a voxel far behind the surface, or without depth, does not change"
    )
    attempt.close(
        W, [3.0, 3.0], "a voxel far behind the surface, or without depth, was not observed"
    )
    D, W = update("d = -0.5, just behind the surface", [0.5], [1.0], [-0.5], 100.0)
    attempt.close(D, [0.0], "a voxel behind the surface, inside the band, is observed")
    attempt.close(W, [2.0], "a voxel behind the surface, inside the band, is observed")
    case = "d = 7, free space far in front of the surface"
    attempt.close(
        update(case, [0.5], [1.0], [7.0], 100.0)[0],
        [0.75],
        "d counts as at most 1",
    )
    D, W = update("W = 4 with max_weight 4, D = 0.2, and d = 1", [0.2], [4.0], [1.0], 4.0)
    attempt.close(W, [4.0], "the weight stops at max_weight")
    attempt.close(D, [0.4], "at max_weight a new observation counts 1 / max_weight")
    D, W = update(
        "three voxels at once",
        [0.5, 0.0, -0.5],
        [1.0, 0.0, 9.0],
        [0.1, 0.3, 0.5],
        100.0,
    )
    attempt.close(W, [2.0, 1.0, 10.0], "every voxel has its own weight")
    attempt.close(D, [0.3, 0.3, -0.4], "every voxel has its own mean")
