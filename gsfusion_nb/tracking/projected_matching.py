"""Matching of known 3D points with the features of a view, near the pixels at which a pose predicts them."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from ..types import Camera
from .features import Features
from .matching import MAX_HAMMING, RATIO

MOST_NEAR = 16
"""Of the features near a predicted pixel, this many are compared, the nearest."""

NEAREST_M = 0.1
"""Points nearer than this, or behind the camera, are not searched for."""

_BIT_COUNT = np.array([bin(word).count("1") for word in range(1 << 16)], np.uint8)


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
        (feature row, point row). [P, 2]
    """
    from scipy.spatial import KDTree

    nothing = np.zeros((0, 2), np.int64)
    if len(xyz_W) == 0 or len(features) == 0:
        return nothing
    uv, seen = in_view(camera, xyz_W, T_WC, radius_px)
    point = seen.nonzero()[0]
    if len(point) == 0:
        return nothing
    k = min(MOST_NEAR, len(features))
    near = KDTree(features.uv.numpy()).query(uv[point], k=k, distance_upper_bound=radius_px)[1].reshape(-1, k)
    at, place = (near < len(features)).nonzero()
    if len(at) == 0:
        return nothing
    a, b = point[at], near[at, place]
    distance = hamming(descriptors[a], features.descriptors.numpy()[b])
    kept = _clear_and_mutual(a, b, distance)
    return np.stack([b[kept], a[kept]], 1).astype(np.int64)


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
    best_of_b = np.full(b.max() + 1, 257)
    np.minimum.at(best_of_b, b, distance)
    pair = order[place]
    kept = (distance[pair] <= MAX_HAMMING) & (distance[pair] < RATIO * second) & (distance[pair] == best_of_b[b[pair]])
    pair = pair[kept]
    return pair[np.unique(b[pair], return_index=True)[1]]
