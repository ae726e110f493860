"""The quadtree panel without a browser: sliders change picture and count, each view shows what it says."""

import numpy as np
import pytest
import torch

from gsfusion_nb.seeding import quadtree
from gsfusion_nb.viz.panels.seeding import QUADTREE_SHOWS as SHOWS
from gsfusion_nb.viz.panels.seeding import cell_means, quadtree_picture


@pytest.fixture
def photo():
    """Left half one colour, right half noise."""
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    rgb[:, :32] = (40, 90, 160)
    return rgb


def test_cells_are_filled_with_their_mean(photo):
    cells = quadtree(torch.from_numpy(photo), threshold=0.02)
    means = cell_means(torch.from_numpy(photo), cells).numpy()
    for x, y, w, h in zip(*(c.tolist() for c in (cells.x0, cells.y0, cells.width, cells.height)), strict=True):
        expected = photo[y : y + h, x : x + w].reshape(-1, 3).mean(0).round()
        assert (means[y : y + h, x : x + w] == expected).all()


def test_every_view_draws_the_same_cells(photo):
    pictures = {}
    for show in SHOWS:
        pictures[show], cells = quadtree_picture(photo, threshold=0.02, show=show, scale=2)
        assert len(cells) == len(quadtree(torch.from_numpy(photo), threshold=0.02))
        assert pictures[show].shape == (96, 128, 3)
    assert len({p.tobytes() for p in pictures.values()}) == 3
    assert (pictures["mean colours"][10:80, 4:40] == (40, 90, 160)).all()
    assert (pictures["Gaussians"][10:80, 10:40] == (40, 90, 160)).mean() > 0.99
    with pytest.raises(ValueError, match="show must be one of cells"):
        quadtree_picture(photo, show="dots")  # pyright: ignore[reportArgumentType]


def test_a_lone_cell_becomes_a_disc_about_its_middle():
    picture, cells = quadtree_picture(np.full((16, 24, 3), 200, np.uint8), show="Gaussians")
    assert len(cells) == 1
    assert picture[8, 12].tolist() == [200, 200, 200]
    lit = np.argwhere(picture[..., 0] > 0)
    assert np.allclose(lit.mean(0) + 0.5, [8, 12], atol=0.1)
