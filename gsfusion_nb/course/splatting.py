"""Exercises of chapter 4: the covariance of a splat, and the blending of a pixel."""

import torch
from torch import Tensor

from ..render.composite import blend_weights
from ..render.constants import SCREEN_BLUR_PX2
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


def _jacobian(xyz_C: Tensor, fx: float, fy: float) -> Tensor:
    x, y, z = xyz_C.tolist()
    return xyz_C.new_tensor([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])


def _covariance_2d(xyz_C: Tensor, cov_C: Tensor, fx: float, fy: float) -> Tensor:
    J = _jacobian(xyz_C, fx, fy)
    return J @ cov_C @ J.T + SCREEN_BLUR_PX2 * torch.eye(2).to(cov_C)


def _flat(xyz_C: Tensor, cov_C: Tensor, fx: float, fy: float) -> Tensor:
    J = _jacobian(xyz_C, fx, fy)
    J[:, 2] = 0
    return J @ cov_C @ J.T + SCREEN_BLUR_PX2 * torch.eye(2).to(cov_C)


def _no_low_pass(xyz_C: Tensor, cov_C: Tensor, fx: float, fy: float) -> Tensor:
    J = _jacobian(xyz_C, fx, fy)
    return J @ cov_C @ J.T


def _one_focal_length(xyz_C: Tensor, cov_C: Tensor, fx: float, fy: float) -> Tensor:
    return _covariance_2d(xyz_C, cov_C, fx, fx)


@exercise(
    chapter=4,
    difficulty=3,
    minutes=12,
    solution=_covariance_2d,
    hints=(
        "J holds the derivatives of u = fx x/z + cx and v = fy y/z + cy by x, y and z: two rows, "
        "three columns.",
        "du/dz is not zero: u = fx x/z, so du/dz = -fx x / z^2. Extent along z therefore widens "
        "the ellipse sideways.",
        "The covariance of J x is J cov J^T. The low-pass filter is 0.3 px^2 on both diagonal "
        "entries, added last.",
    ),
    wrong=(
        Wrong(_flat, says="off the axis, extent along z widens the ellipse"),
        Wrong(_no_low_pass, says="a Gaussian too small to see is still about a pixel wide"),
        Wrong(_one_focal_length, says="fy acts on v"),
    ),
)
def covariance_2d(attempt: Attempt) -> None:
    """Project the covariance of a Gaussian onto the image: J cov J^T + 0.3 I."""
    f64 = torch.float64
    axis = torch.tensor([0.0, 0.0, 2.0], dtype=f64)
    got = attempt.on("a point-like Gaussian 2 m ahead")(
        axis, torch.zeros(3, 3, dtype=f64), 100.0, 100.0
    )
    why = "add 0.3 px^2 to the diagonal"
    attempt.close(
        got, 0.3 * torch.eye(2), "a Gaussian too small to see is still about a pixel wide", why=why
    )
    attempt.on("a ball of standard deviation 10 cm, 2 m ahead, f = 100 px")
    got = attempt(axis, 0.01 * torch.eye(3, dtype=f64), 100.0, 100.0)
    attempt.close(
        got, 25.3 * torch.eye(2), "a ball straight ahead gives a circle of (f s / z)^2 + 0.3"
    )
    needle = torch.diag(torch.tensor([0.0, 0.0, 0.04], dtype=f64))
    right = torch.tensor([1.0, 0.0, 2.0], dtype=f64)
    got = attempt.on("a needle along z, 1 m to the right")(right, needle, 100.0, 100.0)
    why = "J needs its third column, du/dz = -fx x / z^2"
    attempt.close(
        got, [[25.3, 0.0], [0.0, 0.3]], "off the axis, extent along z widens the ellipse", why=why
    )
    got = attempt.on("a ball, fx = 100 px and fy = 50 px")(
        axis, 0.01 * torch.eye(3, dtype=f64), 100.0, 50.0
    )
    attempt.close(got, [[25.3, 0.0], [0.0, 6.55]], "fy acts on v")
    xyz = torch.tensor([0.4, -0.3, 1.5], dtype=f64)
    L = torch.tensor(
        [[0.2, 0.0, 0.0], [0.1, 0.1, 0.0], [-0.05, 0.2, 0.3]],
        dtype=f64,
    )
    got = attempt.on("a tilted Gaussian off both axes")(xyz, L @ L.T, 90.0, 110.0)
    attempt.close(got, _covariance_2d(xyz, L @ L.T, 90.0, 110.0), "cov_2D = J cov J^T + 0.3 I")


def _composite_pixel(alpha: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
    T = torch.cat([torch.ones(1).to(alpha), (1 - alpha).cumprod(0)])
    return ((alpha * T[:-1])[:, None] * rgb).sum(0), T[-1]


def _own_alpha_too(alpha: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
    T = (1 - alpha).cumprod(0)
    return ((alpha * T)[:, None] * rgb).sum(0), T[-1] if len(T) else torch.ones(())


def _farthest_first(alpha: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
    return _composite_pixel(alpha.flip(0), rgb.flip(0))


def _no_transmittance(alpha: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
    return (alpha[:, None] * rgb).sum(0), (1 - alpha).prod()


def _averaged(alpha: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
    colour, T = _composite_pixel(alpha, rgb)
    return colour / (1 - T).clamp(min=1e-9), T


def _as_blend(yours: Yours, alpha: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Yours for each pixel: its colour, and alpha = 1 - the light left. The reference blends the
    depth, and blending ends where it ends there."""
    _, w = blend_weights(alpha)
    C = w.T @ c
    rgb = c[:, :3]
    rows = [(column > 0).nonzero()[:, 0] for column in w.T]
    calls = [(alpha[k, p], rgb[k]) for p, k in enumerate(rows)]
    pixels = yours.many(
        calls,
        [{"the colour": rgb.new_zeros(3), "the light left": rgb.new_zeros(())}] * len(calls),
    )
    if pixels:
        C[:, :3] = torch.stack([colour for colour, _ in pixels])
        C[:, 4] = 1 - torch.stack([light for _, light in pixels])
    return w, C


@exercise(
    chapter=4,
    difficulty=2,
    minutes=8,
    solution=_composite_pixel,
    becomes=Becomes("blend", _as_blend),
    hints=(
        "Go through the Gaussians with a number T, the light that is left, which starts at 1.",
        "Each adds alpha * T * colour; then T becomes T * (1 - alpha). The order of these two "
        "lines matters.",
        "Without a loop: T = cumprod of (1 - alpha), shifted by one place so that it starts with "
        "1.",
    ),
    wrong=(
        Wrong(_own_alpha_too, says="nothing is in front of the first one"),
        Wrong(_farthest_first, says="the nearest comes first"),
        Wrong(_no_transmittance, says="only the light that is left"),
        Wrong(_averaged, says="what is not covered stays black"),
    ),
)
def composite_pixel(attempt: Attempt) -> None:
    """Blend the sorted Gaussians of one pixel, nearest first."""
    names = ("colour", "light left")
    red = [1.0, 0.0, 0.0]
    green = [0.0, 1.0, 0.0]
    attempt.on("one red Gaussian of alpha 0.5")
    colour, light = attempt.unpack(
        attempt(torch.tensor([0.5]), torch.tensor([red])),
        names,
    )
    red_is = float(torch.as_tensor(colour)[0])
    detail = (
        f"red is {red_is:.3g}, expected 0.5: alpha 0.5 covers one half, and nothing is "
        "divided by the weights"
    )
    attempt.holds(red_is < 0.99, "what is not covered stays black", detail=detail)
    why = "T in front of a Gaussian does not contain its own alpha"
    attempt.close(colour, [0.5, 0.0, 0.0], "nothing is in front of the first one", why=why)
    attempt.close(light, 0.5, "behind alpha 0.5 half of the light is left")
    attempt.on("red alpha 0.8 in front of green alpha 0.5")
    colour, light = attempt.unpack(
        attempt(torch.tensor([0.8, 0.5]), torch.tensor([red, green])),
        names,
    )
    red_and_green = torch.as_tensor(colour)[:2].double() - torch.tensor(
        [0.8, 0.5], dtype=torch.float64
    )
    attempt.holds(
        float(red_and_green.abs().max()) > 1e-6,
        "what is behind gets only the light that is left",
        detail="red has its whole alpha 0.8 and green its whole alpha 0.5, as if nothing were in "
        "front of it",
    )
    attempt.close(colour, [0.8, 0.1, 0.0], "the nearest comes first", why="w = 0.8 and 0.2 * 0.5")
    attempt.close(light, 0.1, "the light left is the product of all 1 - alpha")
    colour, light = attempt.unpack(
        attempt.on("no Gaussian at all")(torch.zeros(0), torch.zeros(0, 3)),
        names,
    )
    attempt.close(colour, [0.0, 0.0, 0.0], "an empty pixel is black")
    attempt.close(light, 1.0, "an empty pixel keeps all its light")
    generator = torch.Generator().manual_seed(3)
    alpha = torch.rand(7, generator=generator)
    rgb = torch.rand(7, 3, generator=generator)
    colour, light = attempt.unpack(attempt.on("seven random Gaussians")(alpha, rgb), names)
    reference, T = _composite_pixel(alpha, rgb)
    attempt.close(colour, reference, "C = sum of alpha_k T_k c_k")
    attempt.close(light, T, "the light left is the product of all 1 - alpha")
