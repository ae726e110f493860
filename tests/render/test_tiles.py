import dataclasses

import pytest
import torch

from gsfusion_nb.render import Projection, project_gaussians, tile_intersections
from gsfusion_nb.types import Camera


def touching_pairs(projection, camera, tile_px):
    """(tile, Gaussian) with a pixel centre where alpha >= 1/255: every Gaussian at every pixel."""
    j, i = torch.meshgrid(
        torch.arange(camera.height),
        torch.arange(camera.width),
        indexing="ij",
    )
    tile = (j // tile_px) * -(-camera.width // tile_px) + i // tile_px
    pairs = set()
    for n in projection.visible.nonzero().flatten().tolist():
        dx = i.double() + 0.5 - projection.uv[n, 0]
        dy = j.double() + 0.5 - projection.uv[n, 1]
        A, B, C = projection.conic[n]
        alpha = projection.opacity[n] * torch.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
        pairs |= {(t, n) for t in tile[alpha >= 1 / 255].unique().tolist()}
    return pairs


@pytest.mark.parametrize("tile_px", [1, 4, 8, 16, 64])
@pytest.mark.parametrize("scale", [0.002, 0.12, 2.0])
def test_lists_are_complete_sorted_and_tight(scene, generator, tile_px, scale):
    projection = project_gaussians(
        scene.random_map(generator, 40, scale=scale), scene.camera, scene.pose
    )
    lists = tile_intersections(projection, scene.camera, tile_px=tile_px)
    assert lists.tiles_x == -(-27 // tile_px)
    assert lists.tiles_y == -(-19 // tile_px)
    assert len(lists.offset) == lists.tiles_x * lists.tiles_y + 1
    assert lists.offset[-1] == len(lists.gaussian)
    found = [
        (tile, n)
        for tile in range(len(lists.offset) - 1)
        for n in lists.gaussians_of(tile).tolist()
    ]
    assert len(found) == len(lists.gaussian)
    assert len(set(found)) == len(found)
    needed = touching_pairs(projection, scene.camera, tile_px)
    assert needed <= set(found)
    # the ellipse misses these tiles, the box around it does not
    for tile, n in set(found) - needed:
        corner = torch.tensor([tile % lists.tiles_x, tile // lists.tiles_x]) * tile_px
        assert (projection.uv[n] - projection.extent_px[n] < corner + tile_px).all()
        assert (projection.uv[n] + projection.extent_px[n] > corner).all()
    z = projection.depth_m[lists.gaussian]
    for begin, end in zip(
        lists.offset[:-1].tolist(),
        lists.offset[1:].tolist(),
        strict=True,
    ):
        assert (z[begin:end].diff() >= 0).all()


def test_equal_depths_keep_row_order(scene, generator):
    params = scene.random_map(generator, 1)
    same = params[torch.zeros(5, dtype=torch.long)]
    lists = tile_intersections(project_gaussians(same, scene.camera, scene.pose), scene.camera)
    for begin, end in zip(
        lists.offset[:-1].tolist(),
        lists.offset[1:].tolist(),
        strict=True,
    ):
        assert lists.gaussian[begin:end].tolist() in ([], [0, 1, 2, 3, 4])


def test_nothing_to_list(scene, generator):
    projection = project_gaussians(scene.random_map(generator, 3), scene.camera, scene.pose)
    hidden = dataclasses.replace(projection, visible=torch.zeros(3, dtype=torch.bool))
    outside = dataclasses.replace(projection, uv=projection.uv + 1000)
    for nothing in (hidden, outside):
        lists = tile_intersections(nothing, scene.camera)
        assert len(lists.gaussian) == 0
        assert (lists.offset == 0).all()


def two_boxes() -> Projection:
    """In an image of 20 x 12: one Gaussian in the middle of the first tile of 8 pixels, the other
    over the corner of four tiles, and nearer."""
    return Projection(
        uv=torch.tensor([[4.0, 4.0], [8.0, 8.0]]),
        depth_m=torch.tensor([2.0, 1.0]),
        conic=torch.tensor([[1.0, 0.0, 1.0]] * 2),
        extent_px=torch.tensor([[2.0, 2.0]] * 2),
        opacity=torch.tensor([0.5, 0.5]),
        visible=torch.tensor([True, True]),
    )


CAMERA = Camera(
    width=20,
    height=12,
    fx=20.0,
    fy=20.0,
    cx=10.0,
    cy=6.0,
)


def test_lists_and_pixels_of_tiles_by_hand():
    lists = tile_intersections(two_boxes(), CAMERA, tile_px=8)
    assert (lists.tiles_x, lists.tiles_y) == (3, 2)
    assert [lists.gaussians_of(tile).tolist() for tile in range(6)] == [
        [1, 0],
        [1],
        [],
        [1],
        [1],
        [],
    ]
    rows, columns = lists.pixels_of(5, CAMERA)  # the last tile is cut by the image: 4 x 4 pixels
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [
        (row, column) for row in range(8, 12) for column in range(16, 20)
    ]
    drawn = torch.zeros(12, 20, dtype=torch.bool)
    drawn[9, 17] = drawn[3, 3] = True
    some = tile_intersections(two_boxes(), CAMERA, tile_px=8, pixels=drawn)
    assert [x.tolist() for x in some.pixels_of(5, CAMERA)] == [[9], [17]]
    assert [some.gaussians_of(tile).tolist() for tile in range(6)] == [[1, 0], [], [], [], [], []]


@pytest.mark.parametrize(
    ("change", "n", "sentence"),
    [
        ({"tiles_x": 2}, 2, "tiles must be 3 x 2 for this camera, got 2 x 2"),
        ({"tiles_y": 3}, 2, "tiles must be 3 x 2 for this camera, got 3 x 3"),
        ({}, 1, "tiles must name rows of the 1 Gaussians, got 1; are they of another map"),
    ],
)
def test_lists_of_another_picture_are_refused(change, n, sentence):
    lists = dataclasses.replace(tile_intersections(two_boxes(), CAMERA, tile_px=8), **change)
    with pytest.raises(ValueError, match=sentence):
        lists.check(n, CAMERA)


@pytest.mark.parametrize("tile_px", [0, -8])
def test_tiles_without_pixels_are_refused(tile_px):
    with pytest.raises(
        ValueError, match=f"tile_px must be a whole number of at least 1, got {tile_px}"
    ):
        tile_intersections(two_boxes(), CAMERA, tile_px=tile_px)
