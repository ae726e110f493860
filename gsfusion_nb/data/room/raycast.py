"""Exact first hits of a pinhole camera's rays on the room's surface pieces: flat ones (rectangles,
discs) as arrays, curved ones (cones, ellipsoids) one by one.

A ray is t r with r = (x, y, 1) in the camera frame, so t is z-depth. It meets the plane n.P = k at
inverse depth w = 1 / t = (n.r) / k, and the four edges of a rectangle on it are linear in r too:
each row of pixels meets a rectangle in one closed-form interval. Curved patches are solved as
quadratics in float64. The larger w is nearer.
"""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from ...types import Camera
from .patches import CurvedPatch, FlatPatches

_NEAR_M = 0.02


class CameraPatches:
    """The patches in the frame of one camera: linear forms in (x, y, 1)."""

    def __init__(
        self, flat: FlatPatches, curved: Sequence[CurvedPatch], camera: Camera, T_WC: ndarray
    ):
        self.flat = flat
        self.curved = curved
        self.camera = camera
        self.R = T_WC[:3, :3].astype(float)
        self.eye = T_WC[:3, 3].astype(float)
        self.x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        self.y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        to_centre = flat.centre - self.eye
        distance = (flat.normal * to_centre).sum(-1)
        self.front = distance < -1e-6
        k = np.where(self.front, distance, -1.0)[:, None]
        self.W = (flat.normal @ self.R) / k
        """Inverse depth on the patch's plane is W . (x, y, 1). [n, 3]"""
        self.A = flat.right @ self.R - (flat.right * to_centre).sum(-1)[:, None] * self.W
        """Coordinate along the patch's right axis, metres, times w. [n, 3]"""
        self.B = flat.up @ self.R - (flat.up * to_centre).sum(-1)[:, None] * self.W

    def local_rays(
        self, patch: CurvedPatch, x: ndarray, y: ndarray
    ) -> tuple[ndarray, list[ndarray]]:
        """Origin and direction components of rays through (x, y, 1) in a curved patch's frame."""
        shape = patch.shape
        M = shape.R.T @ self.R
        return (self.eye - shape.t) @ shape.R, [
            M[i, 0] * x + M[i, 1] * y + M[i, 2] for i in range(3)
        ]

    def bounds(self, corners_C: ndarray) -> ndarray:
        """Pixel rectangles (row0, row1, column0, column1) of convex hulls of camera-frame points;
        empty if not visible.

        [n, k, 3] -> [n, 4]. A hull that crosses the near plane is cut there, pair by pair (a
        superset of its edges).
        """
        cam = self.camera
        z = corners_C[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = cam.fx * corners_C[..., 0] / z + cam.cx
            v = cam.fy * corners_C[..., 1] / z + cam.cy
        low_high = np.stack(
            [v.min(1) - 1, v.max(1) + 2, u.min(1) - 1, u.max(1) + 2],
            1,
        )
        nearest = z.min(1)
        farthest = z.max(1)
        for i in np.flatnonzero((nearest < _NEAR_M) & (farthest > _NEAR_M)):
            is_near = z[i] < _NEAR_M
            p = corners_C[i, is_near][:, None]
            q = corners_C[i, ~is_near][None]
            s = (_NEAR_M - p[..., 2:]) / (q[..., 2:] - p[..., 2:])
            points = np.concatenate([q[0], (p + s * (q - p)).reshape(-1, 3)])
            u_i = cam.fx * points[:, 0] / points[:, 2] + cam.cx
            v_i = cam.fy * points[:, 1] / points[:, 2] + cam.cy
            low_high[i] = v_i.min() - 1, v_i.max() + 2, u_i.min() - 1, u_i.max() + 2
        low_high[farthest <= _NEAR_M] = 0
        size = np.array([cam.height, cam.height, cam.width, cam.width])
        return np.clip(low_high, 0, size).astype(np.int64)


def cast(view: CameraPatches) -> tuple[ndarray, ndarray]:
    """Inverse z-depth of the first patch that each pixel centre's ray meets (1/metres, 0 if there
    is none, [H, W] float32), and its number (flat ones first, -1 if there is none, [H, W]
    int32)."""
    w = np.zeros((view.camera.height, view.camera.width), np.float32)
    patch = np.full(w.shape, -1, np.int32)
    _cast_flat(view, w, patch)
    _cast_curved(view, w, patch)
    return w, patch


def _cast_flat(view: CameraPatches, w: ndarray, patch: ndarray) -> None:
    flat = view.flat
    right = flat.right * flat.half_w[:, None]
    up = flat.up * flat.half_h[:, None]
    corners = np.stack(
        [flat.centre + a * right + b * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))],
        1,
    )
    corners = (corners - view.eye) @ view.R
    bounds = view.bounds(corners)
    is_seen = view.front & (bounds[:, 0] < bounds[:, 1]) & (bounds[:, 2] < bounds[:, 3])
    columns = np.arange(view.camera.width)
    for i in np.flatnonzero(is_seen):
        row0, row1, col0, col1 = bounds[i].tolist()
        first, last = _row_intervals(view, i, view.y[row0:row1])
        np.maximum(first, col0, out=first)
        np.minimum(last, col1 - 1, out=last)
        j = columns[None, col0:col1]
        mask = (j >= first[:, None]) & (j <= last[:, None])
        area = (slice(row0, row1), slice(col0, col1))
        W = view.W[i]
        w_here = (W[0] * view.x[col0:col1]).astype(np.float32) + (
            W[1] * view.y[row0:row1] + W[2]
        ).astype(np.float32)[:, None]
        mask &= w_here > w[area]
        if flat.disc[i]:
            mask &= _inside_disc(
                view,
                i,
                view.x[None, col0:col1],
                view.y[row0:row1, None],
            )
        np.copyto(w[area], w_here, where=mask)
        np.copyto(patch[area], np.int32(i), where=mask)


def _row_intervals(
    view: CameraPatches,
    i: int | np.intp,
    y: ndarray,
) -> tuple[ndarray, ndarray]:
    """First and last pixel column inside rectangle ``i`` on each row: the four edges |A.r| <= h_w
    w, |B.r| <= h_h w."""
    W = view.W[i]
    a = view.A[i]
    b = view.B[i]
    half_w = view.flat.half_w[i]
    half_h = view.flat.half_h[i]
    low = np.full(y.shape, -1e9)
    high = np.full(y.shape, 1e9)
    for E in (half_w * W + a, half_w * W - a, half_h * W + b, half_h * W - b):
        rest = E[1] * y + E[2]
        if abs(E[0]) < 1e-12:
            high[rest < 0] = -1e9
        elif E[0] > 0:
            np.maximum(low, -rest / E[0], out=low)
        else:
            np.minimum(high, -rest / E[0], out=high)
    cam = view.camera
    # Faces that share an edge must not both miss a ray through it: widen by far less than a pixel.
    first = np.ceil(
        np.clip(
            low * cam.fx + cam.cx - 0.5 - 1e-7,
            -1,
            cam.width + 1,
        )
    )
    last = np.floor(
        np.clip(
            high * cam.fx + cam.cx - 0.5 + 1e-7,
            -2,
            cam.width,
        )
    )
    return first.astype(np.int64), last.astype(np.int64)


def _inside_disc(
    view: CameraPatches,
    i: int | np.intp,
    x: ndarray,
    y: ndarray,
) -> ndarray:
    W = view.W[i]
    a = view.A[i]
    b = view.B[i]
    aw, bw, w = (c[0] * x + c[1] * y + c[2] for c in (a, b, W))
    return aw * aw + bw * bw <= (view.flat.half_w[i] * w) ** 2


_BOX_CORNERS = np.array(
    [[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)],
    float,
)


def _cast_curved(view: CameraPatches, w: ndarray, patch: ndarray) -> None:
    first = len(view.flat.chart)
    shapes = [piece.shape for piece in view.curved]
    corners = np.stack([shape.t + (_BOX_CORNERS * shape.extent) @ shape.R.T for shape in shapes])
    corners = (corners - view.eye) @ view.R
    bounds = view.bounds(corners)
    nearest = np.maximum(corners[..., 2].min(1), _NEAR_M)
    candidates = np.flatnonzero((bounds[:, 0] < bounds[:, 1]) & (bounds[:, 2] < bounds[:, 3]))
    for i in candidates[np.argsort(nearest[candidates])]:
        piece = view.curved[i]
        if not piece.may_face(view.eye):
            continue
        row0, row1, col0, col1 = bounds[i].tolist()
        w_area = w[row0:row1, col0:col1]
        rows, cols = np.nonzero(w_area < 1.0 / nearest[i])
        if rows.size == 0:
            continue
        o, d = view.local_rays(
            piece,
            view.x[col0:col1][cols],
            view.y[row0:row1][rows],
        )
        w_here = (1.0 / piece.shape.intersect(o, d)).astype(np.float32)
        closer = w_here > w_area[rows, cols]
        rows = rows[closer]
        cols = cols[closer]
        w_area[rows, cols] = w_here[closer]
        patch[row0:row1, col0:col1][rows, cols] = first + i
