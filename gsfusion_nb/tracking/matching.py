"""ORB features of a frame with their depth, their matches, and the relative pose that follows from matches."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from torch import Tensor

from ..backends import op
from ..checks import check_array, check_positive
from ..geometry import backproject, se3
from ..geometry.operands import check_operand, check_view
from ..types import Camera, Frame
from .landmark_pose import LandmarkRows, inverse_or_zero, landmark_pose, landmark_sums

FEATURES, LEVELS = 1000, 8
"""Features of a view, and levels of their pyramid. More features: more reliable loops and relocalisation, slower."""

SCALE_FACTOR = 1.2
"""Ratio of neighbouring pyramid levels (Rublee et al. 2011)."""

FAST_THRESHOLD = 7
"""Smallest contrast of a FAST corner, grey levels; low, because the grid limits the number of features."""

DETECTED_PER_KEPT = 4
"""This many times more features are detected than kept, so that image parts with little texture get some, too."""

CORNER_SIGMA_PX = 1.0
"""Standard deviation of a corner's position on its own pyramid level, pixels. A corner is found at a whole pixel and
looks different from another view. With 0.6 the error of redkitchen250's trajectory doubled; that of the room stayed."""

DEPTH_SIGMA_PER_M = 1.6e-3
"""The standard deviation of a depth z is this times z^2, metres (Khoshelham & Elberink 2012: 4 cm at 5 m)."""

DESCRIPTOR_BYTES = 32

EDGE_SHARE = 0.04
"""If depths around a feature differ by more than this share, it is on a depth edge, and its depth is not used."""


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
    """Raise ``ValueError`` unless these are features on the processor, with a descriptor for each pixel."""
    if not isinstance(features, Features):
        raise ValueError(f"{name} must be Features, got {type(features).__name__}")
    cpu = torch.device("cpu")
    check_operand(f"uv of {name}", features.uv, ("M", 2), dtypes=(torch.float32,), device=cpu)
    size = (len(features), DESCRIPTOR_BYTES)
    check_operand(f"descriptors of {name}", features.descriptors, size, dtypes=(torch.uint8,), device=cpu)


def extract_features(frame: Frame, *, count: int, levels: int) -> Features:
    """ORB corners of the frame's grey image, the strongest of each grid cell first, with depth (Rublee et al. 2011).

    The image is divided into square cells, about one per four features. Every cell gives its strongest corner, then
    every cell its second one, and so on, until there are ``count``. So one richly textured poster cannot get them all.

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
        raise ValueError(f"count and levels must be at least 1, got {count} and {levels}")
    grey = cv2.cvtColor(frame.rgb_u8.cpu().numpy(), cv2.COLOR_RGB2GRAY)
    orb = _orb(DETECTED_PER_KEPT * count, levels)
    corners = orb.detect(grey, None)
    if not corners:
        return _rows(frame, np.zeros((0, 2)), np.zeros((0, 32), np.uint8), np.zeros(0))
    position = cv2.KeyPoint.convert(corners)
    strength = np.array([c.response for c in corners])
    kept = _spread(position, strength, count, grey.shape)
    corners, descriptors = orb.compute(grey, [corners[k] for k in kept])
    if descriptors is None:
        return _rows(frame, np.zeros((0, 2)), np.zeros((0, 32), np.uint8), np.zeros(0))
    octave = np.array([c.octave for c in corners]) & 255
    scale = SCALE_FACTOR**octave
    return _rows(frame, _centred(cv2.KeyPoint.convert(corners), scale, grey.shape), descriptors, scale)


@functools.lru_cache(maxsize=8)
def _orb(count: int, levels: int) -> Any:
    return cv2.ORB.create(nfeatures=count, scaleFactor=SCALE_FACTOR, nlevels=levels, fastThreshold=FAST_THRESHOLD)


def _spread(position: ndarray, strength: ndarray, count: int, shape: tuple[int, int]) -> ndarray:
    """Rows of the corners to keep: the strongest of each cell, then the second strongest of each cell, ..."""
    height, width = shape
    edge = max(8.0, 2.0 * (height * width / count) ** 0.5)
    columns = int(width // edge) + 1
    cell = (position[:, 1] // edge).astype(int) * columns + (position[:, 0] // edge).astype(int)
    strongest = np.argsort(-strength, kind="stable")
    order = _stable_order(cell[strongest])
    sorted_cell = cell[strongest][order]
    start = np.maximum.accumulate(np.where(np.diff(sorted_cell, prepend=-1) != 0, np.arange(len(order)), 0))
    rank = np.empty(len(order), int)  # in its cell
    rank[order] = np.arange(len(order)) - start
    return np.sort(strongest[_stable_order(rank)[:count]])


def _stable_order(whole_numbers: ndarray) -> ndarray:
    """Rows in increasing order; NumPy sorts numbers of 16 bits several times as fast as longer ones."""
    small = whole_numbers.max(initial=0) < 1 << 16
    return np.argsort(whole_numbers.astype(np.uint16) if small else whole_numbers, kind="stable")


def _centred(point: ndarray, scale: ndarray, shape: tuple[int, int]) -> ndarray:
    """OpenCV's corner positions in this package's pixel convention.

    ORB reports x = s x_l for pixel x_l of level l (scale s). That pixel's centre is x_l + 0.5 of the level's width W_l,
    so u = (x_l + 0.5) W / W_l. Adding 0.5 to x, right on the finest level, would be wrong by 1.3 px at s = 3.6.
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

    Inverse depth is linear in the image on a plane, so it is interpolated between the four nearest pixel centres. It is
    reliable where all 4 x 4 pixels around are known and agree within ``EDGE_SHARE``.
    """
    height, width = depth_m.shape
    x, y = uv[:, 0] - 0.5, uv[:, 1] - 0.5
    x0 = np.clip(np.floor(x).astype(int), 0, max(width - 2, 0))
    y0 = np.clip(np.floor(y).astype(int), 0, max(height - 2, 0))
    around = np.arange(-1, 3)[:, None]
    rows = np.clip(y0 + around, 0, height - 1)
    columns = np.clip(x0 + around, 0, width - 1)
    patch = depth_m[rows[:, None], columns[None]].astype(float)  # [4, 4, M]
    low, high = patch.min((0, 1)), patch.max((0, 1))
    trusted = (low > 0) & (high - low <= EDGE_SHARE * low)
    inverse = 1.0 / np.where(patch > 0, patch, 1.0)[1:3, 1:3]
    fx, fy = np.clip(x - x0, 0, 1), np.clip(y - y0, 0, 1)
    top = inverse[0, 0] * (1 - fx) + inverse[0, 1] * fx
    bottom = inverse[1, 0] * (1 - fx) + inverse[1, 1] * fx
    return np.where(trusted, 1.0 / (top * (1 - fy) + bottom * fy), 0.0), trusted


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
    pairs = match_features(query, reference)
    pairs = pairs[reference.has_depth[pairs[:, 1]]]
    if len(pairs) < MIN_PAIRS:
        return None
    rows = rows_of(camera, query, reference, pairs)
    T_RQ = _ransac(rows)
    return None if T_RQ is None else refine_pose(rows, T_RQ, pairs)


def rows_of(camera: Camera, query: Features, reference: Features, pairs: Int[Tensor, "P 2"]) -> LandmarkRows:
    """Points of the reference view, in its camera's frame, where the query view shows them.

    Args:
        camera: Intrinsics of both views.
        query, reference: Their features.
        pairs: (query row, reference row); the reference rows must have depth. [P, 2]
    """
    q, r = pairs.T
    sigma_px = (query.sigma_px[q].square() + reference.sigma_px[r].square()).sqrt()
    return LandmarkRows(
        camera=camera,
        xyz_W=reference.xyz_C[r].double().numpy(),
        uv=query.uv[q].double().numpy(),
        inverse_depth=inverse_or_zero((query.xyz_C[q, 2].double() * query.has_depth[q]).numpy()),
        sigma_px=sigma_px.double().numpy(),
    )


def refine_pose(rows: LandmarkRows, T_RQ: Float[Tensor, "4 4"], pairs: Int[Tensor, "P 2"]) -> RelativePose | None:
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
    axes = torch.block_diag(T[:3, :3], T[:3, :3])  # from the reference's axes to those of the query camera
    information = (axes.T @ H @ axes)[_ROTATION_FIRST][:, _ROTATION_FIRST]
    return RelativePose(T_RQ=T, information=information, rows=pairs[agrees], n_matches=len(pairs))


_ROTATION_FIRST = [3, 4, 5, 0, 1, 2]


def _ransac(rows: LandmarkRows) -> Float[Tensor, "4 4"] | None:
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        rows.xyz_W,
        rows.uv,
        rows.camera.K.numpy(),  # pixels and K use the same convention
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
