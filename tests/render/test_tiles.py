import dataclasses

import pytest
import torch

from gsfusion_nb.render import project_gaussians, tile_intersections


def touching_pairs(projection, camera, tile_px):
    """(tile, Gaussian) with a pixel centre where alpha >= 1/255: every Gaussian at every pixel."""
    j, i = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    tile = (j // tile_px) * -(-camera.width // tile_px) + i // tile_px
    pairs = set()
    for n in projection.visible.nonzero().flatten().tolist():
        dx, dy = i.double() + 0.5 - projection.uv[n, 0], j.double() + 0.5 - projection.uv[n, 1]
        A, B, C = projection.conic[n]
        alpha = projection.opacity[n] * torch.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
        pairs |= {(t, n) for t in tile[alpha >= 1 / 255].unique().tolist()}
    return pairs


@pytest.mark.parametrize("tile_px", [1, 4, 8, 16, 64])
@pytest.mark.parametrize("scale", [0.002, 0.12, 2.0])
def test_lists_are_complete_sorted_and_tight(scene, generator, tile_px, scale):
    projection = project_gaussians(scene.random_map(generator, 40, scale=scale), scene.camera, scene.pose)
    lists = tile_intersections(projection, scene.camera, tile_px=tile_px)
    assert lists.tiles_x == -(-27 // tile_px)
    assert lists.tiles_y == -(-19 // tile_px)
    assert len(lists.offset) == lists.tiles_x * lists.tiles_y + 1
    assert lists.offset[-1] == len(lists.gaussian)
    found = [(tile, n) for tile in range(len(lists.offset) - 1) for n in lists.gaussians_of(tile).tolist()]
    assert len(found) == len(lists.gaussian)
    assert len(set(found)) == len(found)
    needed = touching_pairs(projection, scene.camera, tile_px)
    assert needed <= set(found)
    for tile, n in set(found) - needed:  # the ellipse misses these tiles, the box around it does not
        corner = torch.tensor([tile % lists.tiles_x, tile // lists.tiles_x]) * tile_px
        assert (projection.uv[n] - projection.extent_px[n] < corner + tile_px).all()
        assert (projection.uv[n] + projection.extent_px[n] > corner).all()
    z = projection.depth_m[lists.gaussian]
    for begin, end in zip(lists.offset[:-1].tolist(), lists.offset[1:].tolist(), strict=True):
        assert (z[begin:end].diff() >= 0).all()


def test_equal_depths_keep_row_order(scene, generator):
    params = scene.random_map(generator, 1)
    same = params[torch.zeros(5, dtype=torch.long)]
    lists = tile_intersections(project_gaussians(same, scene.camera, scene.pose), scene.camera)
    for begin, end in zip(lists.offset[:-1].tolist(), lists.offset[1:].tolist(), strict=True):
        assert lists.gaussian[begin:end].tolist() in ([], [0, 1, 2, 3, 4])


def test_nothing_to_list(scene, generator):
    projection = project_gaussians(scene.random_map(generator, 3), scene.camera, scene.pose)
    hidden = dataclasses.replace(projection, visible=torch.zeros(3, dtype=torch.bool))
    outside = dataclasses.replace(projection, uv=projection.uv + 1000)
    for nothing in (hidden, outside):
        lists = tile_intersections(nothing, scene.camera)
        assert len(lists.gaussian) == 0
        assert (lists.offset == 0).all()
