"""An exercise of chapter 4: the colour of a Gaussian, seen from a camera centre."""

import math
from typing import Any

import torch
from torch import Tensor

from ..geometry.spherical_harmonics import SH_C0, sh_to_rgb
from .exercise import Attempt, Becomes, Wrong, Yours, exercise

_C1 = math.sqrt(3 / (4 * math.pi))


def _view_colour(sh: Tensor, xyz_W: Tensor, centre_W: Tensor) -> Tensor:
    d = xyz_W - centre_W
    x, y, z = d / d.norm()
    Y = torch.stack([torch.full_like(x, SH_C0), -_C1 * y, _C1 * z, -_C1 * x])
    return (Y @ sh + 0.5).clamp(min=0)


def _seen_backwards(sh: Tensor, xyz_W: Tensor, centre_W: Tensor) -> Tensor:
    return _view_colour(sh, centre_W, xyz_W)


def _no_half(sh: Tensor, xyz_W: Tensor, centre_W: Tensor) -> Tensor:
    x, y, z = (xyz_W - centre_W) / (xyz_W - centre_W).norm()
    return (torch.stack([torch.full_like(x, SH_C0), -_C1 * y, _C1 * z, -_C1 * x]) @ sh).clamp(min=0)


def _not_normalised(sh: Tensor, xyz_W: Tensor, centre_W: Tensor) -> Tensor:
    x, y, z = xyz_W - centre_W
    return (torch.stack([torch.full_like(x, SH_C0), -_C1 * y, _C1 * z, -_C1 * x]) @ sh + 0.5).clamp(
        min=0
    )


def _not_clamped(sh: Tensor, xyz_W: Tensor, centre_W: Tensor) -> Tensor:
    x, y, z = (xyz_W - centre_W) / (xyz_W - centre_W).norm()
    return torch.stack([torch.full_like(x, SH_C0), -_C1 * y, _C1 * z, -_C1 * x]) @ sh + 0.5


def _as_sh_to_rgb(yours: Yours, sh: Tensor, xyz_W: Tensor, camera_centre_W: Tensor) -> Any:
    """Yours for each Gaussian of degree 0 or 1; higher degrees are left to the reference."""
    n, K = sh.shape[:2]
    if K > 4:
        return NotImplemented
    sh = torch.nn.functional.pad(sh, (0, 0, 0, 4 - K))
    rgb = xyz_W.new_zeros(n, 3)
    usable = (
        (xyz_W != camera_centre_W).any(1) & xyz_W.isfinite().all(1) & sh.isfinite().all(2).all(1)
    )
    for k in usable.nonzero()[:, 0].tolist():
        rgb[k] = yours(
            sh[k],
            xyz_W[k],
            camera_centre_W,
            gives={"the colour": rgb[k]},
        )
    return rgb


@exercise(
    chapter=4,
    difficulty=3,
    minutes=10,
    solution=_view_colour,
    becomes=Becomes("sh_to_rgb", _as_sh_to_rgb),
    hints=(
        "d points from the camera to the Gaussian, and has length 1.",
        "Y_0 = 0.2821, Y_1 = -0.4886 y, Y_2 = 0.4886 z, Y_3 = -0.4886 x, with d = (x, y, z).",
        "colour = max(0, 1/2 + Y @ sh): the half makes all-zero coefficients grey.",
    ),
    wrong=(
        Wrong(_no_half, says="all-zero coefficients are middle grey"),
        Wrong(_seen_backwards, says="d goes from the camera to the Gaussian"),
        Wrong(_not_normalised, says="only the direction counts"),
        Wrong(_not_clamped, says="no colour is below 0"),
    ),
)
def view_colour(attempt: Attempt) -> None:
    """Colour of a Gaussian of SH degree 1, seen from a camera centre."""
    origin = torch.zeros(3)
    on_axis = torch.tensor([0.0, 0.0, 1.0])
    attempt.on("coefficients all zero")
    attempt.close(
        attempt(torch.zeros(4, 3), on_axis, origin),
        [0.5] * 3,
        "all-zero coefficients are middle grey",
    )
    sh = torch.zeros(4, 3)
    sh[2] = 0.5
    reference = [0.5 + 0.5 * _C1] * 3
    got = torch.as_tensor(
        attempt.on("a Gaussian 1 m along z, only sh[2] = 0.5")(sh, on_axis, origin)
    ).double()
    detail = f"got {float(got.min()):.3g}, and 0.744 is expected: d = (x - o) / |x - o|"
    attempt.holds(float(got.min()) > 0.499, "d goes from the camera to the Gaussian", detail=detail)
    attempt.close(got, reference, "sh[2] belongs to Y_2 = 0.4886 z")
    attempt.on("the same, camera and Gaussian moved by (1, 2, -3)")
    step = torch.tensor([1.0, 2.0, -3.0])
    prop = "only the way from the camera to the Gaussian counts, not the place in the world"
    attempt.close(attempt(sh, on_axis + step, step), reference, prop, why="d = (x - o) / |x - o|")
    constant = torch.zeros(4, 3)
    constant[0] = 1.0
    attempt.close(
        attempt.on("only sh[0] = 1")(constant, on_axis, origin),
        [0.5 + SH_C0] * 3,
        "sh[0] counts Y_0 = 0.2821",
    )
    attempt.on("the same, 4 m along z")
    attempt.close(
        attempt(sh, 4 * on_axis, origin), reference, "only the direction counts", why="normalise d"
    )
    attempt.on("the same Gaussian, sh[2] = -2")
    attempt.close(attempt(-4 * sh, on_axis, origin), [0.0] * 3, "no colour is below 0")
    attempt.on("the same Gaussian, sh[2] = 2")
    attempt.close(
        attempt(4 * sh, on_axis, origin),
        [0.5 + 2 * _C1] * 3,
        "a colour may be above 1",
    )
    generator = torch.Generator().manual_seed(5)
    sh, xyz, centre = (0.4 * torch.randn(n, 3, generator=generator) for n in (4, 1, 1))
    attempt.on("random coefficients and positions")
    reference = sh_to_rgb(sh[None], xyz, centre[0])[0]
    attempt.close(
        attempt(sh, xyz[0], centre[0]), reference, "order and signs of the basis are Y0, -y, z, -x"
    )
