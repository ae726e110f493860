"""The quadtree against cuts made by hand and the leaf table of the released code."""

from collections import Counter

import numpy as np
import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.seeding import Cells, quadtree
from gsfusion_nb.seeding.quadtree import cut_to_size, luma_variance
from gsfusion_nb.types import Camera

# (width, height), cell sizes when everything is cut, shallowest and deepest leaf
FULLY_CUT = [
    (1200, 680, {(4, 2): 7040, (4, 3): 13440, (5, 2): 15488, (5, 3): 29568}, 8, 8),
    (876, 584, {(3, 2): 27232, (3, 3): 10656, (4, 2): 19872, (4, 3): 7776}, 8, 8),
    (640, 480, {(5, 3): 4096, (2, 2): 24576, (3, 2): 24576}, 7, 8),
    (1752, 1168, {(3, 2): 108928, (3, 3): 42624, (4, 2): 79488, (4, 3): 31104}, 9, 9),
    (320, 240, {(5, 3): 1024, (2, 2): 6144, (3, 2): 6144}, 6, 7),
    (256, 256, {(2, 2): 16384}, 7, 7),
    (64, 48, {(4, 3): 256}, 4, 4),
]


def noise(width: int, height: int, generator: torch.Generator) -> torch.Tensor:
    return torch.randint(
        0,
        256,
        (height, width, 3),
        generator=generator,
        dtype=torch.uint8,
    )


def landscape(width: int, height: int) -> torch.Tensor:
    """Smooth regions, soft edges and one textured patch: cells of many sizes."""
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    grey = 120 + 90 * np.tanh(20 * (y - 0.3 - 0.1 * np.sin(9 * x)))
    texture = 30 * np.sin(300 * x) * np.sin(200 * y) * ((x - 0.6) ** 2 + (y - 0.5) ** 2 < 0.02)
    rgb = np.stack(
        [grey + texture, 0.8 * grey, 200 - 0.5 * grey + texture],
        axis=-1,
    )
    return torch.from_numpy(rgb.clip(0, 255).astype(np.uint8))


def rows(cells: Cells) -> list[tuple[int, ...]]:
    columns = (cells.x0, cells.y0, cells.width, cells.height, cells.level)
    return list(zip(*(c.tolist() for c in columns), strict=True))


def test_four_by_four_is_cut_once_in_the_released_order():
    image = torch.zeros(4, 4, 3, dtype=torch.uint8)
    image[:2, :2] = 255  # one bright quarter: V = 0.9999 * 255^2 * 3/16
    V = 0.9999 * 255**2 * 3 / 16
    cut = quadtree(image, threshold=0.99 * V * 16 / 9e7)
    assert rows(cut) == [(0, 0, 2, 2, 1), (0, 2, 2, 2, 1), (2, 0, 2, 2, 1), (2, 2, 2, 2, 1)]
    assert len(quadtree(image, threshold=1.01 * V * 16 / 9e7)) == 1
    assert len(quadtree(image, threshold=0.99 * V**0.5 / 255, contrast="std")) == 4
    assert len(quadtree(image, threshold=1.01 * V**0.5 / 255, contrast="std")) == 1


def test_channels_count_by_their_luma_weight():
    for channel, weight in enumerate((0.2989, 0.5870, 0.1140)):
        image = torch.zeros(4, 4, 3, dtype=torch.uint8)
        image[:, 2:, channel] = 200  # variance 100^2
        std = (weight * 100**2) ** 0.5 / 255
        assert len(quadtree(image, threshold=std * 0.9999, contrast="std")) == 4
        assert len(quadtree(image, threshold=std * 1.0001, contrast="std")) == 1


def test_odd_sizes_give_the_floor_to_the_left_and_the_top(generator):
    assert rows(quadtree(noise(5, 7, generator), threshold=0.0)) == [
        (0, 0, 2, 3, 1),
        (0, 3, 2, 4, 1),
        (2, 0, 3, 3, 1),
        (2, 3, 3, 4, 1),
    ]


@pytest.mark.parametrize(("width", "height", "sizes", "shallowest", "deepest"), FULLY_CUT)
def test_fully_cut_image_has_the_leaves_of_the_released_code(
    width, height, sizes, shallowest, deepest, generator
):
    cells = quadtree(noise(width, height, generator), threshold=1e-6)
    assert (
        Counter(
            zip(
                cells.width.tolist(),
                cells.height.tolist(),
                strict=True,
            )
        )
        == sizes
    )
    assert (int(cells.level.min()), int(cells.level.max())) == (shallowest, deepest)


def test_variance_is_that_of_the_pixels(generator):
    cell = noise(7, 5, generator)[1:, 2:]
    expected = cell.numpy().reshape(-1, 3).var(axis=0) @ [0.2989, 0.5870, 0.1140]
    assert luma_variance(cell) == pytest.approx(expected, rel=1e-12)


def test_leaves_tile_the_image():
    cells = quadtree(landscape(150, 111), threshold=0.005)
    covered = torch.zeros(111, 150, dtype=torch.int64)
    for x, y, w, h, _ in rows(cells):
        covered[y : y + h, x : x + w] += 1
    assert (covered == 1).all()
    assert int(cells.area.sum()) == 150 * 111


def test_flat_sides_are_never_cut(generator):
    assert len(quadtree(noise(1, 500, generator), threshold=0.0)) == 1
    assert len(quadtree(noise(500, 3, generator), threshold=0.0)) == 1


@pytest.mark.parametrize(
    ("sequence", "image", "released", "strict"),
    [
        ("redkitchen_mini48", "000000.jpg", 4825, 9487),
        ("redkitchen250", "000100.jpg", 14818, 37033),
    ],
)
def test_real_photograph(sequence, image, released, strict, shared_sequence):
    import cv2

    bgr = cv2.imread(str(shared_sequence(sequence) / "rgb" / image))
    assert bgr is not None
    rgb = torch.from_numpy(np.ascontiguousarray(bgr[..., ::-1]))
    # counts of this function, exact for one JPEG decoder; another may move a few cells across the
    # threshold
    assert len(quadtree(rgb)) == pytest.approx(released, rel=0.01)
    assert len(quadtree(rgb, threshold=0.01)) == pytest.approx(strict, rel=0.01)
    assert rows(quadtree(rgb)) == rows(quadtree.reference(rgb))


def test_the_reference_cuts_by_variance_or_by_its_root():
    """The values of the first test, without any fast backend."""
    image = torch.zeros(4, 4, 3, dtype=torch.uint8)
    image[:2, :2] = 255
    V = 0.9999 * 255**2 * 3 / 16
    with use_backend("reference"):
        for contrast, limit in (("released", V * 16 / 9e7), ("std", V**0.5 / 255)):
            assert len(quadtree(image, threshold=0.99 * limit, contrast=contrast)) == 4
            assert len(quadtree(image, threshold=1.01 * limit, contrast=contrast)) == 1
            assert (
                len(quadtree(image, threshold=0.99 * limit, contrast=contrast, min_cell_px=2)) == 1
            )


def test_cutting_to_size_tiles_the_picture_and_stops_at_the_smallest_cell():
    width, height = 101, 67
    camera = Camera(width=width, height=height, fx=90.0, fy=90.0, cx=50.0, cy=33.0)
    cells = quadtree(landscape(width, height), threshold=0.02)
    depth_m = torch.linspace(0.5, 4.0, width).expand(height, width).clone()
    depth_m[20:40, 30:60] = 0.0
    for largest_m, min_cell_px in ((0.2, 1), (0.05, 1), (0.001, 3)):
        parts = cut_to_size(cells, camera, depth_m, largest_m, min_cell_px=min_cell_px)
        covered = torch.zeros(height, width, dtype=torch.int64)
        for x0, y0, w, h, _ in rows(parts):
            covered[y0 : y0 + h, x0 : x0 + w] += 1
        assert (covered == 1).all()
        i, j = parts.centre_uv.floor().long().unbind(-1)
        size_m = depth_m[j, i] * parts.half_diagonal_px / camera.fx
        too_large = parts[size_m > largest_m]
        smaller_side = torch.minimum(too_large.width, too_large.height)
        assert (smaller_side // 2 <= min_cell_px).all()
        untouched = set(rows(parts)) & set(rows(cells))
        in_hole = {
            row for row in rows(cells) if depth_m[row[1] + row[3] // 2, row[0] + row[2] // 2] == 0
        }
        assert in_hole <= untouched
    assert len(cut_to_size(cells[:0], camera, depth_m, 0.1)) == 0
    assert rows(cut_to_size(cells, camera, depth_m, 1e6)) == rows(cells)
