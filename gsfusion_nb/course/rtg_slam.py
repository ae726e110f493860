"""Exercises of chapter 7 (RTG-SLAM): where a ray meets a disc, and where discs are added."""

import math
from typing import Any

import torch
from torch import Tensor

from .exercise import Attempt, Becomes, Wrong, Yours, exercise

MIN_COSINE = 0.5
MIN_TRANSMITTANCE = 0.5
DEPTH_ERROR_M = 0.1
COLOUR_ERROR = 0.1


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
