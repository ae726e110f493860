"""How opaque a Gaussian is at a pixel, and the gradient of it: exercises of chapters 4 and 5."""

import math

import torch
from torch import Tensor

from ..render.constants import ALPHA_MAX, ALPHA_MIN
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


def _sigma(dx: Tensor, dy: Tensor, conic: Tensor) -> Tensor:
    A, B, C = conic
    return (A * dx**2 + C * dy**2) / 2 + B * dx * dy


def _splat_alpha(dx: Tensor, dy: Tensor, conic: Tensor, opacity: Tensor) -> Tensor:
    alpha = (opacity * torch.exp(-_sigma(dx, dy, conic))).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= ALPHA_MIN, alpha, 0.0)


def _everything_halved(dx: Tensor, dy: Tensor, conic: Tensor, opacity: Tensor) -> Tensor:
    A, B, C = conic
    alpha = (opacity * torch.exp(-(A * dx**2 + B * dx * dy + C * dy**2) / 2)).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= ALPHA_MIN, alpha, 0.0)


def _not_capped(dx: Tensor, dy: Tensor, conic: Tensor, opacity: Tensor) -> Tensor:
    alpha = opacity * torch.exp(-_sigma(dx, dy, conic))
    return torch.where(alpha >= ALPHA_MIN, alpha, 0.0)


def _not_cut(dx: Tensor, dy: Tensor, conic: Tensor, opacity: Tensor) -> Tensor:
    return (opacity * torch.exp(-_sigma(dx, dy, conic))).clamp(max=ALPHA_MAX)


def _without_opacity(dx: Tensor, dy: Tensor, conic: Tensor, opacity: Tensor) -> Tensor:
    return _splat_alpha(dx, dy, conic, torch.ones_like(torch.as_tensor(opacity)))


def _as_splat_alpha(
    yours: Yours,
    dx: Tensor,
    dy: Tensor,
    conic: Tensor,
    opacity: Tensor,
) -> Tensor:
    alpha = torch.zeros_like(dx)
    for k in range(len(dx)):
        alpha[k] = yours(
            dx[k],
            dy[k],
            conic[k],
            opacity[k],
            gives={"alpha": dx[k]},
        )
    return alpha


@exercise(
    chapter=4,
    difficulty=2,
    minutes=8,
    solution=_splat_alpha,
    becomes=Becomes("splat_alpha", _as_splat_alpha),
    hints=(
        "sigma = (A dx^2 + C dy^2) / 2 + B dx dy, with A, B, C = conic. Only the squares are "
        "halved.",
        "alpha = opacity exp(-sigma), and at most 0.99: clamp(max=0.99).",
        "Below 1/255 it is exactly 0: torch.where(alpha >= 1 / 255, alpha, 0.0).",
    ),
    wrong=(
        Wrong(_without_opacity, says="in its centre it is as opaque as opacity says"),
        Wrong(_everything_halved, says="B dx dy is not halved"),
        Wrong(_not_capped, says="never more than 0.99"),
        Wrong(_not_cut, says="below 1/255"),
    ),
)
def splat_alpha(attempt: Attempt) -> None:
    """Opacity of one Gaussian at many pixels: the bell, capped at 0.99 and cut at 1/255."""
    zero = torch.zeros(1)
    round_one = torch.tensor([0.25, 0.0, 0.25])
    got = attempt.on("the centre of a Gaussian of opacity 0.6")(
        zero, zero, round_one, torch.tensor(0.6)
    )
    attempt.close(got, [0.6], "in its centre it is as opaque as opacity says")
    attempt.on("2 px to the right, and 1 px down, of a round Gaussian of standard deviation 2 px")
    dx = torch.tensor([2.0, 0.0])
    dy = torch.tensor([0.0, 1.0])
    reference = 0.6 * torch.exp(-torch.tensor([0.5, 0.125]))
    attempt.close(
        attempt(dx, dy, round_one, torch.tensor(0.6)), reference, "alpha = opacity exp(-sigma)"
    )
    attempt.on("1 px right and 1 px down of a tilted Gaussian, conic (0.3, 0.2, 0.4)")
    got = attempt(
        zero + 1,
        zero + 1,
        torch.tensor([0.3, 0.2, 0.4]),
        torch.tensor(0.6),
    )
    reference = 0.6 * torch.exp(torch.tensor([-0.55]))
    attempt.close(
        got, reference, "B dx dy is not halved: it stands twice in the product of the matrix"
    )
    attempt.on("2 px right and 1 px up of the same Gaussian")
    got = attempt(
        zero + 2,
        zero - 1,
        torch.tensor([0.3, 0.2, 0.4]),
        torch.tensor(0.6),
    )
    reference = 0.6 * torch.exp(torch.tensor([-0.4]))
    attempt.close(got, reference, "A belongs to dx, C to dy, and B dx dy may be negative")
    got = attempt.on("the centre of a Gaussian of opacity 0.999")(
        zero, zero, round_one, torch.tensor(0.999)
    )
    attempt.close(got, [0.99], "it is never more than 0.99, so that some light is left")
    far_offset = torch.full(
        (1,),
        8 * torch.log(torch.tensor(300 * 0.6)).item(),
    ).sqrt()
    got = torch.as_tensor(
        attempt.on("far outside, where the bell is 1/300")(
            far_offset, zero, round_one, torch.tensor(0.6)
        )
    )
    attempt.holds(not got.any(), "below 1/255 it is exactly 0", detail=f"got {got.tolist()}")


def _splat_alpha_vjp(
    dx: Tensor, dy: Tensor, conic: Tensor, opacity: Tensor, v_alpha: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    A, B, C = conic
    bell = torch.exp(-_sigma(dx, dy, conic))
    alpha = opacity * bell
    v_alpha = torch.where((alpha >= ALPHA_MIN) & (alpha < ALPHA_MAX), v_alpha, 0.0)
    v_sigma = -v_alpha * alpha
    v_uv = -torch.stack([(v_sigma * (A * dx + B * dy)).sum(), (v_sigma * (B * dx + C * dy)).sum()])
    v_conic = torch.stack(
        [(v_sigma * dx * dx).sum() / 2, (v_sigma * dx * dy).sum(), (v_sigma * dy * dy).sum() / 2]
    )
    return v_uv, v_conic, (v_alpha * bell).sum()


def _towards_the_pixel_reversed(dx, dy, conic, opacity, v_alpha):
    v_uv, v_conic, v_opacity = _splat_alpha_vjp(dx, dy, conic, opacity, v_alpha)
    return -v_uv, v_conic, v_opacity


def _of_one_pixel(dx, dy, conic, opacity, v_alpha):
    n = len(dx)
    return tuple(v / n for v in _splat_alpha_vjp(dx, dy, conic, opacity, v_alpha))


def _through_the_cap(dx, dy, conic, opacity, v_alpha):
    A, B, C = conic
    bell = torch.exp(-_sigma(dx, dy, conic))
    v_sigma = -v_alpha * opacity * bell
    v_uv = -torch.stack([(v_sigma * (A * dx + B * dy)).sum(), (v_sigma * (B * dx + C * dy)).sum()])
    v_conic = torch.stack(
        [(v_sigma * dx * dx).sum() / 2, (v_sigma * dx * dy).sum(), (v_sigma * dy * dy).sum() / 2]
    )
    return v_uv, v_conic, (v_alpha * bell).sum()


def _opacity_times_alpha(dx, dy, conic, opacity, v_alpha):
    v_uv, v_conic, v_opacity = _splat_alpha_vjp(dx, dy, conic, opacity, v_alpha)
    return v_uv, v_conic, v_opacity * opacity


def _conic_halved(dx, dy, conic, opacity, v_alpha):
    v_uv, v_conic, v_opacity = _splat_alpha_vjp(dx, dy, conic, opacity, v_alpha)
    return v_uv, v_conic * torch.tensor([1.0, 0.5, 1.0]).to(v_conic), v_opacity


def _as_splat_alpha_vjp(
    yours: Yours,
    dx: Tensor,
    dy: Tensor,
    conic: Tensor,
    opacity: Tensor,
    alpha: Tensor,
    v_alpha: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Yours for each Gaussian that some pixel moves."""
    v_uv = dx.new_zeros(len(dx), 2)
    v_conic = torch.zeros_like(conic)
    v_opacity = torch.zeros_like(opacity)
    for k in v_alpha.any(1).nonzero()[:, 0].tolist():
        gives = {"v_uv": v_uv[k], "v_conic": v_conic[k], "v_opacity": v_opacity[k]}
        v_uv[k], v_conic[k], v_opacity[k] = yours(
            dx[k],
            dy[k],
            conic[k],
            opacity[k],
            v_alpha[k],
            gives=gives,
        )
    return v_uv, v_conic, v_opacity


@exercise(
    chapter=5,
    difficulty=3,
    minutes=15,
    solution=_splat_alpha_vjp,
    becomes=Becomes("splat_alpha_vjp", _as_splat_alpha_vjp),
    hints=(
        "alpha = o exp(-sigma): dalpha/do = exp(-sigma), and dalpha/dsigma = -alpha. So v_sigma = "
        "-alpha v_alpha.",
        "dx is pixel minus centre, so d(dx)/du = -1: v_uv = -sum of v_sigma (A dx + B dy, B dx + C "
        "dy).",
        "dsigma/dA = dx^2 / 2, dsigma/dB = dx dy, dsigma/dC = dy^2 / 2. Every result is a sum over "
        "the pixels.",
        "Where alpha is capped at 0.99 or cut at 1/255 nothing moves it: set v_alpha to 0 there "
        "first.",
    ),
    wrong=(
        Wrong(
            _towards_the_pixel_reversed,
            says="more alpha to the right of it pulls the centre to the right",
        ),
        Wrong(_opacity_times_alpha, says="v_opacity = v_alpha exp(-sigma)"),
        Wrong(_of_one_pixel, says="all pixels add up"),
        Wrong(_through_the_cap, says="capped or cut"),
        Wrong(_conic_halved, says="v_conic agrees with autograd"),
    ),
)
def splat_alpha_vjp(attempt: Attempt) -> None:
    """Gradient of a Gaussian's opacity at many pixels: dL/d of its centre, conic and opacity."""
    f64 = torch.float64
    names = ("v_uv", "v_conic", "v_opacity")
    one = torch.ones(1, dtype=f64)
    conic = torch.tensor([0.25, 0.0, 0.25], dtype=f64)
    attempt.on("one pixel 1 px to the right of a round Gaussian, opacity 0.5, dL/dalpha = -1")
    o = torch.tensor(0.5, dtype=f64)
    v_uv, _, v_opacity = attempt.unpack(attempt(one, 0 * one, conic, o, -one), names)
    bell = torch.exp(torch.tensor(-0.125, dtype=f64))
    why = "the gradient is negative there, and descent goes against it"
    attempt.signs(
        v_uv,
        [-1.0, 0.0],
        "more alpha to the right of it pulls the centre to the right",
        why=why,
    )
    attempt.close(
        v_uv, [-0.25 * 0.5 * bell, 0.0], "v_uv = alpha v_alpha (A dx + B dy, B dx + C dy)"
    )
    attempt.close(v_opacity, -bell, "v_opacity = v_alpha exp(-sigma)")
    attempt.on("the same pixel twice")
    v_uv, *_ = attempt.unpack(
        attempt(one.repeat(2), 0 * one.repeat(2), conic, o, -one.repeat(2)),
        names,
    )
    attempt.close(v_uv, [-0.25 * bell, 0.0], "all pixels add up")
    attempt.on("a pixel in the centre of a Gaussian of opacity 0.999, and one far outside")
    dx = torch.tensor([0.1, 30.0], dtype=f64)
    got = attempt.unpack(
        attempt(dx, 0 * dx, conic, torch.tensor(0.999, dtype=f64), torch.ones(2, dtype=f64)),
        names,
    )
    cap_words = "where alpha is capped or cut, nothing moves it"
    attempt.close(
        torch.cat([torch.as_tensor(v, dtype=f64).reshape(-1) for v in got]),
        [0.0] * 6,
        cap_words,
    )
    far_offset = torch.full(
        (1,),
        8 * math.log(300 * 0.5),
        dtype=f64,
    ).sqrt()
    got = attempt.unpack(
        attempt.on("a pixel where the bell is 1/300")(
            far_offset, 0 * far_offset, conic, o, 100 * one
        ),
        names,
    )
    attempt.close(
        torch.cat([torch.as_tensor(v, dtype=f64).reshape(-1) for v in got]),
        [0.0] * 6,
        cap_words,
    )
    attempt.on("forty random pixels around a tilted Gaussian")
    generator = torch.Generator().manual_seed(6)
    uv = torch.zeros(2, dtype=f64, requires_grad=True)
    ellipse_conic = torch.tensor([0.3, 0.1, 0.2], dtype=f64)
    pixel, v = (torch.randn(40, n, generator=generator, dtype=f64) for n in (2, 1))
    c = ellipse_conic.clone().requires_grad_()
    a = torch.tensor(0.7, dtype=f64, requires_grad=True)
    dx, dy = (2 * pixel - uv).unbind(1)
    reference = torch.autograd.grad(
        _splat_alpha(dx, dy, c, a) @ v[:, 0],
        (uv, c, a),
    )
    got = attempt.unpack(
        attempt(dx.detach(), dy.detach(), ellipse_conic, a.detach(), v[:, 0]),
        names,
    )
    for name, mine, right in zip(names, got, reference, strict=True):
        attempt.close(mine, right, f"{name} agrees with autograd")
