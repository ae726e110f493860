"""ORB features of a frame, spread over the image, with the depth of each."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from ..errors import ArgumentError
from ..geometry import backproject
from ..geometry.operands import check_operand
from ..types import Frame

FEATURES = 1000
LEVELS = 8
"""Features of a view, and levels of their pyramid. More features: more reliable loops and
relocalisation, slower."""

SCALE_FACTOR = 1.2
"""Ratio of neighbouring pyramid levels (Rublee et al. 2011)."""

FAST_THRESHOLD = 7
"""Smallest contrast of a FAST corner, grey levels; low, because the grid limits the number of
features."""

DETECTED_PER_KEPT = 4
"""This many times more features are detected than kept, so that image parts with little texture get
some, too."""

CORNER_SIGMA_PX = 1.0
"""Standard deviation of a corner's position on its own pyramid level, pixels. A corner is found at
a whole pixel and looks different from another view. With 0.6 the error of redkitchen250's
trajectory doubled; that of the room stayed."""

DEPTH_SIGMA_PER_M = 1.6e-3
"""The standard deviation of a depth z is this times z^2, metres (Khoshelham & Elberink 2012: 4 cm
at 5 m)."""

DESCRIPTOR_BYTES = 32

EDGE_SHARE = 0.04
"""If depths around a feature differ by more than this share, it is on a depth edge, and its depth
is not used."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """ORB features of one image, one row each."""

    uv: Float[Tensor, "M 2"]
    """Continuous pixel coordinates; the centre of pixel (i, j) is (i + 0.5, j + 0.5)."""
    descriptors: UInt8[Tensor, "M 32"]
    """256 bits, compared by Hamming distance."""
    xyz_C: Float[Tensor, "M 3"]
    """3D point of the feature, camera frame, metres; the origin where there is no depth."""
    has_depth: Bool[Tensor, " M"]
    """Whether the depth is known and the feature is not on a depth edge."""
    sigma_px: Float[Tensor, " M"]
    """Standard deviation of ``uv``, pixels: larger for coarser pyramid levels."""

    def __len__(self) -> int:
        return self.uv.shape[0]

    def __getitem__(self, rows) -> "Features":
        return Features(**{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)})


def check_features(name: str, features: Any) -> None:
    """Raise ``ValueError`` unless these are features on the processor, with a descriptor for each
    pixel."""
    if not isinstance(features, Features):
        raise ArgumentError(f"{name} must be Features, got {type(features).__name__}")
    cpu = torch.device("cpu")
    check_operand(
        f"uv of {name}",
        features.uv,
        ("M", 2),
        dtypes=(torch.float32,),
        device=cpu,
    )
    size = (len(features), DESCRIPTOR_BYTES)
    check_operand(
        f"descriptors of {name}", features.descriptors, size, dtypes=(torch.uint8,), device=cpu
    )


def extract_features(frame: Frame, *, count: int, levels: int) -> Features:
    """ORB corners of the frame's grey image, the strongest of each grid cell first, with depth
    (Rublee et al. 2011).

    The image is divided into square cells, about one per four features. Every cell gives its
    strongest corner, then every cell its second one, and so on, until there are ``count``. So one
    richly textured poster cannot get them all.

    Args:
        frame: Colour and depth.
        count: Largest number of features to return.
        levels: Number of pyramid levels, each 1.2 times smaller.

    Returns:
        Features on the CPU; none if the image is black or plain.

    Raises:
        ValueError: ``count`` or ``levels`` below 1.

    Differentiable: no.
    """
    if count < 1 or levels < 1:
        raise ArgumentError(f"count and levels must be at least 1, got {count} and {levels}")
    grey = cv2.cvtColor(frame.rgb_u8.cpu().numpy(), cv2.COLOR_RGB2GRAY)
    orb = _orb(DETECTED_PER_KEPT * count, levels)
    corners = orb.detect(grey, None)
    if not corners:
        return _rows(
            frame,
            np.zeros((0, 2)),
            np.zeros((0, 32), np.uint8),
            np.zeros(0),
        )
    position = cv2.KeyPoint.convert(corners)
    strength = np.array([c.response for c in corners])
    rows = _spread(position, strength, count, grey.shape)
    corners, descriptors = orb.compute(grey, [corners[k] for k in rows])
    if descriptors is None:
        return _rows(
            frame,
            np.zeros((0, 2)),
            np.zeros((0, 32), np.uint8),
            np.zeros(0),
        )
    octave = np.array([c.octave for c in corners]) & 255
    scale = SCALE_FACTOR**octave
    return _rows(
        frame, _centred(cv2.KeyPoint.convert(corners), scale, grey.shape), descriptors, scale
    )


@functools.lru_cache(maxsize=8)
def _orb(count: int, levels: int) -> Any:
    return cv2.ORB.create(
        nfeatures=count, scaleFactor=SCALE_FACTOR, nlevels=levels, fastThreshold=FAST_THRESHOLD
    )


def _spread(
    position: ndarray,
    strength: ndarray,
    count: int,
    shape: tuple[int, int],
) -> ndarray:
    """Rows of the corners to keep: the strongest of each cell, then the second strongest of each
    cell, ..."""
    height, width = shape
    edge = max(8.0, 2.0 * (height * width / count) ** 0.5)
    columns = int(width // edge) + 1
    column, row = (position // edge).astype(int).T
    cell = row * columns + column
    strongest = np.argsort(-strength, kind="stable")
    order = _stable_order(cell[strongest])
    sorted_cell = cell[strongest][order]
    place = np.arange(len(order))
    begins = np.diff(sorted_cell, prepend=-1) != 0
    start = np.maximum.accumulate(np.where(begins, place, 0))
    rank = np.empty(len(order), int)  # in its cell
    rank[order] = place - start
    return np.sort(strongest[_stable_order(rank)[:count]])


def _stable_order(whole_numbers: ndarray) -> ndarray:
    """Rows in increasing order; NumPy sorts numbers of 16 bits several times as fast as longer
    ones."""
    small = whole_numbers.max(initial=0) < 1 << 16
    return np.argsort(whole_numbers.astype(np.uint16) if small else whole_numbers, kind="stable")


def _centred(point: ndarray, scale: ndarray, shape: tuple[int, int]) -> ndarray:
    """OpenCV's corner positions in this package's pixel convention.

    ORB reports x = s x_l for pixel x_l of level l (scale s). That pixel's centre is x_l + 0.5 of
    the level's width W_l, so u = (x_l + 0.5) W / W_l. Adding 0.5 to x, right on the finest level,
    would be wrong by 1.3 px at s = 3.6.
    """
    size = np.array([shape[1], shape[0]], float)
    level_size = np.rint(size / scale[:, None])
    return (np.rint(point / scale[:, None]) + 0.5) * size / level_size


def _rows(frame: Frame, uv: ndarray, descriptors: ndarray, scale: ndarray) -> Features:
    depth_m, has_depth = _depth_at(frame.depth_m.cpu().numpy(), uv)
    at = torch.from_numpy(uv).float()
    return Features(
        uv=at,
        descriptors=torch.from_numpy(np.ascontiguousarray(descriptors)),
        xyz_C=backproject(frame.camera, at, torch.from_numpy(depth_m).float()),
        has_depth=torch.from_numpy(has_depth),
        sigma_px=torch.from_numpy(CORNER_SIGMA_PX * scale).float(),
    )


def _depth_at(depth_m: ndarray, uv: ndarray) -> tuple[ndarray, ndarray]:
    """Depth at continuous pixels, and whether it is reliable; 0 where it is not.

    Inverse depth is linear in the image on a plane, so it is interpolated between the four nearest
    pixel centres. It is reliable where all 4 x 4 pixels around are known and agree within
    ``EDGE_SHARE``.
    """
    height, width = depth_m.shape
    x = uv[:, 0] - 0.5
    y = uv[:, 1] - 0.5
    x0 = np.clip(
        np.floor(x).astype(int),
        0,
        max(width - 2, 0),
    )
    y0 = np.clip(
        np.floor(y).astype(int),
        0,
        max(height - 2, 0),
    )
    offsets = np.arange(-1, 3)[:, None]
    rows = np.clip(y0 + offsets, 0, height - 1)
    columns = np.clip(x0 + offsets, 0, width - 1)
    patch = depth_m[rows[:, None], columns[None]].astype(float)  # [4, 4, M]
    low = patch.min((0, 1))
    high = patch.max((0, 1))
    is_smooth = (low > 0) & (high - low <= EDGE_SHARE * low)
    inverse = 1.0 / np.where(patch > 0, patch, 1.0)[1:3, 1:3]
    fx = np.clip(x - x0, 0, 1)
    fy = np.clip(y - y0, 0, 1)
    top = inverse[0, 0] * (1 - fx) + inverse[0, 1] * fx
    bottom = inverse[1, 0] * (1 - fx) + inverse[1, 1] * fx
    inverse_at = top * (1 - fy) + bottom * fy
    return np.where(is_smooth, 1.0 / inverse_at, 0.0), is_smooth
