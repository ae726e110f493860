"""Exercises of chapter 2: signed distance, running average, zero crossing."""

from typing import Any

import torch
from torch import Tensor

from ..config import TsdfConfig
from ..tsdf import tsdf_update
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


def _signed_distance(depth_m: Tensor, z_m: Tensor, truncation_m: float) -> tuple[Tensor, Tensor]:
    sdf = depth_m - z_m
    is_observed = (depth_m > 0) & (sdf > -truncation_m)
    return (sdf / truncation_m).clamp(-1, 1), is_observed


def _signed_distance_backwards(
    depth_m: Tensor, z_m: Tensor, truncation_m: float
) -> tuple[Tensor, Tensor]:
    d, _ = _signed_distance(depth_m, z_m, truncation_m)
    return -d, (depth_m > 0) & (z_m - depth_m > -truncation_m)


def _signed_distance_band_only(
    depth_m: Tensor, z_m: Tensor, truncation_m: float
) -> tuple[Tensor, Tensor]:
    d, _ = _signed_distance(depth_m, z_m, truncation_m)
    return d, (depth_m > 0) & ((depth_m - z_m).abs() < truncation_m)


def _signed_distance_through_walls(
    depth_m: Tensor, z_m: Tensor, truncation_m: float
) -> tuple[Tensor, Tensor]:
    return _signed_distance(depth_m, z_m, truncation_m)[0], depth_m > 0


def _signed_distance_holes_too(
    depth_m: Tensor, z_m: Tensor, truncation_m: float
) -> tuple[Tensor, Tensor]:
    return _signed_distance(depth_m, z_m, truncation_m)[0], depth_m - z_m > -truncation_m


def _as_signed_distance_m(
    yours: Yours, depth_m: Tensor, centres_C: Tensor, config: TsdfConfig
) -> Tensor:
    """Distances in metres from yours; -inf where yours says that nothing was observed."""
    z = centres_C[..., 2]
    mask = (z > 0) & depth_m.isfinite()
    depth = depth_m[mask].to(z)
    z = z[mask]
    if config.sdf == "ray":  # the same equation with lengths along the ray
        depth = depth * centres_C[mask].norm(dim=-1) / z
        z = centres_C[mask].norm(dim=-1)
    d, is_observed = yours(
        depth,
        z,
        config.truncation_m,
        gives={"d": depth, "observed": depth > 0},
    )
    sdf_m = torch.full_like(depth_m, -torch.inf, dtype=centres_C.dtype)
    sdf_m[mask] = torch.where(is_observed, d * config.truncation_m, -torch.inf)
    return sdf_m


@exercise(
    chapter=2,
    difficulty=2,
    minutes=8,
    solution=_signed_distance,
    becomes=Becomes("signed_distance_m", _as_signed_distance_m),
    hints=(
        "Eq. 6: what the camera measured, minus where the voxel is. Both are along z.",
        "Eq. 7 divides by the truncation and clamps to -1 .. 1.",
        "Observed: there is a measurement, and the voxel is not deeper behind it than the "
        "truncation.",
    ),
    wrong=(
        Wrong(_signed_distance_backwards, says="positive in front"),
        Wrong(_signed_distance_band_only, says="free space"),
        Wrong(_signed_distance_through_walls, says="hidden"),
        Wrong(_signed_distance_holes_too, says="0 means missing"),
    ),
)
def signed_distance(attempt: Attempt) -> None:
    """What one depth measurement says about the voxels on its ray (Eq. 6-7)."""
    names = ("d", "observed")

    def ask(
        case: str,
        depth_m: float,
        z_m: list[float],
    ) -> tuple[Tensor, Tensor]:
        depth = torch.full((len(z_m),), depth_m)
        z = torch.tensor(z_m)
        d, is_observed = attempt.unpack(attempt.on(case)(depth, z, 0.1), names)
        return torch.as_tensor(d), torch.as_tensor(is_observed)

    d, is_observed = ask("a voxel 5 cm in front of a surface at 2 m, truncation 10 cm", 2.0, [1.95])
    attempt.close(
        d,
        [0.5],
        "d is positive in front of the surface, in units of the truncation",
        tolerance=1e-4,
    )
    d, is_observed = ask("a voxel 5 cm behind a surface at 2 m", 2.0, [2.05])
    attempt.close(d, [-0.5], "d is negative behind the surface", tolerance=1e-4)
    attempt.holds(
        is_observed.all(),
        "a voxel just behind the surface, inside the band, is observed",
        detail="it is not",
    )
    d, is_observed = ask("a voxel 1 m in front of a surface at 2 m", 2.0, [1.0])
    attempt.close(d, [1.0], "d is clamped to 1 far in front")
    attempt.holds(
        is_observed.all(),
        "free space in front of the surface is observed, however far",
        detail="it is not",
    )
    d, is_observed = ask("a voxel 1 m behind a surface at 2 m", 2.0, [3.0])
    occlusion_words = "a voxel hidden behind the band is not observed: what is there is unknown"
    attempt.holds(not is_observed.any(), occlusion_words, detail="observed is true")
    d, is_observed = ask("a pixel whose depth is 0, voxel at 5 cm", 0.0, [0.05])
    attempt.holds(
        not is_observed.any(),
        "depth 0 means missing: nothing is observed",
        detail="observed is true",
    )
    attempt.on("a surface at 40 cm and voxels at 20, 35, 45 and 80 cm, truncation 25 cm")
    z = torch.tensor([0.2, 0.35, 0.45, 0.8])
    depth = torch.full((4,), 0.4)
    d, is_observed = (
        torch.as_tensor(part) for part in attempt.unpack(attempt(depth, z, 0.25), names)
    )
    prop = "a near surface is observed like any other, and the band is as wide as truncation_m says"
    attempt.close(is_observed.double(), [1, 1, 1, 0], prop)
    attempt.close(
        d.double()[:3],
        [0.8, 0.2, -0.2],
        "d is in units of truncation_m",
    )


def _running_average(
    D: Tensor,
    W: Tensor,
    d: Tensor,
    max_weight: float,
) -> tuple[Tensor, Tensor]:
    W_new = (W + 1).clamp(max=max_weight)
    return (D * (W_new - 1) + d) / W_new, W_new


def _running_average_as_printed(
    D: Tensor, W: Tensor, d: Tensor, max_weight: float
) -> tuple[Tensor, Tensor]:
    W_new = (W + 1).clamp(max=max_weight)
    return (D * W + d * W_new) / (W + W_new), W_new


def _running_average_without_cap(
    D: Tensor, W: Tensor, d: Tensor, max_weight: float
) -> tuple[Tensor, Tensor]:
    return (D * W + d) / (W + 1), W + 1


def _as_tsdf_update(
    yours: Yours,
    D: Tensor,
    W: Tensor,
    sdf_m: Tensor,
    *,
    truncation_m: float,
    max_weight: float,
    average: str = "mean",
) -> Any:
    """The update of the observed voxels by yours; other definitions of the average are left to the
    reference."""
    if average != "mean":
        return NotImplemented
    is_observed = sdf_m > -truncation_m
    old = D[is_observed]
    weight = W[is_observed]
    d = (sdf_m[is_observed] / truncation_m).clamp(-1.0, 1.0)
    new_D, new_W = yours(
        old,
        weight,
        d,
        max_weight,
        gives={"D": old, "W": weight},
    )
    return D.masked_scatter(is_observed, new_D), W.masked_scatter(is_observed, new_W)


@exercise(
    chapter=2,
    difficulty=2,
    minutes=10,
    solution=_running_average,
    becomes=Becomes("tsdf_update", _as_tsdf_update),
    hints=(
        "The mean of n numbers from the mean of the first n - 1 and the last one.",
        "First W <- min(W + 1, max_weight). Then D <- (D (W - 1) + d) / W, with the new W.",
    ),
    wrong=(
        Wrong(_running_average_as_printed, says="every observation counts the same"),
        Wrong(_running_average_without_cap, says="max_weight"),
    ),
)
def running_average(attempt: Attempt) -> None:
    """Add one observation to a voxel: W is capped, D is the running mean (Eq. 8-9)."""
    names = ("D", "W")
    attempt.on("a voxel never observed (D = 1, W = 0), observation 0.2")
    D, W = attempt.unpack(
        attempt(torch.ones(1), torch.zeros(1), torch.tensor([0.2]), 100.0),
        names,
    )
    attempt.close(D, [0.2], "the first observation replaces the initial value")
    attempt.close(W, [1.0], "W counts the observations")
    attempt.on("observations 0.2, 0.4, 0.6 one after the other")
    D = torch.ones(1)
    W = torch.zeros(1)
    for d in (0.2, 0.4, 0.6):
        D, W = (
            torch.as_tensor(a)
            for a in attempt.unpack(attempt(D, W, torch.tensor([d]), 100.0), names)
        )
    attempt.close(D, [0.4], "every observation counts the same: D is their mean")
    attempt.on("W = 4 with max_weight = 4, D = 0.2, observation 1")
    D, W = attempt.unpack(
        attempt(torch.full((1,), 0.2), torch.full((1,), 4.0), torch.ones(1), 4.0),
        names,
    )
    attempt.close(W, [4.0], "W stops at max_weight")
    attempt.close(
        D, [0.4], "at max_weight a new observation still moves D: it counts 1 / max_weight"
    )
    g = torch.Generator().manual_seed(1)
    D = torch.rand(64, generator=g)
    W = torch.randint(0, 12, (64,), generator=g).float()
    d = torch.rand(64, generator=g) * 2 - 1
    reference = tsdf_update(D, W, d * 0.1, truncation_m=0.1, max_weight=10.0)
    D, W = attempt.unpack(attempt.on("64 random voxels")(D, W, d, 10.0), names)
    attempt.close(
        D,
        reference[0],
        "D = (D (W - 1) + d) / W with the new W, as in gsfusion_nb.tsdf.tsdf_update",
    )


def _zero_crossing(p0: Tensor, p1: Tensor, D0: Tensor, D1: Tensor) -> Tensor:
    t = D0 / (D0 - D1)
    return p0 + t[:, None] * (p1 - p0)


def _middle(p0: Tensor, p1: Tensor, D0: Tensor, D1: Tensor) -> Tensor:
    return (p0 + p1) / 2


def _by_magnitude(p0: Tensor, p1: Tensor, D0: Tensor, D1: Tensor) -> Tensor:
    t = D0 / (D0 + D1)
    return p0 + t[:, None] * (p1 - p0)


def _as_zero_crossing(
    yours: Yours,
    p0: Tensor,
    p1: Tensor,
    D0: Tensor,
    D1: Tensor,
) -> Tensor:
    """Yours for every edge that marching cubes cuts. The unit of the points is a voxel."""
    return yours(p0, p1, D0, D1, gives={"the points": p0})


@exercise(
    chapter=2,
    difficulty=2,
    minutes=8,
    solution=_zero_crossing,
    becomes=Becomes("zero_crossing", _as_zero_crossing),
    hints=(
        "On a straight line D(t) = D0 + t (D1 - D0). For which t is it zero?",
        "t = D0 / (D0 - D1): between 0 and 1, because the signs differ.",
    ),
    wrong=(
        Wrong(_middle, says="nearer to the end"),
        Wrong(_by_magnitude, says="halfway"),
    ),
)
def zero_crossing(attempt: Attempt) -> None:
    """Where the surface cuts an edge between two voxel centres."""
    p0 = torch.tensor([[0.0, 0.0, 0.0]])
    p1 = torch.tensor([[0.1, 0.0, 0.0]])

    def ask(case: str, D0: float, D1: float) -> Tensor:
        return torch.as_tensor(
            attempt.on(case)(
                p0,
                p1,
                torch.tensor([D0]),
                torch.tensor([D1]),
            )
        )

    case = "D = +0.5 and -0.5 at the ends of a 10 cm edge"
    attempt.close(
        ask(case, 0.5, -0.5),
        [[0.05, 0.0, 0.0]],
        "opposite values cut the edge halfway",
    )
    prop = "the surface is nearer to the end whose D is nearer to zero"
    attempt.close(
        ask("D = +0.1 and -0.4", 0.1, -0.4),
        [[0.02, 0.0, 0.0]],
        prop,
    )
    case = "D = -0.3 and +0.1"
    attempt.close(
        ask(case, -0.3, 0.1), [[0.075, 0.0, 0.0]], "it makes no difference which end is negative"
    )
    attempt.on(
        "two edges, neither at the origin: along y from (1, 2, 3) and along z from (-1, 0.5, 2)"
    )
    starts = torch.tensor([[1.0, 2, 3], [-1, 0.5, 2]])
    ends = torch.tensor([[1.0, 2.1, 3], [-1, 0.5, 2.1]])
    got = attempt(
        starts,
        ends,
        torch.tensor([0.6, -0.1]),
        torch.tensor([-0.2, 0.3]),
    )
    prop = "every edge has its own crossing, counted from its own start p0"
    attempt.close(
        got,
        [[1.0, 2.075, 3.0], [-1.0, 0.5, 2.025]],
        prop,
    )
