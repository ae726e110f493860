"""The tiles of a picture, coloured by how many Gaussians are listed for each."""

import numpy as np

from ...drawing.curves import figure_picture, image_figure, style
from ...drawing.pictures import AnyImage, Picture
from ...render import TileLists


def tile_picture(
    image: AnyImage, tiles: TileLists, *, scale: int = 2, strength: float = 0.62
) -> Picture:
    """Length of every tile's list as colour (viridis: yellow is the longest) over the picture, with
    a colour bar.

    Args:
        image: What was rendered. [H, W, 3]
        tiles: From ``tile_intersections``.
        scale: Screen pixels per pixel.
        strength: Opacity of the colours.
    """
    count = tiles.offset.diff().view(tiles.tiles_y, tiles.tiles_x).cpu().numpy()
    height, width = image.shape[:2]
    figure, axes = image_figure(image, (scale * width, scale * height))
    axes.pcolormesh(
        np.arange(tiles.tiles_x + 1) * tiles.tile_px,
        np.arange(tiles.tiles_y + 1) * tiles.tile_px,
        count,
        vmin=0,
        alpha=strength,
        edgecolor="#00000080",
        linewidth=0.5,
    )
    bar = axes.inset_axes((0.02, 0.03, 0.4, 0.03))
    figure.colorbar(axes.collections[0], cax=bar, orientation="horizontal")
    style(bar, title=f"Gaussians in one tile of {tiles.tile_px} x {tiles.tile_px} px", ink="white")
    return figure_picture(figure)
