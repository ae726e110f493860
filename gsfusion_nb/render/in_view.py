"""The part of a large map that a camera may see, found without a look at every Gaussian.

Rows that were added together are close together, in memory and in space. Around each chunk of
``CHUNK`` rows there is a box, and a chunk whose box cannot reach the picture is left out. What is
left is drawn in the same order, so the picture has the same bits. Chunks that are hidden behind the
measured depth of a view can be left out, too: then a room does not cost what is in the rooms behind
its walls. Their share of the picture is the light that the walls let through.
"""

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, adaptive_max_pool2d

from ..geometry import se3
from ..types import Camera, GaussianParams
from .constants import ALPHA_MIN, FRUSTUM_CLAMP, SCREEN_BLUR_PX2

CHUNK = 256
"""Rows in a box."""

WHOLE_BELOW = 10_000
WHOLE_BELOW_ON_GPU = 1_000_000
"""A map with fewer rows is drawn, and stepped, as a whole, as it is published. A GPU has to wait
for the boxes: on an H200, steps by part took 17 ms a frame with up to 325,000 rows, where an H100
took 6 without parts."""

MOSTLY_SEEN = 0.7
"""A map of which more is seen is drawn as a whole: to copy so many rows would take longer than to
draw the others."""

GRID = (12, 16)
"""Rows and columns of the cells of a view in which depth is compared."""

BEHIND_M = 0.5
"""Gaussians less far behind the measured depth are drawn, metres: depth and centres have errors."""

_REACH = math.sqrt(2 * math.log(1 / ALPHA_MIN))
"""An opaque Gaussian is above 1/255 up to this many standard deviations."""

_MORE = 1.001
"""For rounding."""

View = TypeVar("View")


class Chunks(NamedTuple):
    """Where the Gaussians of each chunk are, on the CPU."""

    low: Float[ndarray, "C 3"]
    """Lowest centre, world frame, metres; NaN where a row has one."""
    high: Float[ndarray, "C 3"]
    """Highest centre."""
    reach_m: Float[ndarray, " C"]
    """Largest distance from its centre at which a Gaussian of the chunk is above 1/255, metres."""


class Boxes:
    """Boxes around the chunks of a map, which are made anew when its tensors have changed.

    PyTorch counts the changes of a tensor. A kernel that changes one through its memory has to tell
    it.
    """

    def __init__(self) -> None:
        self._of: tuple[int, ...] = ()
        self._chunks = Chunks(
            np.zeros((0, 3)),
            np.zeros((0, 3)),
            np.zeros(0),
        )

    def rows(
        self,
        params: GaussianParams,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        depth_m: Float[Tensor, "h w"] | None = None,
    ) -> Int[Tensor, " R"] | None:
        """Rows of the chunks that a camera may see, rising; None: all rows, because there are few,
        or most are seen.

        Args:
            params: The map.
            camera, T_WC: as given to ``render``.
            depth_m: Measured depth of the view, of any size, 0 where missing; chunks behind it are
                left out. [h, w]
        """
        n = len(params)
        if n < (WHOLE_BELOW if params.xyz_W.device.type == "cpu" else WHOLE_BELOW_ON_GPU):
            return None
        if self._of != _state(params):
            self._chunks = _chunks_of(params)
            self._of = _state(params)
        chunks_seen = seen_chunks(self._chunks, camera, T_WC, depth_m)
        if len(chunks_seen) > MOSTLY_SEEN * len(self._chunks.low):
            return None
        return rows_of_chunks(chunks_seen, n).to(params.xyz_W.device)

    @contextlib.contextmanager
    def appending(self, model: Any) -> Iterator[None]:
        """Context in which rows are only added at the end of a map: the boxes of the others
        stay."""
        start = len(model.params) // CHUNK
        is_current = self._of == _state(model.params)
        yield
        if is_current and self._of != _state(model.params):
            more = _chunks_of(model.params[start * CHUNK :])
            self._chunks = Chunks(
                *(np.concatenate([x[:start], y]) for x, y in zip(self._chunks, more, strict=True))
            )
            self._of = _state(model.params)

    def renew(
        self,
        params: GaussianParams,
        rows: Int[Tensor, " R"],
        part: GaussianParams,
    ) -> None:
        """Follow a change of only these ``rows``, which were all in the last result; ``part``:
        their new values."""
        chunk_numbers = rows[::CHUNK].cpu().numpy() // CHUNK
        for column, values in zip(self._chunks, _chunks_of(part), strict=True):
            column[chunk_numbers] = values
        self._of = _state(params)


def _state(params: GaussianParams) -> tuple[int, ...]:
    """Another one when centres or sizes have changed."""
    columns = params.xyz_W, params.log_scale
    return (len(params), *(x.data_ptr() for x in columns), *(x._version for x in columns))


def seen_chunks(
    chunks: Chunks,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    depth_m: Float[Tensor, "h w"] | None = None,
) -> Int[ndarray, " C"]:
    """Numbers of the chunks that a camera may see, rising; arguments as for ``Boxes.rows``."""
    T_CW = se3.inverse(T_WC.detach().cpu().double()).numpy()
    numbers = chunks_in_view(chunks, camera, T_CW).nonzero()[0]
    if depth_m is None:
        return numbers
    chunks_seen = Chunks(*(x[numbers] for x in chunks))
    return numbers[
        ~chunks_behind(
            chunks_seen,
            camera,
            T_CW,
            farthest_depth(depth_m).cpu().numpy(),
        )
    ]


def rows_of_chunks(chunks: Int[ndarray, " C"], n: int) -> Int[Tensor, " R"]:
    """The rows in some chunks of ``n`` rows."""
    rows = (CHUNK * chunks[:, None] + np.arange(CHUNK)).ravel()
    return torch.from_numpy(rows[rows < n])


def chunks_of_points(xyz_W: Float[Tensor, "N 3"]) -> Chunks:
    """Boxes around chunks of points without extent."""
    low, high = (_by_chunk(extreme, xyz_W).cpu().numpy() for extreme in (torch.amin, torch.amax))
    return Chunks(low, high, np.zeros_like(low[:, 0]))


def _chunks_of(params: GaussianParams) -> Chunks:
    reach_m = _REACH * _by_chunk(torch.amax, params.log_scale).amax(1).exp()
    return chunks_of_points(params.xyz_W)._replace(reach_m=reach_m.cpu().numpy())


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
    # normal in the camera frame, and factor of reach_m: seen if n . x <= k reach_m
    planes = [(0.0, 0.0, -1.0, 0.0)]
    for axis, f, c, size in _axes(camera):
        h = size / 2
        limit = FRUSTUM_CLAMP * size / (2 * f)
        for sign in (1.0, -1.0):
            n = [0.0, 0.0, sign * (c - h) - h - _MORE * _REACH * math.sqrt(SCREEN_BLUR_PX2)]
            n[axis] = sign * f
            planes.append((n[0], n[1], n[2], _MORE * f * math.sqrt(1 + limit**2)))
    normal = np.array(planes)[:, :3] @ T_CW[:3]
    factor = np.array(planes)[:, 3:]
    middle = (chunks.low + chunks.high) / 2
    half = (chunks.high - chunks.low) / 2
    nearest = normal[:, :3] @ middle.T + normal[:, 3:] - np.abs(normal[:, :3]) @ half.T  # [5, C]
    is_outside: Any = (nearest > factor * chunks.reach_m).any(0)
    return ~is_outside


def _axes(camera: Camera) -> tuple[tuple[int, float, float, int], tuple[int, float, float, int]]:
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
    for axis, f, c, size in _axes(camera):
        uv = f * xyz[..., axis] / z + c
        cells = GRID[1 - axis]
        more_px = f * (1 + FRUSTUM_CLAMP * size / (2 * f)) * slope + _REACH
        first, last = (
            np.floor(edge * cells / size) for edge in (uv.min(1) - more_px, uv.max(1) + more_px)
        )
        in_reach = (np.arange(cells) >= first[:, None]) & (np.arange(cells) <= last[:, None])
        touches &= in_reach[:, None, :] if axis == 0 else in_reach[:, :, None]
    deepest_m = np.where(touches, farthest_m, 0.0).max((1, 2), initial=0.0)
    return in_front & (nearest_m > deepest_m + BEHIND_M)


def drawn_in_part(
    draw: Callable[[GaussianParams], View],
    params: GaussianParams,
    boxes: Boxes | None,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    depth_m: Float[Tensor, "h w"] | None = None,
    take: Callable[[Int[Tensor, " R"] | None], GaussianParams] | None = None,
) -> View:
    """The result of ``draw``, for which only the part of the map is drawn that the camera may see.

    Args:
        draw: From Gaussians to a dataclass of images; those whose names end with ``_index`` hold
            rows, -1: none.
        params: The map.
        boxes: Of the map; None draws all of it.
        camera, T_WC: as given to ``render``.
        depth_m: Measured depth, of any size: what is hidden behind it is left out, also where the
            map has a hole.
        take: Gives the values of some rows [R], or of all (None); those in ``params`` by default.
    """
    rows = None if boxes is None else boxes.rows(params, camera, T_WC, depth_m)
    if rows is None:
        return draw(params if take is None else take(None))
    view: Any = draw(params[rows] if take is None else take(rows))
    indices = {
        name: x for name, x in vars(view).items() if name.endswith("_index") and x is not None
    }
    of_map = torch.cat([rows, rows.new_tensor([-1])])  # -1 is the last one
    return dataclasses.replace(
        view,
        **{name: of_map[x.long()].to(x.dtype) for name, x in indices.items()},
    )
