"""Colour of a view from its hits: mip-mapped texture lookups at 2x2 points per pixel.

Inside a patch the four points lie on the patch's tangent plane at the pixel centre (exact on flat
patches). Where neighbouring pixels belong to different patches, the four points are intersected
with those patches again.
"""

import numpy as np
from numpy import ndarray

from .atlas import LEVELS, level_offsets, texels
from .raycast import CameraPatches
from .scene import Scene

_POINTS = np.array(
    [[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]],
    np.float32,
)
"""Sample points in a pixel, from its centre, pixels."""

_DITHER = np.array([0.125, 0.625, 0.875, 0.375], np.float32)
"""Added to the mip level before rounding down: over the four points this blends neighbouring
levels."""


def colour(scene: Scene, view: CameraPatches, inverse_depth: ndarray, patches: ndarray) -> ndarray:
    """sRGB image, 0..1, of what ``cast`` found. [H, W, 3] float32"""
    H, W = patches.shape
    lookup = _TextureLookup(scene, view)
    offsets = _POINTS / np.array([view.camera.fx, view.camera.fy], np.float32)
    patch = patches.ravel()
    x = np.tile(view.x.astype(np.float32), H)
    y = np.repeat(view.y.astype(np.float32), W)
    w = inverse_depth.ravel()
    U, V, level = lookup.sample(patch, x, y, w, offsets)
    total = np.zeros((H * W, 3), np.uint16)
    for k in range(4):
        total += lookup.fetch(U[k], V[k], level + _DITHER[k])
    edges = _edge_pixels(patches)
    if edges.size:
        total[edges] = _edge_colour(lookup, inverse_depth, patches, edges, offsets)
    total[patch < 0] = 0
    return (total.astype(np.float32) * np.float32(1 / 1020)).reshape(H, W, 3)


class _TextureLookup:
    """Tables of one view, one row per patch, and the lookups that use them."""

    def __init__(self, scene: Scene, view: CameraPatches):
        self.view = view
        self.scene = scene
        flat = view.flat
        layout = scene.layout
        self.n_flat = len(flat.chart)
        scale_u = (layout.w[flat.chart] / flat.chart_w)[:, None]
        scale_v = (layout.h[flat.chart] / flat.chart_h)[:, None]
        centre_u = (layout.x + 0.5 * layout.w)[flat.chart][:, None]
        centre_v = (layout.y + 0.5 * layout.h)[flat.chart][:, None]
        forms = (view.W, centre_u * view.W + scale_u * view.A, centre_v * view.W - scale_v * view.B)
        self.w, self.u, self.v = (np.ascontiguousarray(f.T.astype(np.float32)) for f in forms)
        self.inv_texel = (1 / scene.texel_of_patch).astype(np.float32)
        cols, rows = level_offsets(layout.height)
        self.cols = cols - 0.5
        self.rows = rows - 0.5
        self.scales = np.float32(0.5) ** np.arange(LEVELS + 1, dtype=np.float32)

    def segments(self, patch: ndarray) -> list[tuple[int, ndarray]]:
        """(curved patch number, indices of the samples on it) of a flat array of patch numbers."""
        on_curved = np.flatnonzero(patch >= self.n_flat)
        number = (patch[on_curved] - self.n_flat).astype(np.uint16)
        order = np.argsort(number, kind="stable")
        number = number[order]
        on_curved = on_curved[order]
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        return [
            (int(number[s]), part)
            for s, part in zip(
                starts,
                np.split(on_curved, starts[1:]),
                strict=False,
            )
        ]

    def sample(
        self, patch: ndarray, x: ndarray, y: ndarray, w: ndarray, offsets: ndarray
    ) -> tuple[ndarray, ndarray, ndarray]:
        """Level-0 texel coordinates [S, N] at ``offsets`` [S, 2] from the rays (x, y) that meet
        ``patch`` at 1/w, and the mip level [N]. The points between rays lie on the tangent plane
        n.P = k, where w = n.r / k."""
        row = np.minimum(patch, self.n_flat - 1)
        wx = self.w[0][row]
        wy = self.w[1][row]
        parts = self.segments(patch)
        for i, at in parts:
            wx[at], wy[at] = self._tangent(i, x[at], y[at], w[at])
        xs = x + offsets[:, :1]
        ys = y + offsets[:, 1:]
        inv = 1.0 / np.maximum(
            w + offsets[:, :1] * wx + offsets[:, 1:] * wy,
            1e-3,
        )
        U, V = ((f[0][row] * xs + f[1][row] * ys + f[2][row]) * inv for f in (self.u, self.v))
        for i, at in parts:
            U[:, at], V[:, at] = self._curved_texels(i, xs[:, at], ys[:, at], inv[:, at])
        return U, V, self.level(patch, x, y, w, wx, wy)

    def _tangent(
        self,
        i: int,
        x: ndarray,
        y: ndarray,
        w: ndarray,
    ) -> tuple[ndarray, ndarray]:
        """Gradient of w along the tangent plane of curved patch ``i``."""
        piece = self.view.curved[i]
        o, d = self.view.local_rays(piece, x, y)
        t = 1.0 / w
        n = piece.shape.normal(o + t[:, None] * np.stack(d, -1)) @ (piece.shape.R.T @ self.view.R)
        k = t * (n[:, 0] * x + n[:, 1] * y + n[:, 2])
        k = np.minimum(k, -0.02 * t)  # at the silhouette the ray lies in the tangent plane
        return n[:, 0] / k, n[:, 1] / k

    def _curved_texels(
        self,
        i: int,
        x: ndarray,
        y: ndarray,
        t: ndarray,
    ) -> tuple[ndarray, ndarray]:
        piece = self.view.curved[i]
        layout = self.scene.layout
        o, d = self.view.local_rays(piece, x, y)
        p = o + np.stack(d, -1) * t[..., None]
        if piece.shape is not piece.solid:  # a piece of a rounded box
            p = piece.solid.to_local(p @ piece.shape.R.T + piece.shape.t)
        face, u, v = piece.solid.chart(p)
        chart = piece.charts[face]
        chart = np.where(chart < 0, piece.charts.max(), chart)
        return layout.x[chart] + layout.w[chart] * u, layout.y[chart] + layout.h[chart] * v

    def level(
        self,
        patch: ndarray,
        x: ndarray,
        y: ndarray,
        w: ndarray,
        wx: ndarray,
        wy: ndarray,
    ) -> ndarray:
        """Mip level at which a texel is about half the pixel's larger footprint on the surface.

        P = t r gives |dP/dx| = t sqrt(1 - 2 g x + g^2 |r|^2) with g = t dw/dx.
        """
        t = 1.0 / np.maximum(w, 1e-3)
        r2 = x * x + y * y + 1
        gx = wx * t
        gy = wy * t
        jx = (1 - 2 * gx * x + gx * gx * r2) / self.view.camera.fx**2
        jy = (1 - 2 * gy * y + gy * gy * r2) / self.view.camera.fy**2
        footprint = (0.5 * t * self.inv_texel[patch]) ** 2 * np.maximum(jx, jy)
        return np.clip(0.5 * np.log2(np.maximum(footprint, 1e-6)), 0, LEVELS).astype(np.float32)

    def fetch(self, U: ndarray, V: ndarray, level: ndarray) -> ndarray:
        """Bilinear texels of the rounded-down level. [N, 3] uint8"""
        at = np.minimum(level.astype(np.uint8), LEVELS)
        scale = self.scales[at]
        return texels(
            self.scene.atlas,
            U * scale + self.cols[at],
            V * scale + self.rows[at],
        )


def _edge_pixels(patch: ndarray) -> ndarray:
    """Flat indices of pixels with a 4-neighbour on another patch."""
    edge = np.zeros(patch.shape, bool)
    differs_x = patch[:, 1:] != patch[:, :-1]
    differs_y = patch[1:] != patch[:-1]
    edge[:, 1:] |= differs_x
    edge[:, :-1] |= differs_x
    edge[1:] |= differs_y
    edge[:-1] |= differs_y
    return np.flatnonzero(edge)


def _edge_colour(
    lookup: _TextureLookup,
    inverse_depth: ndarray,
    patches: ndarray,
    edges: ndarray,
    offsets: ndarray,
) -> ndarray:
    """Sum of the four points' colours on edge pixels. [E, 3] uint16"""
    view = lookup.view
    H, W = patches.shape
    row, col = np.divmod(edges, W)
    centre = patches[row, col]
    shifts = ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))
    neighbours = np.stack(
        [patches[np.clip(row + i, 0, H - 1), np.clip(col + j, 0, W - 1)] for i, j in shifts],
        1,
    )
    neighbours.sort(axis=1)
    fresh = np.concatenate(
        [np.ones((len(edges), 1), bool), neighbours[:, 1:] != neighbours[:, :-1]],
        1,
    )
    pixel, slot = np.nonzero(fresh)
    x = view.x[col][:, None] + offsets[:, 0].astype(float)
    y = view.y[row][:, None] + offsets[:, 1].astype(float)
    w = np.full((len(edges), neighbours.shape[1], 4), -1.0)
    candidate = neighbours[pixel, slot]
    w[pixel, slot] = _inverse_depth(
        lookup,
        view,
        candidate,
        x[pixel],
        y[pixel],
    )
    best = w.argmax(1)
    w_best = np.take_along_axis(w, best[:, None], 1)[:, 0]
    patch = np.take_along_axis(neighbours, best, 1)
    no_weight = w_best <= 0  # thinner than the sample distance: keep the centre's patch
    patch = np.where(no_weight, centre[:, None], patch)
    w_best = np.where(no_weight, inverse_depth[row, col][:, None], w_best)
    x, y, w_best = (a.astype(np.float32).ravel() for a in (x, y, w_best))
    patch = patch.ravel()
    U, V, level = lookup.sample(
        patch,
        x,
        y,
        w_best,
        np.zeros((1, 2), np.float32),
    )
    level += np.tile(_DITHER, len(edges))
    return lookup.fetch(U[0], V[0], level).reshape(-1, 4, 3).sum(1, dtype=np.uint16)


def _inverse_depth(
    lookup: _TextureLookup, view: CameraPatches, patch: ndarray, x: ndarray, y: ndarray
) -> ndarray:
    """Inverse depth of rays [N, 4] on given patches [N]; -1 where they miss."""
    row = np.minimum(patch, lookup.n_flat - 1)
    flat = view.flat
    w, a, b = (
        f[row, 0, None] * x + f[row, 1, None] * y + f[row, 2, None]
        for f in (view.W, view.A, view.B)
    )
    reach_w = flat.half_w[row, None] * w
    reach_h = flat.half_h[row, None] * w
    is_inside = (np.abs(a) <= reach_w * (1 + 1e-9)) & (np.abs(b) <= reach_h * (1 + 1e-9))
    is_inside &= ~flat.disc[row, None] | (a * a + b * b <= reach_w**2)
    w = np.where(is_inside, w, -1.0)
    for i, at in lookup.segments(patch):
        o, d = view.local_rays(
            view.curved[i],
            x[at],
            y[at],
        )
        w[at] = 1.0 / view.curved[i].shape.intersect(o, d)
    return np.where(w > 0, w, -1.0)
