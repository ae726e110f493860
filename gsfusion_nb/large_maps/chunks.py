"""Boxes around chunks of rows, and which of them a camera may see.

Rows that were added together are close together, in memory and in space. Around each chunk of
``CHUNK`` rows there is a box, and a chunk whose box cannot reach the picture is left out. What is
left is drawn in the same order, so the picture has the same bits. Chunks that are hidden behind the
measured depth of a view can be left out, too: then a room does not cost what is in the rooms behind
its walls. Their share of the picture is the light that the walls let through.
"""

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, adaptive_max_pool2d

from ..backends import op
from ..geometry import se3
from ..render.constants import ALPHA_MIN, FRUSTUM_CLAMP, SCREEN_BLUR_PX2
from ..types import Camera, GaussianParams

CHUNK = 256
"""Rows in a box."""

GRID = (12, 16)
"""Rows and columns of the cells of a view in which depth is compared."""

BEHIND_M = 0.5
"""Gaussians less far behind the measured depth are drawn, metres: depth and centres have errors."""

PIXEL_REACH = math.sqrt(2 * math.log(1 / ALPHA_MIN))
"""An opaque Gaussian is above 1/255 up to this many standard deviations."""

_MORE = 1.001
"""For rounding."""


class Chunks(NamedTuple):
    """Where the Gaussians of each chunk are, on the CPU."""

    low: Float[ndarray, "C 3"]
    """Lowest centre, world frame, metres; NaN where a row has one."""
    high: Float[ndarray, "C 3"]
    """Highest centre."""
    reach_m: Float[ndarray, " C"]
    """Largest distance from its centre at which a Gaussian of the chunk is above 1/255, metres."""


def seen_chunks(
    chunks: Chunks,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    depth_m: Float[Tensor, "h w"] | None = None,
) -> Int[ndarray, " C"]:
    """Numbers of the chunks that a camera may see, rising; arguments as for ``Boxes.rows``."""
    T_CW = se3.inverse(T_WC.detach().cpu().double()).numpy()
    farthest_m = None if depth_m is None else farthest_depth(depth_m).cpu().numpy()
    return chunks_shown(chunks, camera, T_CW, farthest_m).nonzero()[0]


@op("chunks")
def chunks_shown(
    chunks: Chunks,
    camera: Camera,
    T_CW: Float[ndarray, "4 4"],
    farthest_m: Float[ndarray, "12 16"] | None = None,
) -> Bool[ndarray, " C"]:
    """Whether a view may show Gaussians of a chunk: they may reach its picture
    (``chunks_in_view``), and not all of them are hidden (``chunks_behind``).

    Args:
        chunks: Of the map.
        camera: as given to ``render``.
        T_CW: World-to-camera pose, float64.
        farthest_m: From ``farthest_depth``; None: no depth was measured.
    """
    is_shown = chunks_in_view(chunks, camera, T_CW)
    if farthest_m is not None:
        numbers = is_shown.nonzero()[0]
        in_view = Chunks(*(x[numbers] for x in chunks))
        is_shown[numbers] = ~chunks_behind(in_view, camera, T_CW, farthest_m)
    return is_shown


def rows_of_chunks(chunks: Int[ndarray, " C"], n: int) -> Int[Tensor, " R"]:
    """The rows in some chunks of ``n`` rows."""
    rows = (CHUNK * chunks[:, None] + np.arange(CHUNK)).ravel()
    return torch.from_numpy(rows[rows < n])


def chunks_of_points(xyz_W: Float[Tensor, "N 3"]) -> Chunks:
    """Boxes around chunks of points without extent."""
    low, high = (_by_chunk(extreme, xyz_W).cpu().numpy() for extreme in (torch.amin, torch.amax))
    return Chunks(low, high, np.zeros_like(low[:, 0]))


def chunks_of_gaussians(params: GaussianParams) -> Chunks:
    """Boxes around chunks of Gaussians, with the largest extent in each."""
    reach_m = PIXEL_REACH * _by_chunk(torch.amax, params.log_scale).amax(1).exp()
    return chunks_of_points(params.xyz_W)._replace(reach_m=reach_m.cpu().numpy())


def chunks_with_more_rows(chunks: Chunks, params: GaussianParams, n_before: int) -> Chunks:
    """The boxes of a map to whose first ``n_before`` rows others were added."""
    start = n_before // CHUNK  # the last chunk may not have been full
    more = chunks_of_gaussians(params[start * CHUNK :])
    return Chunks(*(np.concatenate([x[:start], y]) for x, y in zip(chunks, more, strict=True)))


def renew_chunks_(chunks: Chunks, rows: Int[Tensor, " R"], part: GaussianParams) -> None:
    """Change the boxes of whole chunks, whose ``rows`` have the values ``part`` now, in place."""
    numbers = rows[::CHUNK].cpu().numpy() // CHUNK
    for column, values in zip(chunks, chunks_of_gaussians(part), strict=True):
        column[numbers] = values


def _by_chunk(
    extreme: Callable[[Tensor, int], Tensor], x: Float[Tensor, "N 3"]
) -> Float[Tensor, "C 3"]:
    """Smallest or largest value in each chunk; NaN where a row has one. Twice over 16 is faster
    than over 256."""
    n = len(x) // CHUNK * CHUNK
    whole = extreme(
        extreme(x[:n].view(-1, 16, CHUNK // 16, 3), 1),
        1,
    )
    return whole if n == len(x) else torch.cat([whole, extreme(x[n:], 0)[None]])


def chunks_in_view(
    chunks: Chunks, camera: Camera, T_CW: Float[ndarray, "4 4"]
) -> Bool[ndarray, " C"]:
    """Whether Gaussians of a chunk may reach the picture; NaN counts as in view.

    A Gaussian touches the picture only if its centre is in front of the camera and, with half the
    image size h and the focal length f along an axis, and the bound of ``rows_in_view`` on its
    size,

        |f x / z + c - h| <= h + reach sqrt(0.3) + f sqrt(1 + limit^2) reach_m / z .

    Times z this is linear in the centre, so the corner of the box that lies farthest along a plane
    decides.

    Args:
        chunks: Of the map.
        camera: as given to ``render``.
        T_CW: World-to-camera pose.
    """
    planes = view_planes(camera)
    normal = planes[:, :3] @ T_CW[:3]
    factor = planes[:, 3:]
    middle = (chunks.low + chunks.high) / 2
    half = (chunks.high - chunks.low) / 2
    nearest = normal[:, :3] @ middle.T + normal[:, 3:] - np.abs(normal[:, :3]) @ half.T  # [5, C]
    is_outside: Any = (nearest > factor * chunks.reach_m).any(0)
    return ~is_outside


def view_planes(camera: Camera) -> Float[ndarray, "5 4"]:
    """Planes that bound the view: normal n in the camera frame, and factor k of ``reach_m``; a
    centre x is in view where  n . x <= k reach_m  for each."""
    planes = [(0.0, 0.0, -1.0, 0.0)]
    for axis, f, c, size in axes_of(camera):
        h = size / 2
        limit = FRUSTUM_CLAMP * size / (2 * f)
        for sign in (1.0, -1.0):
            n = [0.0, 0.0, sign * (c - h) - h - _MORE * PIXEL_REACH * math.sqrt(SCREEN_BLUR_PX2)]
            n[axis] = sign * f
            planes.append((n[0], n[1], n[2], _MORE * f * math.sqrt(1 + limit**2)))
    return np.array(planes)


def axes_of(
    camera: Camera,
) -> tuple[tuple[int, float, float, int], tuple[int, float, float, int]]:
    """Both axes of a picture: its number, focal length, principal point and number of pixels."""
    return (0, camera.fx, camera.cx, camera.width), (1, camera.fy, camera.cy, camera.height)


def farthest_depth(depth_m: Float[Tensor, "h w"]) -> Float[Tensor, "12 16"]:
    """Largest depth in each cell of ``GRID``, infinite where most of it is not known; of its own
    result the same.

    Args:
        depth_m: z-depth, metres, 0 where missing.
    """
    if depth_m.shape == GRID:
        return torch.where(depth_m > 0, depth_m, torch.inf)
    share = adaptive_avg_pool2d((depth_m > 0).to(depth_m.dtype)[None], GRID)[0]
    return torch.where(
        share > 0.5,
        adaptive_max_pool2d(depth_m[None], GRID)[0],
        torch.inf,
    )


def chunks_behind(
    chunks: Chunks,
    camera: Camera,
    T_CW: Float[ndarray, "4 4"],
    farthest_m: Float[ndarray, "12 16"],
) -> Bool[ndarray, " C"]:
    """Whether all of a chunk is more than ``BEHIND_M`` behind the depth in all cells that it may
    touch.

    Args:
        chunks, camera, T_CW: As for ``chunks_in_view``.
        farthest_m: From ``farthest_depth``.
    """
    low, high, reach_m = chunks
    corners = np.stack(
        [np.where(which, high, low) for which in itertools.product((False, True), repeat=3)],
        1,
    )
    xyz = corners @ T_CW[:3, :3].T + T_CW[:3, 3]  # [C, 8, 3]
    nearest_m = xyz[..., 2].min(1) - reach_m
    in_front = nearest_m > 0
    z = np.where(in_front[:, None], xyz[..., 2], 1.0)
    slope = reach_m / np.where(in_front, nearest_m, 1.0)
    touches = np.ones((len(low), *GRID), bool)
    for axis, f, c, size in axes_of(camera):
        uv = f * xyz[..., axis] / z + c
        cells = GRID[1 - axis]
        more_px = f * (1 + FRUSTUM_CLAMP * size / (2 * f)) * slope + PIXEL_REACH
        first, last = (
            np.floor(edge * cells / size) for edge in (uv.min(1) - more_px, uv.max(1) + more_px)
        )
        in_reach = (np.arange(cells) >= first[:, None]) & (np.arange(cells) <= last[:, None])
        touches &= in_reach[:, None, :] if axis == 0 else in_reach[:, :, None]
    deepest_m = np.where(touches, farthest_m, 0.0).max((1, 2), initial=0.0)
    return in_front & (nearest_m > deepest_m + BEHIND_M)
