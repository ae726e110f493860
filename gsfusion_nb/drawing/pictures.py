"""Arrays to pictures: 8-bit RGB images drawn with OpenCV, fast enough to be redrawn while a slider
moves.

Every function takes tensors or numpy arrays and returns a new uint8 RGB array; inputs are not
changed.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from ..errors import ArgumentError

Picture = UInt8[np.ndarray, "_ _ 3"]
"""The type that these functions return."""
ImageLike = (
    Float[Tensor, "H W 3"]
    | UInt8[Tensor, "H W 3"]
    | Float[np.ndarray, "H W 3"]
    | UInt8[np.ndarray, "H W 3"]
)
AnyImage = (
    Float[Tensor, "_ _ 3"]
    | UInt8[Tensor, "_ _ 3"]
    | Float[np.ndarray, "_ _ 3"]
    | UInt8[np.ndarray, "_ _ 3"]
)
"""An image whose size may differ from that of the other arguments."""
MapLike = Float[Tensor, "H W"] | Float[np.ndarray, "H W"]

DEPTH_COLOURS = "turbo"
ERROR_COLOURS = "inferno"
LEVEL_COLOURS = "viridis"
ERROR_LIMIT = 0.25
"""|error| at which an error map has its brightest colour, range 0..1."""
DEPTH_ERROR_LIMIT_M = 0.10
"""|depth error| at which a depth error map has its brightest colour, metres."""

_HATCH = (58, 78)
"""Grey levels of the stripes that mark missing depth."""


def to_uint8(rgb: ImageLike) -> Picture:
    """An image as bytes: 0..1 is clamped and rounded, halves up, NaN becomes black; bytes are
    copied."""
    image = _numpy(rgb)
    if image.dtype == np.uint8:
        return image.copy()
    return (np.clip(np.nan_to_num(image, nan=0.0), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def depth_range_m(*depths: MapLike) -> tuple[float, float]:
    """A common (near, far), metres, for several depth images: 1st and 99th percentile of what is
    not missing."""
    known = [d[np.isfinite(d) & (d > 0)] for d in map(_numpy, depths)]
    values = np.concatenate([v.ravel() for v in known]) if known else np.zeros(0)
    if len(values) == 0:
        return 0.0, 1.0
    near, far = (
        float(v)
        for v in np.percentile(
            values[:: max(1, len(values) // 100_000)],
            (1, 99),
        )
    )
    return near, max(far, near + 1e-3)


def colour_depth(depth_m: MapLike, near_m: float, far_m: float) -> Picture:
    """Depth as colour (turbo: near is dark blue, far is dark red), striped grey where it is
    missing.

    Args:
        depth_m: z-depth, metres, 0 or NaN = missing. [H, W]
        near_m: Depth at the first colour; give both images of a pair the same range.
        far_m: Depth at the last colour.
    """
    if not far_m > near_m:
        raise ArgumentError(f"far_m must be above near_m, got near {near_m} and far {far_m}")
    depth = _numpy(depth_m)
    with np.errstate(invalid="ignore"):
        missing = ~(depth > 0) | ~np.isfinite(depth)
    safe = np.where(missing, near_m, depth)
    image = _colours(DEPTH_COLOURS)[_byte((safe - near_m) / (far_m - near_m))]
    _stripe(image, missing)
    return image


def error_map(rgb: ImageLike, reference: ImageLike, *, limit: float = ERROR_LIMIT) -> Picture:
    """Mean |rgb - reference| over the channels as colour (inferno): black is none, light yellow
    ``limit`` or more."""
    a = to_uint8(rgb)
    b = to_uint8(reference)
    if a.shape != b.shape:
        raise ArgumentError(
            f"rgb and reference must have one shape, got {list(a.shape)} and {list(b.shape)}"
        )
    level = cv2.transform(
        cv2.absdiff(a, b),
        np.full((1, 3), 1 / (3 * limit)),
    )
    return _colours(ERROR_COLOURS)[np.asarray(level, dtype=np.uint8)]


def depth_error_map(
    depth_m: MapLike, reference_m: MapLike, *, limit_m: float = DEPTH_ERROR_LIMIT_M
) -> Picture:
    """|depth - reference| as colour (inferno: light yellow is ``limit_m`` or more), striped where
    one is missing."""
    a = _numpy(depth_m)
    b = _numpy(reference_m)
    if a.shape != b.shape:
        raise ArgumentError(
            f"depth_m and reference_m must have one shape, got {list(a.shape)} and {list(b.shape)}"
        )
    known = (a > 0) & (b > 0) & np.isfinite(a) & np.isfinite(b)
    error = np.abs(np.where(known, a, 0) - np.where(known, b, 0))
    image = _colours(ERROR_COLOURS)[_byte(error / limit_m)]
    _stripe(image, ~known)
    return image


def paint_cells(
    rgb: ImageLike,
    cells: Any,
    *,
    scale: int = 1,
    by_level: bool = True,
    strength: float = 0.75,
) -> Picture:
    """The borders of quadtree cells over an image.

    Args:
        rgb: The image the cells belong to. [H, W, 3]
        cells: Anything with ``x0, y0, width, height, level`` as one-axis tensors or arrays, pixels.
        scale: Enlarge the image by this factor first, so that the borders do not hide small cells.
        by_level: Colour by depth in the tree (dark purple is coarse, yellow is fine), else light
            grey.
        strength: Opacity of the lines.
    """
    image = to_uint8(rgb)
    if scale > 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    x0, y0, width, height, level = (
        np.asarray(_numpy(getattr(cells, name)), dtype=np.int32)
        for name in ("x0", "y0", "width", "height", "level")
    )
    x1 = x0 + width
    y1 = y0 + height
    corners = (
        np.stack(
            [np.stack([x0, x1, x1, x0], 1), np.stack([y0, y0, y1, y1], 1)],
            axis=2,
        )
        * scale
    )
    lines = image.copy()
    palette = _colours(LEVEL_COLOURS)
    deepest = max(int(level.max(initial=0)), 1)
    for depth in np.unique(level):
        colour = (
            palette[round(255 * (0.15 + 0.85 * depth / deepest))]
            if by_level
            else np.array([235, 235, 235])
        )
        cv2.polylines(
            lines,
            list(corners[level == depth]),
            True,
            [int(v) for v in colour],
            1,
        )
    return np.asarray(
        cv2.addWeighted(lines, strength, image, 1 - strength, 0),
        dtype=np.uint8,
    )


def fit_width(image: ImageLike, width: int) -> Picture:
    """The picture, at most ``width`` pixels wide; a wider one is scaled down by averaging."""
    picture = to_uint8(image)
    h, w = picture.shape[:2]
    if w <= width:
        return picture
    size = (width, max(1, round(h * width / w)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def colour_stops(name: str, n: int = 12) -> list[str]:
    """``n`` even steps through a colour map, as "#rrggbb": the colour bar of an HTML page."""
    table = _colours(name)
    return ["#{:02x}{:02x}{:02x}".format(*table[round(i * 255 / (n - 1))]) for i in range(n)]


def _numpy(array: Any) -> np.ndarray:
    return array.detach().cpu().numpy() if isinstance(array, Tensor) else np.asarray(array)


def _stripe(image: np.ndarray, missing: np.ndarray) -> None:
    """Paint diagonal grey stripes over the ``missing`` pixels of ``image``, in place."""
    rows, columns = np.nonzero(missing)
    image[rows, columns] = np.where((rows + columns) // 4 % 2, *_HATCH)[:, None]


def _byte(unit: np.ndarray) -> np.ndarray:
    return (np.clip(unit, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def _colours(name: str) -> np.ndarray:
    """The 256 RGB colours of an OpenCV colour map."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(
        cv2.applyColorMap(ramp, getattr(cv2, f"COLORMAP_{name.upper()}"))[:, 0, ::-1]
    )


LABEL_PX = 26
"""Height of the strip with the labels."""


def side_by_side(
    images: Sequence[AnyImage], labels: Sequence[str] = (), *, gap: int = 6
) -> Picture:
    """Images in a row at the height of the first, with a label strip above if there are labels.

    Args:
        images: At least one image, 0..1 or bytes; others are scaled to the first one's height.
        labels: One per image, or none.
        gap: Space between images, pixels.
    """
    if not images:
        raise ArgumentError("side_by_side needs at least one image, got none")
    if labels and len(labels) != len(images):
        raise ArgumentError(
            f"side_by_side needs one label per image, got {len(labels)} labels for {len(images)} "
            "images"
        )
    height = images[0].shape[0]
    columns = []
    for i, image in enumerate(images):
        picture = to_uint8(image)
        if picture.shape[0] != height:
            width = max(1, round(picture.shape[1] * height / picture.shape[0]))
            picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        if labels:
            picture = np.concatenate([_label(labels[i], picture.shape[1]), picture])
        if i:
            columns.append(
                np.full(
                    (picture.shape[0], gap, 3),
                    CARD,
                    np.uint8,
                )
            )
        columns.append(picture)
    return np.concatenate(columns, axis=1)


def _label(text: str, width: int) -> np.ndarray:
    """A dark strip with light text, made smaller until it fits: readable on a light and on a dark
    page."""
    strip = np.full((LABEL_PX, width, 3), CARD, np.uint8)
    font = cv2.FONT_HERSHEY_SIMPLEX
    size = 0.5
    (text_width, _), _ = cv2.getTextSize(text, font, size, 1)
    size *= min(1.0, (width - 8) / max(text_width, 1))
    cv2.putText(
        strip,
        text,
        (4, LABEL_PX - 9),
        font,
        size,
        CARD_INK,
        1,
        cv2.LINE_AA,
    )
    return strip


CARD = (43, 48, 57)
CARD_INK = (233, 237, 242)
"""Ground and text of pictures in a row; the same on every page."""
BETWEEN = (118, 128, 141)
"""Text and lines on an unknown ground; the contrast is about 4 to white and 5 to a dark page."""
