"""Matching of known 3D points with the features of a view, near the pixels at which a pose predicts them."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from ..backends import op
from ..checks import check_array, check_positive
from ..operands import check_view
from ..types import Camera
from .features import DESCRIPTOR_BYTES, Features, check_features
from .matching import MAX_HAMMING, RATIO

NEAREST_M = 0.1
"""Points nearer than this, or behind the camera, are not searched for."""

_BIT_COUNT = np.array([bin(word).count("1") for word in range(1 << 16)], np.uint8)


def check_found_near(camera: Any, xyz_W: Any, descriptors: Any, features: Any, T_WC: Any, radius_px: float) -> None:
    """Raise ``ValueError`` for arguments that ``found_near`` refuses."""
    check_view(camera, T_WC, torch.device("cpu"))
    check_array("xyz_W", xyz_W, ("N", 3), np.float64)
    check_array("descriptors", descriptors, (len(xyz_W), DESCRIPTOR_BYTES), np.uint8)
    check_features("features", features)
    check_positive("radius_px", radius_px)


@op("matching", check_found_near)
def found_near(
    camera: Camera, xyz_W: ndarray, descriptors: ndarray, features: Features, T_WC: Tensor, radius_px: float
) -> Int[ndarray, "P 2"]:
    """Points that project near a feature with a similar descriptor, mutually best and clearly so.

    Args:
        camera: Intrinsics.
        xyz_W: Points, world frame, metres. [N, 3]
        descriptors: Theirs. [N, 32]
        features: Of the view.
        T_WC: Estimate of its pose. [4, 4]
        radius_px: Largest distance from the predicted pixel.

    Returns:
        (feature row, point row), in the order of the features. [P, 2]

    Differentiable: no.
    """
    from scipy.spatial import KDTree

    uv, seen = in_view(camera, xyz_W, T_WC, radius_px)
    point = seen.nonzero()[0]
    if len(point) == 0 or len(features) == 0:
        return np.zeros((0, 2), np.int64)
    near = KDTree(uv[point]).sparse_distance_matrix(KDTree(features.uv.numpy()), radius_px, output_type="ndarray")
    a, b = point[near["i"]], near["j"].astype(np.int64)
    distance = hamming(descriptors[a], features.descriptors.numpy()[b])
    kept = _clear_and_mutual(a, b, distance)
    return np.stack([b[kept], a[kept]], 1)


def in_view(
    camera: Camera, xyz_W: ndarray, T_WC: Tensor, margin_px: float = 0.0
) -> tuple[Float[ndarray, "N 2"], Bool[ndarray, " N"]]:
    """Pixels of points, and which of them lie in the picture or at most ``margin_px`` beside it."""
    T = T_WC.detach().cpu().double().numpy()
    xyz_C = (xyz_W - T[:3, 3]) @ T[:3, :3]
    z = np.maximum(xyz_C[:, 2], 1e-6)
    uv = np.stack([camera.fx * xyz_C[:, 0] / z + camera.cx, camera.fy * xyz_C[:, 1] / z + camera.cy], 1)
    size = np.array([camera.width, camera.height])
    return uv, (xyz_C[:, 2] > NEAREST_M) & (np.abs(uv - size / 2) <= size / 2 + margin_px).all(1)


def hamming(a: ndarray, b: ndarray) -> Int[ndarray, " N"]:
    """Number of bits in which rows of bytes differ."""
    return _BIT_COUNT[np.ascontiguousarray(a).view(np.uint16) ^ np.ascontiguousarray(b).view(np.uint16)].sum(
        1, dtype=np.int32
    )


def _clear_and_mutual(a: ndarray, b: ndarray, distance: ndarray) -> ndarray:
    """Which candidate pairs are mutually best, close enough, and clearly better than the second best match of a."""
    order = np.lexsort((distance, a))
    a_sorted, d_sorted = a[order], distance[order]
    first = np.diff(a_sorted, prepend=-1) != 0
    place = first.nonzero()[0]
    after = np.minimum(place + 1, len(order) - 1)
    has_second = (after > place) & (a_sorted[after] == a_sorted[place])
    second = np.where(has_second, d_sorted[after], 257)
    best_of_b = np.full(b.max(initial=0) + 1, 257)
    np.minimum.at(best_of_b, b, distance)
    pair = order[place]
    kept = (distance[pair] <= MAX_HAMMING) & (distance[pair] < RATIO * second) & (distance[pair] == best_of_b[b[pair]])
    pair = pair[kept]
    return pair[np.unique(b[pair], return_index=True)[1]]
