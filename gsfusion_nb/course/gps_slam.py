"""Exercises of chapter 12: Gaussians blended with a surface in any order, and the gradient
(GPS-SLAM)."""

from typing import Any

import torch
from torch import Tensor

from .exercise import Attempt, Becomes, Wrong, Yours, exercise

F64 = torch.float64


def _weights_over(alpha: Tensor, z: Tensor, D_s: Tensor, eps: float) -> Tensor:
    is_hidden = (D_s > 0) & (z > D_s + eps)
    return torch.where(is_hidden, 0.0, alpha)


def _never_hidden(alpha: Tensor, z: Tensor, D_s: Tensor, eps: float) -> Tensor:
    return alpha


def _no_tolerance(alpha: Tensor, z: Tensor, D_s: Tensor, eps: float) -> Tensor:
    return torch.where((D_s > 0) & (z > D_s), 0.0, alpha)


def _holes_hide(alpha: Tensor, z: Tensor, D_s: Tensor, eps: float) -> Tensor:
    return torch.where(z > D_s + eps, 0.0, alpha)


def _near_the_surface_only(alpha: Tensor, z: Tensor, D_s: Tensor, eps: float) -> Tensor:
    return torch.where(
        (D_s > 0) & ((z - D_s).abs() > eps),
        0.0,
        alpha,
    )


def _seen_or_not(alpha: Tensor, z: Tensor, D_s: Tensor, eps: float) -> Tensor:
    is_hidden = (D_s > 0) & (z > D_s + eps)
    return torch.where(is_hidden, 0.0, torch.ones_like(alpha))


def _as_not_behind(
    yours: Yours,
    alpha: Tensor,
    z: Tensor,
    D_s: Tensor,
    behind_m: float,
) -> Tensor:
    """Yours for each pixel that a Gaussian reaches."""
    w = torch.zeros_like(alpha)
    rows = {p: (alpha[:, p] > 0).nonzero()[:, 0] for p in alpha.any(0).nonzero()[:, 0].tolist()}
    calls = [(alpha[k, p], z[k], D_s[p], behind_m) for p, k in rows.items()]
    gives = [{"the weights": each} for each, *_ in calls]
    for (p, k), own in zip(rows.items(), yours.many(calls, gives), strict=True):
        w[k, p] = own
    return w


@exercise(
    chapter=12,
    difficulty=1,
    minutes=5,
    solution=_weights_over,
    becomes=Becomes("not_behind", _as_not_behind),
    hints=(
        "Start with alpha, and set to 0 what lies behind the surface: which z are too far?",
        "z > D_s + eps is True for the Gaussians that are too far behind. Where D_s is 0 nothing "
        "is behind anything.",
        "torch.where(hidden, 0.0, alpha) with hidden = (D_s > 0) & (z > D_s + eps).",
    ),
    wrong=(
        Wrong(_never_hidden, says="hidden behind the surface"),
        Wrong(_no_tolerance, says="up to eps behind the surface"),
        Wrong(_holes_hide, says="without a surface nothing is hidden"),
        Wrong(_near_the_surface_only, says="in front of the surface"),
        Wrong(_seen_or_not, says="the weight is alpha"),
    ),
)
def weights_over(attempt: Attempt) -> None:
    """Weights of the Gaussians of one pixel: alpha, and 0 for what is hidden behind the surface."""
    D_s = torch.tensor(2.0, dtype=F64)
    eps = 0.25

    def ask(
        case: str,
        alpha: list[float],
        z: list[float],
        D_s: Tensor,
    ) -> Tensor:
        return attempt.on(case)(
            torch.tensor(alpha, dtype=F64),
            torch.tensor(z, dtype=F64),
            D_s,
            eps,
        )

    case = "alpha 0.6 at 3 m, the surface at 2 m, eps 0.25 m"
    attempt.close(
        ask(case, [0.6], [3.0], D_s),
        [0.0],
        "a Gaussian is hidden behind the surface",
        why="3 > 2 + 0.25",
    )
    case = "alpha 0.6 at 2.1 m and 0.3 at 2.25 m, the surface at 2 m, eps 0.25 m"
    prop = "up to eps behind the surface a Gaussian still counts, and the weight is alpha"
    attempt.close(
        ask(case, [0.6, 0.3], [2.1, 2.25], D_s),
        [0.6, 0.3],
        prop,
        why="hidden is z > D_s + eps only",
    )
    case = "alpha 0.6 at 0.5 m, the surface at 2 m, eps 0.25 m"
    attempt.close(
        ask(case, [0.6], [0.5], D_s),
        [0.6],
        "in front of the surface nothing is hidden",
    )
    case = "alpha 0.6 at 3 m, no surface (D_s = 0), eps 0.25 m"
    prop = "without a surface nothing is hidden"
    attempt.close(
        ask(case, [0.6], [3.0], D_s * 0),
        [0.6],
        prop,
        why="D_s = 0 says that none is known",
    )
    attempt.close(
        ask("no Gaussian", [], [], D_s),
        torch.zeros(0),
        "no Gaussians have no weights",
    )
    generator = torch.Generator().manual_seed(6)
    alpha, z = (torch.rand(9, generator=generator, dtype=F64) for _ in range(2))
    reference = _weights_over(alpha, 1.5 + 1.5 * z, D_s, eps)
    w = attempt.on("nine random Gaussians, the surface at 2 m, eps 0.25 m")(
        alpha, 1.5 + 1.5 * z, D_s, eps
    )
    attempt.close(w, reference, "w_i is alpha_i, and 0 where z_i > D_s + eps")


def _blend_over(w: Tensor, c: Tensor, C_s: Tensor) -> tuple[Tensor, Tensor]:
    W = w.sum()
    return (C_s + (w[:, None] * c).sum(0)) / (1 + W), W


def _added(w: Tensor, c: Tensor, C_s: Tensor) -> tuple[Tensor, Tensor]:
    return C_s + (w[:, None] * c).sum(0), w.sum()


def _front_to_back(w: Tensor, c: Tensor, C_s: Tensor) -> tuple[Tensor, Tensor]:
    C = torch.zeros_like(C_s)
    T = 1.0
    for w_i, c_i in zip(w, c, strict=True):
        C = C + T * w_i * c_i
        T = T * (1 - w_i)
    return C + T * C_s, w.sum()


def _no_surface(w: Tensor, c: Tensor, C_s: Tensor) -> tuple[Tensor, Tensor]:
    W = w.sum()
    return (w[:, None] * c).sum(0) / W.clamp(min=1e-9), W


def _only_the_rest(w: Tensor, c: Tensor, C_s: Tensor) -> tuple[Tensor, Tensor]:
    W = w.sum().clamp(max=1)
    return (1 - W) * C_s + (w[:, None] * c).sum(0), W


def _capped(w: Tensor, c: Tensor, C_s: Tensor) -> tuple[Tensor, Tensor]:
    W = w.sum()
    return (C_s + (w[:, None] * c).sum(0)) / (1 + W), W.clamp(max=1)


def _as_blend_with_base(
    yours: Yours,
    w: Tensor,
    c: Tensor,
    C_s: Tensor,
    b: Tensor,
) -> Any:
    """Yours for each pixel; other weights of the surface than 1 are left to the reference."""
    if not bool((b == 1).all()):
        return NotImplemented
    rows = [(column > 0).nonzero()[:, 0] for column in w.T]
    calls = [(w[k, p], c[k], C_s[p]) for p, k in enumerate(rows)]
    gives = [{"the colour": C_s.new_zeros(3), "the sum of the weights": C_s.new_zeros(())}] * len(
        calls
    )
    pixels = yours.many(calls, gives)
    if not pixels:
        return C_s.clone(), b.new_zeros(0)
    return torch.stack([C for C, _ in pixels]), torch.stack([W for _, W in pixels])


@exercise(
    chapter=12,
    difficulty=2,
    minutes=8,
    solution=_blend_over,
    becomes=Becomes("blend_with_base", _as_blend_with_base),
    hints=(
        "It is a weighted mean: the sum of weight times colour, divided by the sum of the weights.",
        "The surface is one more sample: its colour is C_s and its weight is 1.",
        "w[:, None] * c has the weighted colours as rows. Sum over the rows: .sum(0). Return W "
        "without the 1.",
    ),
    wrong=(
        Wrong(_added, says="a mean, not a sum"),
        Wrong(_front_to_back, says="no order"),
        Wrong(_no_surface, says="without Gaussians"),
        Wrong(_only_the_rest, says="the surface keeps its weight"),
        Wrong(_capped, says="W may be larger than 1"),
    ),
)
def blend_over(attempt: Attempt) -> None:
    """Blend the Gaussians of one pixel with the surface below them, in any order."""
    names = ("colour", "sum of the weights")
    grey = torch.full((3,), 0.4, dtype=F64)
    red = [1.0, 0.0, 0.0]
    green = [0.0, 1.0, 0.0]
    attempt.on("no Gaussian over grey 0.4")
    C, W = attempt.unpack(
        attempt(torch.zeros(0, dtype=F64), torch.zeros(0, 3, dtype=F64), grey),
        names,
    )
    attempt.close(
        C, grey, "without Gaussians the pixel is the surface", why="the surface has the weight 1"
    )
    attempt.close(
        W, 0.0, "without Gaussians the pixel is the surface", why="W sums the Gaussians only"
    )
    attempt.on("one Gaussian of weight 0.6, as grey as the surface, 0.4")
    C, W = attempt.unpack(
        attempt(torch.tensor([0.6], dtype=F64), grey[None], grey),
        names,
    )
    attempt.close(
        C,
        grey,
        "a mean, not a sum: equal colours stay as they are",
        why="divide by all weights, 1 + W",
    )
    w = torch.tensor([0.5, 0.5], dtype=F64)
    c = torch.tensor([red, green], dtype=F64)
    C, W = attempt.unpack(
        attempt.on("red and green, both of weight 0.5, over grey 0.4")(w, c, grey), names
    )
    r, g = (float(x) for x in torch.as_tensor(C)[:2])
    prop = "there is no order: equal weights count equally"
    detail = f"red is {r:.3g} and green {g:.3g}"
    attempt.holds(abs(r - g) < 1e-6, prop, detail=detail)
    prop = "the surface keeps its weight 1, whatever lies over it"
    attempt.close(
        C, [0.45, 0.45, 0.2], prop, why="(0.4 + 0.5) / 2 for red and green, 0.4 / 2 for blue"
    )
    attempt.close(W, 1.0, "W is the sum of the Gaussians' weights")
    attempt.on("five black Gaussians of weight 0.9 over grey 0.4")
    C, W = attempt.unpack(
        attempt(torch.full((5,), 0.9, dtype=F64), torch.zeros(5, 3, dtype=F64), grey),
        names,
    )
    prop = "W may be larger than 1"
    attempt.close(C, grey / 5.5, prop, why="0.4 / (1 + 4.5)")
    attempt.close(W, 4.5, prop)
    generator = torch.Generator().manual_seed(5)
    w = torch.rand(7, generator=generator, dtype=F64)
    c = torch.rand(7, 3, generator=generator, dtype=F64)
    C, W = attempt.unpack(attempt.on("seven random Gaussians")(w, c, grey), names)
    reference, total = _blend_over(w, c, grey)
    attempt.close(C, reference, "C = (C_s + sum of w_i c_i) / (1 + W)")
    attempt.close(W, total, "W is the sum of the Gaussians' weights")


def _blend_over_vjp(
    w: Tensor,
    c: Tensor,
    C: Tensor,
    v_C: Tensor,
) -> tuple[Tensor, Tensor]:
    q = v_C / (1 + w.sum())
    return (c - C) @ q, w[:, None] * q


def _not_divided(
    w: Tensor,
    c: Tensor,
    C: Tensor,
    v_C: Tensor,
) -> tuple[Tensor, Tensor]:
    return (c - C) @ v_C, w[:, None] * v_C


def _divisor_held_fixed(
    w: Tensor,
    c: Tensor,
    C: Tensor,
    v_C: Tensor,
) -> tuple[Tensor, Tensor]:
    q = v_C / (1 + w.sum())
    return c @ q, w[:, None] * q


def _no_weight(
    w: Tensor,
    c: Tensor,
    C: Tensor,
    v_C: Tensor,
) -> tuple[Tensor, Tensor]:
    q = v_C / (1 + w.sum())
    return (c - C) @ q, q.expand(len(w), 3)


def _per_channel(
    w: Tensor,
    c: Tensor,
    C: Tensor,
    v_C: Tensor,
) -> tuple[Tensor, Tensor]:
    q = v_C / (1 + w.sum())
    return ((c - C) * q).mean(1), w[:, None] * q


def _downhill(
    w: Tensor,
    c: Tensor,
    C: Tensor,
    v_C: Tensor,
) -> tuple[Tensor, Tensor]:
    q = v_C / (1 + w.sum())
    return (C - c) @ q, w[:, None] * q


def _as_blend_with_base_vjp(
    yours: Yours, w: Tensor, c: Tensor, C: Tensor, b: Tensor, v_C: Tensor
) -> Any:
    """Yours for each pixel whose colour has a gradient; other weights of the surface than 1 are
    left to the reference."""
    if not bool((b == 1).all()):
        return NotImplemented
    v_w = torch.zeros_like(w)
    v_c = torch.zeros_like(c)
    rows = {p: (w[:, p] > 0).nonzero()[:, 0] for p in v_C.any(1).nonzero()[:, 0].tolist()}
    calls = [(w[k, p], c[k], C[p], v_C[p]) for p, k in rows.items()]
    gives = [{"v_w": each_w, "v_c": each_c} for each_w, each_c, _, _ in calls]
    for (p, k), (own_w, own_c) in zip(rows.items(), yours.many(calls, gives), strict=True):
        v_w[k, p] = own_w
        v_c[k] += own_c
    return v_w, v_c


@exercise(
    chapter=12,
    difficulty=3,
    minutes=15,
    solution=_blend_over_vjp,
    becomes=Becomes("blend_with_base_vjp", _as_blend_with_base_vjp),
    hints=(
        "C = S / (1 + W) with S = C_s + sum of w_i c_i. Write q = dL/dS = v_C / (1 + W): the rest "
        "is short.",
        "c_i occurs in S only, with the factor w_i: dL/dc_i = w_i q.",
        "w_i occurs in S, where it gives c_i . q, and in 1 + W: dC / d(1 + W) = -S / (1 + W)^2 = "
        "-C / (1 + W).",
        "Together: dL/dw_i = q . (c_i - C), a sum over the three channels.",
    ),
    wrong=(
        Wrong(_not_divided, says="q = v_C / (1 + W)"),
        Wrong(_divisor_held_fixed, says="the divisor grows with w"),
        Wrong(_no_weight, says="a colour counts with its weight"),
        Wrong(_per_channel, says="all three channels"),
        Wrong(_downhill, says="more weight pulls the pixel towards"),
    ),
)
def blend_over_vjp(attempt: Attempt) -> None:
    """Gradient of the blending with a surface: from dL/dC to dL/dw and dL/dc."""
    names = ("v_w", "v_c")
    attempt.on("one white Gaussian of weight 1 over black, dL/dC = (1, 0, 0)")
    w = torch.ones(1, dtype=F64)
    c = torch.ones(1, 3, dtype=F64)
    C = torch.full((3,), 0.5, dtype=F64)
    v_w, v_c = attempt.unpack(
        attempt(w, c, C, torch.tensor([1.0, 0.0, 0.0], dtype=F64)),
        names,
    )
    attempt.close(
        v_c, [[0.5, 0.0, 0.0]], "q = v_C / (1 + W)", why="1 / (1 + 1), times the weight 1"
    )
    prop = "more weight pulls the pixel towards the Gaussian's colour"
    attempt.signs(v_w, [1.0], prop, why="white is brighter than the pixel")
    attempt.on("a Gaussian with exactly the colour of the pixel")
    own = torch.tensor([0.2, 0.5, 0.7], dtype=F64)
    v_w, _ = attempt.unpack(
        attempt(w * 0.7, own[None].clone(), own, torch.ones(3, dtype=F64)),
        names,
    )
    prop = "the divisor grows with w, too: the pixel's own colour changes nothing"
    attempt.close(v_w, [0.0], prop, why="c - C is 0")
    attempt.on("two Gaussians of weight 0.2 and 0.8, dL/dC = (1, 1, 1)")
    w = torch.tensor([0.2, 0.8], dtype=F64)
    c = torch.tensor([[0.9, 0.1, 0.5], [0.3, 0.6, 0.0]], dtype=F64)
    C = _blend_over(
        w,
        c,
        torch.full((3,), 0.4, dtype=F64),
    )[0]
    v_w, v_c = attempt.unpack(attempt(w, c, C, torch.ones(3, dtype=F64)), names)
    expected_w, expected_c = _blend_over_vjp(w, c, C, torch.ones(3, dtype=F64))
    attempt.close(v_c, expected_c, "a colour counts with its weight", why="w_i q")
    attempt.close(
        v_w,
        expected_w,
        "all three channels pull at a weight",
        why="sum over the channels of q (c_i - C)",
    )
    generator = torch.Generator().manual_seed(8)
    w, c, C_s, v_C = (
        torch.rand(*size, generator=generator, dtype=F64) for size in ((9,), (9, 3), (3,), (3,))
    )
    C = _blend_over(w, c, C_s)[0]
    v_w, v_c = attempt.unpack(attempt.on("nine random Gaussians")(w, c, C, v_C - 0.5), names)
    expected_w, expected_c = _blend_over_vjp(w, c, C, v_C - 0.5)
    attempt.close(v_w, expected_w, "dL/dw_i = q . (c_i - C)")
    attempt.close(v_c, expected_c, "dL/dc_i = w_i q")
