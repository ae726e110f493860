"""Exercises of chapter 4: from one Gaussian to a picture."""

import math
from typing import Any

import torch
from torch import Tensor

from ..geometry.spherical_harmonics import SH_C0, sh_to_rgb
from ..render.composite import blend_weights
from ..render.constants import SCREEN_BLUR_PX2, TILE_PX
from ..render.project import Projection
from ..render.tiles import TileLists
from ..types import Camera
from .exercise import Attempt, Becomes, Wrong, Yours, exercise

_C1 = math.sqrt(3 / (4 * math.pi))


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


Number = float | int
Box = tuple[int, int, int, int]


def _ranges(
    low: Number,
    high: Number,
    tile_px: int,
    size: int,
) -> tuple[int, int]:
    n = -(-size // tile_px)
    first = min(max(math.floor(low / tile_px), 0), n)
    return first, max(
        first,
        min(max(math.floor(high / tile_px) + 1, 0), n),
    )


def _tiles_touched(
    u: Number, v: Number, extent_px: Number, width: int, height: int, tile_px: int
) -> Box:
    return (
        *_ranges(u - extent_px, u + extent_px, tile_px, width),
        *_ranges(v - extent_px, v + extent_px, tile_px, height),
    )


def _last_one_missing(
    u: Number, v: Number, extent_px: Number, width: int, height: int, tile_px: int
) -> Box:
    x0, x1, y0, y1 = _tiles_touched(u, v, extent_px, width, height, tile_px)
    return x0, max(x0, x1 - 1), y0, max(y0, y1 - 1)


def _unclamped(
    u: Number, v: Number, extent_px: Number, width: int, height: int, tile_px: int
) -> Box:
    low = [math.floor((c - extent_px) / tile_px) for c in (u, v)]
    high = [math.floor((c + extent_px) / tile_px) + 1 for c in (u, v)]
    return low[0], high[0], low[1], high[1]


def _whole_tiles_only(
    u: Number, v: Number, extent_px: Number, width: int, height: int, tile_px: int
) -> Box:
    return _tiles_touched(
        u, v, extent_px, width // tile_px * tile_px, height // tile_px * tile_px, tile_px
    )


def _as_tile_intersections(
    yours: Yours,
    projection: Projection,
    camera: Camera,
    *,
    tile_px: int = TILE_PX,
    pixels: Tensor | None = None,
) -> TileLists:
    """The Gaussians of each tile, nearest first, by your box of tiles around each Gaussian."""
    tiles_x = -(-camera.width // tile_px)
    tiles_y = -(-camera.height // tile_px)
    lists: list[list[int]] = [[] for _ in range(tiles_x * tiles_y)]
    like_box = torch.zeros(4, dtype=torch.int64)
    nearest_first = projection.depth_m.argsort(stable=True)
    for k in nearest_first[projection.visible[nearest_first]].tolist():
        u, v = projection.uv[k].tolist()
        extent_px = float(projection.extent_px[k].max())
        inputs = (u, v, extent_px, camera.width, camera.height, tile_px)
        x0, x1, y0, y1 = yours(*inputs, gives={"x0, x1, y0, y1": like_box}).tolist()
        if min(x0, y0) < 0 or x1 > tiles_x or y1 > tiles_y:
            yours.fail(
                f"returned {(x0, x1, y0, y1)}, but there are {tiles_x} x {tiles_y} tiles", inputs
            )
        for tile in [y * tiles_x + x for y in range(y0, y1) for x in range(x0, x1)]:
            lists[tile].append(k)
    if pixels is not None:  # tiles without any of them are not drawn
        for tile, members in enumerate(lists):
            y = tile // tiles_x * tile_px
            x = tile % tiles_x * tile_px
            if not pixels[y : y + tile_px, x : x + tile_px].any():
                members.clear()
    gaussian = torch.tensor(
        [k for members in lists for k in members],
        dtype=torch.int64,
        device=projection.uv.device,
    )
    offset = torch.tensor(
        [0, *(len(members) for members in lists)], device=projection.uv.device
    ).cumsum(0)
    return TileLists(
        gaussian=gaussian,
        offset=offset,
        tile_px=tile_px,
        tiles_x=tiles_x,
        tiles_y=tiles_y,
        pixels=pixels,
    )


@exercise(
    chapter=4,
    difficulty=2,
    minutes=10,
    solution=_tiles_touched,
    becomes=Becomes("tile_intersections", _as_tile_intersections),
    hints=(
        "Tile number of a coordinate: floor(coordinate / tile_px). Do it for u - extent and u + "
        "extent.",
        "The ranges are half open, like range(): the end is one more than the last tile.",
        "There are ceil(width / tile_px) tiles across. Clamp both ends to 0 .. that number.",
    ),
    wrong=(
        Wrong(_last_one_missing, says="a splat inside one tile is in that tile"),
        Wrong(_unclamped, says="tiles outside the picture do not exist"),
        Wrong(_whole_tiles_only, says="the last tile may reach beyond the picture's border"),
    ),
)
def tiles_touched(attempt: Attempt) -> None:
    """Which tiles does the box around a splat touch?"""
    names = ("x0", "x1", "y0", "y1")

    half_open = "the ranges are half open: the end is one past the last tile"
    border_words = "tiles outside the picture do not exist"
    beyond = "the last tile may reach beyond the picture's border"
    for u, v, extent, width, height, prop, why in (
        (12, 20, 2, 64, 48, "a splat inside one tile is in that tile", half_open),
        (31, 39, 1, 64, 48, "a coordinate belongs to the tile below it: floor, not round", ""),
        (16, 24, 5, 64, 48, "a splat across a border is on both sides", ""),
        (2, 3, 10, 64, 48, border_words, "clamp the ranges"),
        (62, 46, 10, 64, 48, border_words, "clamp the ranges"),
        (58, 43, 1, 60, 45, beyond, "ceil, not floor"),
    ):
        attempt.on(f"u {u}, v {v}, extent {extent}, picture {width} x {height}, tiles of 8")
        got = attempt.unpack(_as_list(attempt(u, v, extent, width, height, 8)), names)
        attempt.close(
            got,
            _tiles_touched(u, v, extent, width, height, 8),
            prop,
            why=why,
        )
    for case, u in (
        ("u -30, v 20, extent 5: left of the picture", -30.0),
        ("u 100, v 20: right of it", 100.0),
    ):
        x0, x1, *_ = box = attempt.unpack(
            _as_list(attempt.on(case)(u, 20.0, 5.0, 64, 48, 8)),
            names,
        )
        attempt.holds(
            x1 <= x0,
            "a splat outside the picture touches no tile",
            detail=f"got columns {x0} to {x1}",
        )
        in_picture = min(box) >= 0 and max(x0, x1) <= 8
        detail = f"got columns {x0} to {x1}, and there are 8: clamp both ends to 0 .. 8"
        attempt.holds(
            in_picture,
            "tiles outside the picture do not exist, not even as an empty range",
            detail=detail,
        )


def _as_list(value: Any) -> Any:
    """An array of four numbers as a list."""
    return value.tolist() if isinstance(value, Tensor) else value


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
