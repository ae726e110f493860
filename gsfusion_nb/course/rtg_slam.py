"""Exercises of chapter 7: discs, states, and fusion with the past (RTG-SLAM)."""

import math
from typing import Any

import torch
from torch import Tensor

from ..gaussians import surfels
from .exercise import Attempt, Becomes, Wrong, Yours, exercise

MIN_COSINE = 0.5
MIN_TRANSMITTANCE = 0.5
DEPTH_ERROR_M = 0.1
COLOUR_ERROR = 0.1
STABLE_CONFIDENCE = 100
ERROR_COUNT = 10
UNSTABLE_FRAMES = 120


def _disc_hit(r: Tensor, p: Tensor, n: Tensor) -> Tensor:
    rn = r @ n
    if rn.abs() < MIN_COSINE * r.norm():
        return p[2]
    return (p @ n) / rn * r[2]


def _always_plane(r: Tensor, p: Tensor, n: Tensor) -> Tensor:
    return (p @ n) / (r @ n) * r[2]


def _always_centre(r: Tensor, p: Tensor, n: Tensor) -> Tensor:
    return p[2]


def _one_sided(r: Tensor, p: Tensor, n: Tensor) -> Tensor:
    rn = r @ n
    return p[2] if rn < MIN_COSINE * r.norm() else (p @ n) / rn * r[2]


def _range(r: Tensor, p: Tensor, n: Tensor) -> Tensor:
    rn = r @ n
    return p.norm() if rn.abs() < MIN_COSINE * r.norm() else ((p @ n) / rn * r).norm()


def _as_disc_hit(
    yours: Yours,
    r: Tensor,
    p: Tensor,
    n: Tensor,
    min_cosine: float,
) -> Any:
    """Yours for each ray, with the limit of the exercise; the reference for other limits."""
    if min_cosine != MIN_COSINE:
        return NotImplemented
    rays = list(zip(r, p, n, strict=True))
    depths = yours.many(rays, [{"the depth": p.new_zeros(())}] * len(rays))
    return torch.stack(depths) if depths else p[:, 2].clone()


@exercise(
    chapter=7,
    difficulty=2,
    minutes=10,
    solution=_disc_hit,
    becomes=Becomes("disc_hit", _as_disc_hit),
    hints=(
        "The points of the plane satisfy (x - p) . n = 0. Put x = theta r and solve for theta: "
        "that is Eq. 4.",
        "The depth is the z of theta r. With r = (.., .., 1) it is theta itself, but r may come "
        "normalised.",
        "cos of the angle between ray and normal: |r . n| / |r|. Below 0.5 (60 degrees) return p's "
        "z instead.",
    ),
    wrong=(
        Wrong(_always_centre, says="a tilted disc is nearer on one side than on the other"),
        Wrong(_one_sided, says="a normal may point either way"),
        Wrong(_always_plane, says="beyond 60 degrees the depth of the centre is used"),
        Wrong(_range, says="depth is z, not the distance along the ray"),
    ),
)
def disc_hit(attempt: Attempt) -> None:
    """Depth at which a ray meets a disc (Eq. 4-5)."""
    centre = torch.tensor([0.0, 0.0, 2.0])
    normal = torch.tensor([0.0, 0.0, -1.0])
    attempt.on("a disc 2 m ahead that faces the camera, ray (0.3, 0, 1)")
    ray = torch.tensor([0.3, 0.0, 1.0])
    attempt.close(attempt(ray, centre, normal), 2.0, "depth is z, not the distance along the ray")
    leaning = torch.tensor([-0.6, 0.0, -0.8])
    ray = torch.tensor([0.2, 0.0, 1.0])
    got = attempt.on("a disc 2 m ahead, tilted by 37 degrees, ray (0.2, 0, 1)")(
        ray, centre, -leaning
    )
    attempt.close(
        got,
        1.6 / 0.92,
        "a tilted disc is nearer on one side than on the other",
        why="Eq. 4: p.n / r.n",
    )
    attempt.on("the same with the normal turned round")
    attempt.close(
        attempt(ray, centre, leaning), 1.6 / 0.92, "a normal may point either way", why="use |r.n|"
    )
    attempt.on("the same ray, normalised")
    attempt.close(
        attempt(ray / ray.norm(), centre, leaning),
        1.6 / 0.92,
        "the length of the ray does not matter",
    )
    attempt.on("a disc turned 80 degrees, ray (0.2, 0, 1)")
    flat = torch.tensor([-0.9848, 0.0, -0.1736])
    prop = "beyond 60 degrees the depth of the centre is used"
    attempt.close(
        attempt(ray, centre, torch.tensor([0.9848, 0.0, -0.1736])),
        2.0,
        prop,
    )
    attempt.on("a disc turned 80 degrees, to the other side")
    attempt.close(
        attempt(torch.tensor([0.0, 0.1, 1.0]), centre, flat),
        2.0,
        prop,
    )
    attempt.on("a disc to the right of the axis, turned by 80 degrees")
    edge_on = torch.tensor([0.9848, 0.0, 0.1736])
    got = attempt(
        torch.tensor([0.2, 0.0, 1.0]),
        torch.tensor([0.8, 0.0, 2.0]),
        edge_on,
    )
    attempt.close(
        got, 2.0, "beyond 60 degrees the depth of the centre is used: its z, not its distance"
    )
    side = torch.tensor([0.2, 0.0, 2.0])
    straight = torch.tensor([0.0, 0.0, 1.0])
    for degrees, reference in ((57, 2.0 + 0.2 * math.tan(math.radians(57))), (63, 2.0)):
        tilt = math.radians(degrees)
        for length in (0.3, 1.0, 3.0):
            attempt.on(
                f"a disc beside the axis turned by {degrees} degrees, ray (0, 0, {length:g})"
            )
            got = attempt(
                length * straight,
                side,
                torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)]),
            )
            limit = (
                "the plane counts up to 60 degrees between ray and normal, whatever the ray's "
                "length"
            )
            attempt.close(
                got,
                reference,
                limit,
                tolerance=1e-4,
                why="|r.n| / |r| is the cosine; compare it with 0.5",
            )


def _adding_masks(
    T: Tensor, D_map: Tensor, D: Tensor, C_map: Tensor, C: Tensor
) -> tuple[Tensor, Tensor]:
    has_depth = D > 0
    surface = has_depth & ((T > 0.5) | ((D_map - D).abs() > 0.1))
    colour = has_depth & ~surface & ((C_map - C).abs().mean(-1) > 0.1)
    return surface, colour


def _missing_depth(
    T: Tensor, D_map: Tensor, D: Tensor, C_map: Tensor, C: Tensor
) -> tuple[Tensor, Tensor]:
    surface = (T > 0.5) | ((D_map - D).abs() > 0.1)
    return surface, ~surface & ((C_map - C).abs().mean(-1) > 0.1)


def _one_sign(
    T: Tensor, D_map: Tensor, D: Tensor, C_map: Tensor, C: Tensor
) -> tuple[Tensor, Tensor]:
    surface = (D > 0) & ((T > 0.5) | (D_map - D > 0.1))
    return surface, (D > 0) & ~surface & ((C_map - C).abs().mean(-1) > 0.1)


def _overlapping(
    T: Tensor, D_map: Tensor, D: Tensor, C_map: Tensor, C: Tensor
) -> tuple[Tensor, Tensor]:
    surface, _ = _adding_masks(T, D_map, D, C_map, C)
    return surface, (D > 0) & ((C_map - C).abs().mean(-1) > 0.1)


def _both_needed(
    T: Tensor, D_map: Tensor, D: Tensor, C_map: Tensor, C: Tensor
) -> tuple[Tensor, Tensor]:
    surface = (D > 0) & (T > 0.5) & ((D_map - D).abs() > 0.1)
    return surface, (D > 0) & ~surface & ((C_map - C).abs().mean(-1) > 0.1)


def _as_adding_masks(
    yours: Yours,
    T: Tensor,
    D_map: Tensor,
    D: Tensor,
    C_map: Tensor,
    C: Tensor,
    *limits: float,
) -> Any:
    """Yours, with the limits of the exercise; the reference for others."""
    if limits != (MIN_TRANSMITTANCE, DEPTH_ERROR_M, COLOUR_ERROR):
        return NotImplemented
    mask = torch.zeros_like(D, dtype=torch.bool)
    return yours(
        T,
        D_map,
        D,
        C_map,
        C,
        gives={"M_s": mask, "M_c": mask},
    )


@exercise(
    chapter=7,
    difficulty=2,
    minutes=8,
    solution=_adding_masks,
    becomes=Becomes("adding_masks", _as_adding_masks),
    hints=(
        "M_s is a union: new area OR wrong depth. Both sides of a depth error count.",
        "M_c takes what is wrong in colour and NOT already in M_s: & ~surface.",
        "No disc can be put where nothing was measured: both masks need D > 0.",
    ),
    wrong=(
        Wrong(_both_needed, says="either reason is enough"),
        Wrong(_one_sign, says="too near is as wrong as too far"),
        Wrong(_overlapping, says="no pixel is in both"),
        Wrong(_missing_depth, says="no disc where nothing was measured"),
    ),
)
def adding_masks(attempt: Attempt) -> None:
    """Where does the map need Gaussians (Eq. 6)?"""
    names = ("M_s", "M_c")
    grey = torch.full((1, 5, 3), 0.5)

    def ask(
        case: str,
        T: list[float],
        rendered_m: list[float],
        D: list[float],
        C: Tensor,
    ) -> tuple[Any, Any]:
        maps = [torch.tensor([row]) for row in (T, rendered_m, D)]
        got = attempt.unpack(attempt.on(case)(*maps, grey, C), names)
        for mask in got:
            right = isinstance(mask, Tensor) and mask.dtype == torch.bool and mask.shape == (1, 5)
            attempt.holds(right, "the masks are boolean", detail="expected two bool tensors [H, W]")
        return got

    case = "five pixels: right, unseen, 20 cm too far, 20 cm too near, unseen and wrong"
    surface, colour = ask(
        case,
        [0.0, 0.9, 0.0, 0.0, 0.9],
        [2.0, 2.0, 2.2, 1.8, 2.5],
        [2.0] * 5,
        grey,
    )
    attempt.holds(
        surface[0, 1] and surface[0, 2],
        "either reason is enough",
        detail=f"M_s is {surface.tolist()}",
    )
    attempt.holds(
        surface[0, 3],
        "too near is as wrong as too far",
        detail="the fourth pixel is not in M_s: use |.|",
    )
    attempt.close(surface, [[0, 1, 1, 1, 1]], "M_s = new or wrong in depth")
    attempt.close(colour, [[0] * 5], "where the colours agree M_c is empty")
    other = grey.clone()
    other[0, 1:] = torch.tensor([0.8, 0.5, 0.8])
    case = "the same, with a wrong colour in all but the first, and the second in the map now"
    surface, colour = ask(
        case,
        [0.0, 0.0, 0.0, 0.0, 0.9],
        [2.0, 2.0, 2.2, 1.8, 2.5],
        [2.0] * 5,
        other,
    )
    attempt.holds(
        not (surface & colour).any(), "no pixel is in both", detail=f"M_c is {colour.tolist()}"
    )
    attempt.close(colour, [[0, 1, 0, 0, 0]], "M_c = wrong in colour only")
    case = (
        "transmittance 0.45 and 0.55, depth 8 cm and 12 cm off, a surface 40 cm from the camera "
        "that nothing covers"
    )
    surface, colour = ask(
        case,
        [0.45, 0.55, 0.0, 0.0, 0.9],
        [2.0, 2.0, 2.08, 2.12, 0.0],
        [2.0, 2.0, 2.0, 2.0, 0.4],
        grey,
    )
    attempt.close(
        surface[:, :4], [[0, 1, 0, 1]], "the limits are 0.5 for T and 10 cm for the depth"
    )
    detail = "the fifth pixel is missing: D is the measured depth, D_map that of the map"
    attempt.holds(
        surface[0, 4],
        "what is measured counts, near or far, where the map has nothing",
        detail=detail,
    )
    case = "colours that are off by 0.08 and 0.12 on average, and by 0.24 in one channel of three"
    similar = grey.clone()
    similar[0, 1] = grey[0, 1] + 0.08
    similar[0, 2] = grey[0, 2] - 0.12
    similar[0, 3, 0] = 0.74
    _, colour = ask(
        case,
        [0.0] * 5,
        [2.0] * 5,
        [2.0] * 5,
        similar,
    )
    attempt.close(
        colour,
        [[0, 0, 1, 0, 0]],
        "the colour error is the mean of the three channels, and its limit is 0.1",
    )
    surface, colour = ask(
        "the same without any measured depth", [0.9] * 5, [0.0] * 5, [0.0] * 5, other
    )
    attempt.holds(
        not (surface | colour).any(),
        "no disc where nothing was measured",
        detail="need D > 0 in both masks",
    )


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
    STAYS: surfels.STAYS,
    BECOMES_STABLE: surfels.BECOMES_STABLE,
    BECOMES_UNSTABLE: surfels.BECOMES_UNSTABLE,
    DELETED: surfels.DELETED,
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
