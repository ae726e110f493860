"""Matching of features with features and with known 3D points, and the relative pose that follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from ..backends import op
from ..checks import check_array, check_positive
from ..geometry import se3
from ..geometry.operands import check_operand, check_view
from ..types import Camera
from .features import DESCRIPTOR_BYTES, Features, check_features, depth_sigma

MAX_HAMMING = 64
"""Descriptors that differ in more of their 256 bits are not the same point."""

RATIO = 0.8
"""Largest ratio of best to second best distance (Lowe 2004); it rejects repeated texture."""

RANSAC_PX = 4.0
"""Largest reprojection error that RANSAC accepts, pixels, before the test in standard deviations."""

RANSAC_ROUNDS = 150
"""Number of random draws. A pose needs three true matches; if 30 % are true, 150 draws fail in 2 % of the cases."""

MIN_PAIRS = 8
"""Smallest number of matches for a pose."""

GATE_CHI2 = 9.21
"""A point agrees if the squares of its two pixel errors, in standard deviations, sum to less (99 %)."""

GATE_DEPTH = 3.0
"""A point agrees if its depth error, in standard deviations, is also less than this."""

CAUCHY = 2.4
"""Larger errors, in standard deviations, get less weight (95 % efficiency for Gaussian errors)."""

ROUNDS = 10
LEAST_STEP = 1e-7
"""``fit_pairs`` takes at most this many Gauss-Newton steps, and ends after one smaller than this, metres and
radians."""

DAMPING = 1e-9
"""Added to the diagonal of its normal equations."""

NEAREST_M = 0.05
"""Points nearer than this, or behind the camera, give no error."""

LEAST_DEPTH_SIGMA_M = 1e-4
"""Smallest standard deviation of a depth error, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointPairs:
    """3D points in a reference camera frame, and their pixels in the query image. One row each, float64."""

    xyz_R: Float[Tensor, "P 3"]
    """Reference camera frame, metres."""
    uv: Float[Tensor, "P 2"]
    """Position in the query image, pixels."""
    depth_m: Float[Tensor, " P"]
    """Measured depth at that pixel, metres; 0 where there is none."""
    sigma_px: Float[Tensor, " P"]
    """Standard deviation of ``uv``, with that of the reference pixel included, pixels."""

    @staticmethod
    def of(query: Features, reference: Features, rows: Int[Tensor, "P 2"]) -> "PointPairs":
        """Pairs of (query row, reference row); the reference rows must have depth."""
        q, r = rows.T
        sigma_px = (query.sigma_px[q].square() + reference.sigma_px[r].square()).sqrt()
        return PointPairs(
            xyz_R=reference.xyz_C[r].double(),
            uv=query.uv[q].double(),
            depth_m=query.xyz_C[q, 2].double() * query.has_depth[q],
            sigma_px=sigma_px.double(),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RelativePose:
    """Pose of the query camera relative to the reference camera."""

    T_RQ: Float[Tensor, "4 4"]
    """Query camera to reference camera, float64."""
    information: Float[Tensor, "6 6"]
    """Inverse covariance of xi in T_RQ exp(xi): rotation first (1/rad^2), then translation (1/m^2)."""
    rows: Int[Tensor, "I 2"]
    """The matches that agree: (query row, reference row)."""
    n_matches: int
    """Number of matches before the geometric test."""


def check_both(query: Any, reference: Any) -> None:
    """Raise ``ValueError`` for arguments that ``match_features`` refuses."""
    for name, features in (("query", query), ("reference", reference)):
        check_features(name, features)


@op("matching", check_both)
def match_features(query: Features, reference: Features) -> Int[Tensor, "P 2"]:
    """Pairs of rows that are each other's nearest descriptor and clearly nearer than the second nearest.

    Args:
        query, reference: Two views; with fewer than two features in one of them nothing matches.

    Returns:
        (query row, reference row), in the order of the query. [P, 2]

    Differentiable: no.
    """
    nothing = torch.zeros((0, 2), dtype=torch.int64)
    if len(query) < 2 or len(reference) < 2:
        return nothing
    a, b = query.descriptors.numpy(), reference.descriptors.numpy()
    distance, nearest = _nearest(a, b, 2)
    clear = (distance[:, 0] <= MAX_HAMMING) & (distance[:, 0] < RATIO * distance[:, 1])
    rows, best = clear.nonzero()[0], nearest[clear, 0]
    if len(rows) == 0:
        return nothing
    mutual = _nearest(b[best], a, 1)[1][:, 0] == rows
    return torch.from_numpy(np.stack([rows[mutual], best[mutual]], 1).astype(np.int64))


def _nearest(a: ndarray, b: ndarray, k: int) -> tuple[ndarray, ndarray]:
    """Hamming distances to the ``k`` nearest rows of ``b``, and those rows. [A, k] each"""
    import cv2

    return cv2.batchDistance(a, b, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=k)


def relative_pose(camera: Camera, query: Features, reference: Features) -> RelativePose | None:
    """Pose between two views of the same place, from their features alone; None if too few matches agree.

    Matches, then RANSAC over poses from three points (OpenCV), then least squares over the errors of the agreeing
    matches in pixels and, where both have depth, in depth.

    Args:
        camera: Intrinsics of both views.
        query: Features of the view whose pose is estimated.
        reference: Features of the reference view.

    Differentiable: no.
    """
    rows = match_features(query, reference)
    rows = rows[reference.has_depth[rows[:, 1]]]
    if len(rows) < MIN_PAIRS:
        return None
    pairs = PointPairs.of(query, reference, rows)
    T_RQ = _ransac(camera, pairs)
    return None if T_RQ is None else refine_pose(camera, pairs, T_RQ, rows)


def refine_pose(
    camera: Camera, pairs: PointPairs, T_RQ: Float[Tensor, "4 4"], rows: Int[Tensor, "P 2"]
) -> RelativePose | None:
    """The pose of ``fit_pairs``; None if fewer than ``MIN_PAIRS`` agree with it.

    Args:
        camera: Intrinsics of the query view.
        pairs: Points and their pixels.
        T_RQ: Starting pose, query camera to reference camera. [4, 4]
        rows: The matches; those that agree are returned as ``RelativePose.rows``. [P, 2]

    Returns:
        Pose, information matrix and the matches that agree.
    """
    T, H = fit_pairs(camera, pairs, T_RQ)
    agrees = is_inlier(camera, pairs, T)
    if int(agrees.sum()) < MIN_PAIRS or not bool(torch.isfinite(T).all()):
        return None
    return RelativePose(T_RQ=T, information=H, rows=rows[agrees], n_matches=len(rows))


def check_pairs(camera: Any, pairs: Any, T_RQ: Any) -> None:
    """Raise ``ValueError`` for arguments that ``fit_pairs`` refuses."""
    cpu = torch.device("cpu")
    check_view(camera, T_RQ, cpu)
    if not isinstance(pairs, PointPairs):
        raise ValueError(f"pairs must be PointPairs, got {type(pairs).__name__}")
    check_operand("uv", pairs.uv, ("P", 2), dtypes=(torch.float64,), device=cpu)
    n = len(pairs.uv)
    for name, shape in (("xyz_R", (n, 3)), ("depth_m", (n,)), ("sigma_px", (n,))):
        check_operand(name, getattr(pairs, name), shape, dtypes=(torch.float64,), device=cpu)


@op("relative_pose", check_pairs)
def fit_pairs(
    camera: Camera, pairs: PointPairs, T_RQ: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "6 6"]]:
    """Least squares over pixel and depth errors with Cauchy weights, by Gauss-Newton from ``T_RQ``.

    With y = T_RQ^-1 x the point in the query camera, the errors in standard deviations are the two of its pixel and
    (y_z - z) / sigma_z, sigma_z^2 = (1.6e-3 y_z^2)^2 + (1.6e-3 x_z^2)^2 + (sigma_px y_z / f)^2; the
    last term is the depth error that an error of the pixel causes on a surface at 45 degrees.

    Args:
        camera: Intrinsics of the query view.
        pairs: Points and their pixels.
        T_RQ: Starting pose, query camera to reference camera. [4, 4]

    Returns:
        Pose, and the normal equations' matrix of the last step: its information, see ``RelativePose``. float64

    Differentiable: no.
    """
    T, eye = T_RQ.double(), torch.eye(6, dtype=torch.float64)
    H = eye
    for _ in range(ROUNDS):
        error, J = pose_errors(camera, pairs, T)
        weight = 1.0 / (1.0 + (error / CAUCHY).square())
        H = torch.einsum("pe,pei,pej->ij", weight, J, J) + DAMPING * eye
        step = torch.linalg.solve(H, -torch.einsum("pe,pei,pe->i", weight, J, error))
        T = T @ se3.exp(torch.cat([step[3:], step[:3]]))
        if float(step.abs().max()) < LEAST_STEP:
            break
    return T, H


def pose_errors(
    camera: Camera, pairs: PointPairs, T_RQ: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3 6"]]:
    """Pixel and depth errors in standard deviations (see ``fit_pairs``), and their derivative.

    The derivative is with respect to xi in T_RQ exp(xi), rotation first: y = T_RQ^-1 x moves by
    dy = [y]x dw - dv. Rows behind the camera, and depth errors without a depth, are zero.

    Returns:
        Errors [P, 3] and Jacobian [P, 3, 6].
    """
    error, scale, y, _ = _errors(camera, pairs, T_RQ)
    z, zero = y[:, 2], torch.zeros_like(y[:, 2])
    du = torch.stack([camera.fx / z, zero, -camera.fx * y[:, 0] / z**2], 1)
    dv = torch.stack([zero, camera.fy / z, -camera.fy * y[:, 1] / z**2], 1)
    dz = torch.stack([zero, zero, torch.ones_like(z)], 1)
    by_y = torch.stack([du, dv, dz], 1) * scale[..., None]
    dy = torch.cat([se3.hat(y), -torch.eye(3, dtype=y.dtype).expand(len(y), 3, 3)], 2)
    return error, by_y @ dy


def is_inlier(camera: Camera, pairs: PointPairs, T_RQ: Float[Tensor, "4 4"]) -> Tensor:
    """Which rows agree with the pose: in front, pixels within 99 %, depth (where known) within 3 sigma. [P]"""
    error, _, _, ahead = _errors(camera, pairs, T_RQ)
    return ahead & (error[:, :2].square().sum(1) < GATE_CHI2) & (error[:, 2].abs() < GATE_DEPTH)


def _errors(camera: Camera, pairs: PointPairs, T_RQ: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Errors [P, 3], the factor that scales each, the points in the query camera, (0, 0, 1) in place of those
    behind it [P, 3], and which are in front [P]."""
    y = se3.apply(se3.inverse(T_RQ), pairs.xyz_R)
    ahead = y[:, 2] > NEAREST_M
    y = torch.where(ahead[:, None], y, y.new_tensor([0.0, 0.0, 1.0]))
    known = pairs.depth_m > 0
    scale = torch.stack([1 / pairs.sigma_px, 1 / pairs.sigma_px, known / _depth_sigma(camera, pairs)], 1)
    scale = scale * ahead[:, None]
    u = camera.fx * y[:, 0] / y[:, 2] + camera.cx - pairs.uv[:, 0]
    v = camera.fy * y[:, 1] / y[:, 2] + camera.cy - pairs.uv[:, 1]
    return torch.stack([u, v, y[:, 2] - pairs.depth_m], 1) * scale, scale, y, ahead


def _depth_sigma(camera: Camera, pairs: PointPairs) -> Tensor:
    measured, known = depth_sigma(pairs.depth_m), depth_sigma(pairs.xyz_R[:, 2])
    slope = pairs.sigma_px * pairs.depth_m / camera.fx
    return (measured.square() + known.square() + slope.square()).sqrt().clamp_min(LEAST_DEPTH_SIGMA_M)


def _ransac(camera: Camera, pairs: PointPairs) -> Float[Tensor, "4 4"] | None:
    import cv2

    found, rotation, translation, inliers = cv2.solvePnPRansac(
        pairs.xyz_R.numpy(),
        pairs.uv.numpy(),
        camera.K.numpy(),  # pixels and K use the same convention
        None,
        iterationsCount=RANSAC_ROUNDS,
        reprojectionError=RANSAC_PX,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < MIN_PAIRS:
        return None
    return se3.inverse(_transform(cv2.Rodrigues(rotation)[0], translation))


def _transform(R: ndarray, t: ndarray) -> Float[Tensor, "4 4"]:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(R)
    T[:3, 3] = torch.from_numpy(t).reshape(3)
    return T


SEARCHED_FROM_M = 0.1
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
    return uv, (xyz_C[:, 2] > SEARCHED_FROM_M) & (np.abs(uv - size / 2) <= size / 2 + margin_px).all(1)


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
