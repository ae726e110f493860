"""Descriptors that are each other's nearest and clearly so, in one pass over the pairs that may match.

For every row of the first side the pass keeps the nearest descriptor and the distance of the second, for every row of
the other side the distance of its nearest and where that is. Descriptors are four words of 64 bits. Where only features
near a pixel may match, they are sorted into square cells as wide as the search, and a point looks at 3 x 3 of them.
"""

# Arrays are passed on as tuples, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gsfusion_nb.tracking.features import Features
from gsfusion_nb.tracking.matching import MAX_HAMMING, RATIO, SEARCHED_FROM_M
from gsfusion_nb.types import Camera

from ..runtime.arguments import lens_of
from ..runtime.numba.scalars import popcount

_FARTHEST = 257
"""More than two descriptors can differ."""


def match_features(query: Features, reference: Features) -> Tensor:
    """See ``gsfusion_nb.tracking.matching.match_features``."""
    pairs = _match_all(_words(query.descriptors.numpy()), _words(reference.descriptors.numpy()))
    return torch.from_numpy(pairs)


def found_near(
    camera: Camera, xyz_W: np.ndarray, descriptors: np.ndarray, features: Features, T_WC: Tensor, radius_px: float
) -> np.ndarray:
    """See ``gsfusion_nb.tracking.matching.found_near``."""
    points = np.ascontiguousarray(xyz_W), _words(descriptors)
    seen = features.uv.numpy().astype(np.float64), _words(features.descriptors.numpy())
    pose, size = T_WC.detach().cpu().double().contiguous().numpy(), (int(camera.width), int(camera.height))
    return _match_near(points, seen, pose, lens_of(camera), size, float(radius_px))


def _words(descriptors: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(descriptors).view(np.uint64)


@njit(cache=True, error_model="numpy")
def _match_all(query, reference):
    """(query row, reference row) of the matches [P, 2], in the order of the queries."""
    n, m = query.shape[0], reference.shape[0]
    best, first, second = np.full(n, -1), np.full(n, _FARTHEST), np.full(n, _FARTHEST)
    best_of_reference, first_of_reference = np.full(m, -1), np.full(m, _FARTHEST)
    for q in range(n):
        a0, a1, a2, a3 = query[q, 0], query[q, 1], query[q, 2], query[q, 3]
        for r in range(m):
            distance = popcount(a0 ^ reference[r, 0]) + popcount(a1 ^ reference[r, 1])
            distance += popcount(a2 ^ reference[r, 2]) + popcount(a3 ^ reference[r, 3])
            if distance < first_of_reference[r]:
                best_of_reference[r], first_of_reference[r] = q, distance
            if distance < second[q]:
                if distance < first[q]:
                    best[q], first[q], second[q] = r, distance, first[q]
                else:
                    second[q] = distance
    pairs, count = np.empty((n, 2), np.int64), 0
    for q in range(n):
        clear = m > 1 and first[q] <= MAX_HAMMING and first[q] < RATIO * second[q]
        if clear and best_of_reference[best[q]] == q:
            pairs[count, 0], pairs[count, 1] = q, best[q]
            count += 1
    return pairs[:count]


@njit(cache=True, error_model="numpy")
def _cells(uv, radius_px, columns, rows):
    """First feature of every cell and after the last [rows * columns + 1], and the features cell by cell [M]."""
    n = uv.shape[0]
    cell, start = np.empty(n, np.int64), np.zeros(rows * columns + 1, np.int64)
    for f in range(n):
        column = min(max(int(uv[f, 0] / radius_px), 0), columns - 1)
        row = min(max(int(uv[f, 1] / radius_px), 0), rows - 1)
        cell[f] = row * columns + column
        start[cell[f] + 1] += 1
    for c in range(rows * columns):
        start[c + 1] += start[c]
    order, free = np.empty(n, np.int64), start.copy()
    for f in range(n):
        order[free[cell[f]]] = f
        free[cell[f]] += 1
    return start, order


@njit(cache=True, error_model="numpy")
def _match_near(points, seen, T, lens, size, radius_px):
    """(feature, point) of the matches [P, 2], in the order of the features.

    points: positions, world frame [N, 3]; descriptors [N, 4]. seen: pixels [M, 2] and descriptors [M, 4]. T: pose T_WC.
    """
    (xyz_W, words), (uv, w), (width, height) = points, seen, size
    n, m = xyz_W.shape[0], uv.shape[0]
    columns, rows = int(width / radius_px) + 1, int(height / radius_px) + 1
    start, order = _cells(uv, radius_px, columns, rows)
    nearest_of_feature, point_of_feature = np.full(m, _FARTHEST), np.full(m, -1)
    best_of_point, distance_of_point = np.full(n, -1), np.empty(n, np.int64)
    for p in range(n):
        d0, d1, d2 = xyz_W[p, 0] - T[0, 3], xyz_W[p, 1] - T[1, 3], xyz_W[p, 2] - T[2, 3]
        z = d0 * T[0, 2] + d1 * T[1, 2] + d2 * T[2, 2]
        if not z > SEARCHED_FROM_M:
            continue
        u = lens.fx * (d0 * T[0, 0] + d1 * T[1, 0] + d2 * T[2, 0]) / z + lens.cx
        v = lens.fy * (d0 * T[0, 1] + d1 * T[1, 1] + d2 * T[2, 1]) / z + lens.cy
        if not (abs(u - 0.5 * width) <= 0.5 * width + radius_px):
            continue
        if not (abs(v - 0.5 * height) <= 0.5 * height + radius_px):
            continue
        a0, a1, a2, a3 = words[p, 0], words[p, 1], words[p, 2], words[p, 3]
        column, row = int(np.floor(u / radius_px)), int(np.floor(v / radius_px))
        best, first, second = -1, _FARTHEST, _FARTHEST
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            begin, end = r * columns + max(column - 1, 0), r * columns + min(column + 2, columns)
            if begin >= end:
                continue
            for k in range(start[begin], start[end]):
                f = order[k]
                x, y = uv[f, 0] - u, uv[f, 1] - v
                if not x * x + y * y <= radius_px * radius_px:
                    continue
                distance = popcount(a0 ^ w[f, 0]) + popcount(a1 ^ w[f, 1])
                distance += popcount(a2 ^ w[f, 2]) + popcount(a3 ^ w[f, 3])
                nearest_of_feature[f] = min(nearest_of_feature[f], distance)
                if distance < first:
                    best, first, second = f, distance, first
                elif distance < second:
                    second = distance
        if best >= 0 and first <= MAX_HAMMING and first < RATIO * second:
            best_of_point[p], distance_of_point[p] = best, first
    count = 0
    for p in range(n):
        f = best_of_point[p]
        if f >= 0 and distance_of_point[p] == nearest_of_feature[f] and point_of_feature[f] < 0:
            point_of_feature[f] = p
            count += 1
    pairs = np.empty((count, 2), np.int64)
    k = 0
    for f in range(m):
        if point_of_feature[f] >= 0:
            pairs[k, 0], pairs[k, 1] = f, point_of_feature[f]
            k += 1
    return pairs
