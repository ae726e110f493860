"""The keyframes of a run as a strip of small pictures."""

from collections.abc import Iterable

import numpy as np

from ...drawing.pictures import Picture, fit_width
from ...optim import Keyframe

_BAR_PX = 14


def keyframe_strip(keyframes: Iterable[Keyframe], *, columns: int = 10, width: int = 900, most: int = 40) -> Picture:
    """Thumbnails in rows, in the order they were taken, each with its frame number under it.

    Args:
        keyframes: ``mapper.keyframes``.
        columns: Pictures in a row.
        width: Of the whole strip, pixels.
        most: At most this many keyframes are shown, evenly spread over the run.

    Returns:
        White where there is nothing; one white row of pixels if there are no keyframes.
    """
    shown = list(keyframes)
    if len(shown) > most:
        shown = [shown[round(i * (len(shown) - 1) / (most - 1))] for i in range(most)]
    tiles = [_tile(keyframe, width // columns) for keyframe in shown]
    rows = [tiles[i : i + columns] for i in range(0, len(tiles), columns)]
    if not rows:
        return np.full((1, width, 3), 255, np.uint8)
    return np.concatenate([_row(row, width) for row in rows])


def _tile(keyframe: Keyframe, width: int) -> Picture:
    import cv2

    small = fit_width(keyframe.rgb_u8.cpu().numpy(), width - 4)
    tile = np.full((small.shape[0] + _BAR_PX + 4, width, 3), 255, np.uint8)
    tile[: small.shape[0], : small.shape[1]] = small
    place = (2, small.shape[0] + _BAR_PX - 3)
    cv2.putText(tile, f"{keyframe.index}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.38, (60, 70, 84), 1, cv2.LINE_AA)
    return tile


def _row(tiles: list[Picture], width: int) -> Picture:
    row = np.full((max(t.shape[0] for t in tiles), width, 3), 255, np.uint8)
    x = 0
    for tile in tiles:
        row[: tile.shape[0], x : x + tile.shape[1]] = tile
        x += tile.shape[1]
    return row
