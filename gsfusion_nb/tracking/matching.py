"""Matching of features with features and with known 3D points, and the relative pose that follows
from them."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from ..checks import check_array, check_positive
from ..geometry import se3
from ..geometry.operands import check_view
from ..types import Camera
from .features import DESCRIPTOR_BYTES, Features, check_features
from .landmark_pose import LandmarkRows, inverse_or_zero, landmark_pose, landmark_sums

MAX_HAMMING = 64
"""Descriptors that differ in more of their 256 bits are not the same point."""

RATIO = 0.8
"""Largest ratio of best to second best distance (Lowe 2004); it rejects repeated texture."""

RANSAC_PX = 4.0
"""Largest reprojection error that RANSAC accepts, pixels, before the test in standard
deviations."""

RANSAC_ROUNDS = 150
"""Number of random draws. A pose needs three true matches; if 30 % are true, 150 draws fail in 2 %
of the cases."""

MIN_PAIRS = 8
"""Smallest number of matches for a pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RelativePose:
    """Pose of the query camera relative to the reference camera."""

    T_RQ: Float[Tensor, "4 4"]
    """Query camera to reference camera, float64."""
    information: Float[Tensor, "6 6"]
    """Inverse covariance of xi in T_RQ exp(xi): rotation first (1/rad^2), then translation
    (1/m^2)."""
    rows: Int[Tensor, "I 2"]
    """The matches that agree: (query row, reference row)."""
    n_matches: int
    """Number of matches before the geometric test."""


def match_features(query: Features, reference: Features) -> Int[Tensor, "P 2"]:
    """Pairs of rows that are each other's nearest descriptor and clearly nearer than the second
    nearest.

    Args:
        query, reference: Two views; with fewer than two features in one of them nothing matches.

    Returns:
        (query row, reference row), in the order of the query. [P, 2]

    Raises:
        ValueError: impossible features.

    Differentiable: no.
    """
    for name, features in (("query", query), ("reference", reference)):
        check_features(name, features)
    nothing = torch.zeros((0, 2), dtype=torch.int64)
    if len(query) < 2 or len(reference) < 2:
        return nothing
    a = query.descriptors.numpy()
    b = reference.descriptors.numpy()
    distance, nearest = _nearest(a, b, 2)
    first, second = distance.T
    clear = (first <= MAX_HAMMING) & (first < RATIO * second)
    rows = clear.nonzero()[0]
    best = nearest[clear, 0]
    if len(rows) == 0:
        return nothing
    mutual = _nearest(b[best], a, 1)[1][:, 0] == rows
    pairs = np.stack([rows, best], 1)[mutual]
    return torch.from_numpy(pairs.astype(np.int64))


def _nearest(a: ndarray, b: ndarray, k: int) -> tuple[ndarray, ndarray]:
    """Hamming distances to the ``k`` nearest rows of ``b``, and those rows. [A, k] each"""
    return cv2.batchDistance(a, b, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=k)


def relative_pose(camera: Camera, query: Features, reference: Features) -> RelativePose | None:
    """Pose between two views of the same place, from their features alone; None if too few matches
    agree.

    Matches, then RANSAC over poses from three points (OpenCV), then least squares over the errors
    of the agreeing matches in pixels and, where both have depth, in depth.

    Args:
        camera: Intrinsics of both views.
        query: Features of the view whose pose is estimated.
        reference: Features of the reference view.

    Differentiable: no.
    """
    pairs = match_features(query, reference)
    pairs = pairs[reference.has_depth[pairs[:, 1]]]
    if len(pairs) < MIN_PAIRS:
        return None
    rows = rows_of(camera, query, reference, pairs)
    T_RQ = _ransac(rows)
    return None if T_RQ is None else refine_pose(rows, T_RQ, pairs)


def rows_of(
    camera: Camera, query: Features, reference: Features, pairs: Int[Tensor, "P 2"]
) -> LandmarkRows:
    """Points of the reference view, in its camera's frame, where the query view shows them.

    Args:
        camera: Intrinsics of both views.
        query, reference: Their features.
        pairs: (query row, reference row); the reference rows must have depth. [P, 2]
    """
    q, r = pairs.T
    variance = query.sigma_px[q].square() + reference.sigma_px[r].square()
    depth_m = query.xyz_C[q, 2].double() * query.has_depth[q]
    return LandmarkRows(
        camera=camera,
        xyz_W=reference.xyz_C[r].double().numpy(),
        uv=query.uv[q].double().numpy(),
        inverse_depth=inverse_or_zero(depth_m.numpy()),
        sigma_px=variance.sqrt().double().numpy(),
    )


def refine_pose(
    rows: LandmarkRows, T_RQ: Float[Tensor, "4 4"], pairs: Int[Tensor, "P 2"]
) -> RelativePose | None:
    """The pose of ``landmark_pose``; None if fewer than ``MIN_PAIRS`` agree with it.

    Args:
        rows: Points in the reference camera's frame, where the query view shows them.
        T_RQ: Starting pose, query camera to reference camera. [4, 4]
        pairs: The matches; those that agree are returned as ``RelativePose.rows``. [P, 2]

    Returns:
        Pose, information matrix and the matches that agree.
    """
    T = landmark_pose(rows, T_RQ)
    if not bool(torch.isfinite(T).all()):
        return None
    agrees = torch.from_numpy(rows.agree(T))
    if int(agrees.sum()) < MIN_PAIRS:
        return None
    H = landmark_sums(rows, T, T[:3, 3]).H
    # from the reference's axes to those of the query camera
    axes = torch.block_diag(T[:3, :3], T[:3, :3])
    information = (axes.T @ H @ axes)[_ROTATION_FIRST][:, _ROTATION_FIRST]
    return RelativePose(
        T_RQ=T,
        information=information,
        rows=pairs[agrees],
        n_matches=len(pairs),
    )


_ROTATION_FIRST = [3, 4, 5, 0, 1, 2]


def _ransac(rows: LandmarkRows) -> Float[Tensor, "4 4"] | None:
    is_found, rotation, translation, inliers = cv2.solvePnPRansac(
        rows.xyz_W,
        rows.uv,
        rows.camera.K.numpy(),  # pixels and K use the same convention
        None,
        iterationsCount=RANSAC_ROUNDS,
        reprojectionError=RANSAC_PX,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not is_found or inliers is None or len(inliers) < MIN_PAIRS:
        return None
    return se3.inverse(_transform(cv2.Rodrigues(rotation)[0], translation))


def _transform(R: ndarray, t: ndarray) -> Float[Tensor, "4 4"]:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(R)
    T[:3, 3] = torch.from_numpy(t).reshape(3)
    return T


SEARCHED_FROM_M = 0.1
"""Points nearer than this, or behind the camera, are not searched for."""

_BIT_COUNT = np.array(
    [bin(word).count("1") for word in range(1 << 16)],
    np.uint8,
)


def found_near(
    camera: Camera,
    xyz_W: ndarray,
    descriptors: ndarray,
    features: Features,
    T_WC: Tensor,
    radius_px: float,
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

    Raises:
        ValueError: impossible arguments.

    Differentiable: no.
    """
    from scipy.spatial import KDTree

    check_view(camera, T_WC, torch.device("cpu"))
    check_array("xyz_W", xyz_W, ("N", 3), np.float64)
    check_array("descriptors", descriptors, (len(xyz_W), DESCRIPTOR_BYTES), np.uint8)
    check_features("features", features)
    check_positive("radius_px", radius_px)
    uv, is_seen = in_view(camera, xyz_W, T_WC, radius_px)
    point = is_seen.nonzero()[0]
    if len(point) == 0 or len(features) == 0:
        return np.zeros((0, 2), np.int64)
    distances = KDTree(uv[point]).sparse_distance_matrix(
        KDTree(features.uv.numpy()), radius_px, output_type="ndarray"
    )
    a = point[distances["i"]]
    b = distances["j"].astype(np.int64)
    distance = hamming(descriptors[a], features.descriptors.numpy()[b])
    matches = _clear_and_mutual(a, b, distance)
    return np.stack([b[matches], a[matches]], 1)


def in_view(
    camera: Camera, xyz_W: ndarray, T_WC: Tensor, margin_px: float = 0.0
) -> tuple[Float[ndarray, "N 2"], Bool[ndarray, " N"]]:
    """Pixels of points, and which of them lie in the picture or at most ``margin_px`` beside it."""
    T = T_WC.detach().cpu().double().numpy()
    xyz_C = (xyz_W - T[:3, 3]) @ T[:3, :3]
    z = np.maximum(xyz_C[:, 2], 1e-6)
    u = camera.fx * xyz_C[:, 0] / z + camera.cx
    v = camera.fy * xyz_C[:, 1] / z + camera.cy
    uv = np.stack([u, v], 1)
    half = np.array([camera.width, camera.height]) / 2
    in_picture = (np.abs(uv - half) <= half + margin_px).all(1)
    return uv, in_picture & (xyz_C[:, 2] > SEARCHED_FROM_M)


def hamming(a: ndarray, b: ndarray) -> Int[ndarray, " N"]:
    """Number of bits in which rows of bytes differ."""
    words_a = np.ascontiguousarray(a).view(np.uint16)
    words_b = np.ascontiguousarray(b).view(np.uint16)
    return _BIT_COUNT[words_a ^ words_b].sum(1, dtype=np.int32)


def _clear_and_mutual(a: ndarray, b: ndarray, distance: ndarray) -> ndarray:
    """Which candidate pairs are mutually best, close enough, and clearly better than the second
    best match of a."""
    order = np.lexsort((distance, a))
    a_sorted = a[order]
    d_sorted = distance[order]
    first = np.diff(a_sorted, prepend=-1) != 0
    place = first.nonzero()[0]
    next_place = np.minimum(place + 1, len(order) - 1)
    has_second = (next_place > place) & (a_sorted[next_place] == a_sorted[place])
    second = np.where(has_second, d_sorted[next_place], 257)
    best_of_b = np.full(b.max(initial=0) + 1, 257)
    np.minimum.at(best_of_b, b, distance)
    pair = order[place]
    is_clear = (
        (distance[pair] <= MAX_HAMMING)
        & (distance[pair] < RATIO * second)
        & (distance[pair] == best_of_b[b[pair]])
    )
    pair = pair[is_clear]
    return pair[np.unique(b[pair], return_index=True)[1]]
