"""The tiles of a picture and the number of Gaussians that each blends."""

import numpy as np

from ...drawing.ground import CARD, CARD_INK
from ...drawing.pictures import AnyImage, Picture, to_uint8
from ...render import TileLists


def tile_picture(image: AnyImage, tiles: TileLists, *, scale: int = 2, strength: float = 0.62) -> Picture:
    """Length of every tile's list as colour (viridis: yellow is the longest) over the picture, with a colour bar.

    Args:
        image: What was rendered. [H, W, 3]
        tiles: From ``tile_intersections``.
        scale: Screen pixels per pixel.
        strength: Opacity of the colours.
    """
    import cv2

    count = tiles.offset.diff().view(tiles.tiles_y, tiles.tiles_x).cpu().numpy()
    most = max(int(count.max(initial=0)), 1)
    level = (count * 255 // most).astype(np.uint8)
    heat = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    picture = to_uint8(image)
    H, W = picture.shape[:2]
    heat = cv2.resize(heat, None, fx=tiles.tile_px, fy=tiles.tile_px, interpolation=cv2.INTER_NEAREST)[:H, :W]
    mixed = cv2.addWeighted(np.ascontiguousarray(heat), strength, picture, 1 - strength, 0)
    mixed = np.asarray(cv2.resize(mixed, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST), np.uint8)
    step = tiles.tile_px * scale
    mixed[::step] = mixed[::step] // 2
    mixed[:, ::step] = mixed[:, ::step] // 2
    bar = np.full((26, mixed.shape[1], 3), CARD, np.uint8)
    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_VIRIDIS)[..., ::-1]
    bar[7:19, 20:160] = np.asarray(cv2.resize(np.ascontiguousarray(ramp), (140, 12)), np.uint8)
    ink, font = CARD_INK, cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(bar, "0", (6, 18), font, 0.42, ink, 1, cv2.LINE_AA)
    cv2.putText(
        bar,
        f"{most} Gaussians in one tile of {tiles.tile_px} x {tiles.tile_px} px",
        (168, 18),
        font,
        0.42,
        ink,
        1,
        cv2.LINE_AA,
    )
    return np.concatenate([mixed, bar])
