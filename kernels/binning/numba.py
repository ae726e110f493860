"""Lists of the splats that touch each tile, nearest first, by counting: no comparison sort."""

import numpy as np
from numba import njit, prange

from ..composite.layout import TILE, PairLists
from ..project.layout import DEPTH
from ..project.numba import CHUNK, NOTED_PER_CHUNK, tiles_of
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from .layout import FIRST_X, FIRST_Y, LAST_X, LAST_Y, TileWindows


@njit(cache=True, error_model="numpy")
def tile_windows(pixels, width, height):
    """Where there are pixels to be drawn. pixels: bool [H, W], or [0, 0] for all."""
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    has_mask = pixels.shape[0] > 0
    windows = np.empty((tiles_x * tiles_y if has_mask else 0, 4), np.int32)
    windows[:, FIRST_X] = width
    windows[:, LAST_X] = -1
    windows[:, FIRST_Y] = height
    windows[:, LAST_Y] = -1
    for y in range(pixels.shape[0]):
        for x in range(width):
            if pixels[y, x]:
                window = windows[(y // TILE) * tiles_x + x // TILE]
                window[FIRST_X] = min(window[FIRST_X], x)
                window[LAST_X] = max(window[LAST_X], x)
                window[FIRST_Y] = min(window[FIRST_Y], y)
                window[LAST_Y] = y
    sums = np.zeros((tiles_y + 1, tiles_x + 1), np.int32)
    for ty in range(tiles_y):
        for tx in range(tiles_x):
            n_here = 1 if not has_mask or windows[ty * tiles_x + tx, LAST_X] >= 0 else 0
            sums[ty + 1, tx + 1] = n_here + sums[ty, tx + 1] + sums[ty + 1, tx] - sums[ty, tx]
    return TileWindows(windows, sums)


@njit(cache=True, error_model="numpy")
def depth_order(splats, count):
    """Rows with a tile, by depth, equal depths in row order: two radix passes over the bits of the
    positive float."""
    n = 0
    for i in range(count.shape[0]):
        n += count[i] > 0
    rows = np.empty(n, np.int32)
    keys = np.empty(n, np.uint32)
    depth_bits = splats[:, DEPTH].copy().view(np.uint32)
    j = 0
    for i in range(count.shape[0]):
        if count[i] > 0:
            rows[j] = i
            keys[j] = depth_bits[i]
            j += 1
    other_rows = np.empty_like(rows)
    other_keys = np.empty_like(keys)
    for shift in (np.uint32(0), np.uint32(11), np.uint32(22)):
        histogram = np.zeros(2049, np.int64)
        for j in range(n):
            histogram[((keys[j] >> shift) & np.uint32(2047)) + 1] += 1
        for b in range(2048):
            histogram[b + 1] += histogram[b]
        for j in range(n):
            b = (keys[j] >> shift) & np.uint32(2047)
            place = histogram[b]
            histogram[b] += 1
            other_rows[place] = rows[j]
            other_keys[place] = keys[j]
        rows, other_rows = other_rows, rows
        keys, other_keys = other_keys, keys
    return rows


@njit(parallel=True, cache=True, error_model="numpy")
def list_tiles(splats, start, tile_notes, width, height, windows, pair_tile):
    """Numbers of the tiles each splat is listed in, row i in
    ``pair_tile[start[i]:start[i + 1]]``."""
    N = splats.shape[0]
    n_parts = (N + CHUNK - 1) // CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        first = part * CHUNK
        end = min(N, part * CHUNK + CHUNK)
        n = start[end] - start[first]
        if n <= NOTED_PER_CHUNK:
            pair_tile[start[first] : start[end]] = tile_notes[
                part * NOTED_PER_CHUNK : part * NOTED_PER_CHUNK + n
            ]
            continue
        for i in range(first, end):
            if start[i + 1] > start[i]:
                tiles_of(
                    splats[i], width, height, windows, pair_tile, start[i], start[i + 1] - start[i]
                )


@njit(cache=True, error_model="numpy")
def sort_pairs(order, start, pair_tile, n_tiles):
    """Counting sort of the pairs by tile, depth order kept; a pair's slot is its place in
    ``pair_tile``."""
    offset = np.zeros(n_tiles + 1, np.int32)
    for k in range(pair_tile.shape[0]):
        offset[pair_tile[k] + 1] += 1
    for t in range(n_tiles):
        offset[t + 1] += offset[t]
    cursor = offset[:-1].copy()
    ids = np.empty(pair_tile.shape[0], np.int32)
    slot = np.empty(pair_tile.shape[0], np.int32)
    for row in order:
        for k in range(start[row], start[row + 1]):
            place = cursor[pair_tile[k]]
            cursor[pair_tile[k]] += 1
            ids[place] = row
            slot[place] = k
    return PairLists(ids, offset, slot)
