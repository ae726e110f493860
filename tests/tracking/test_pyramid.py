import pytest
import torch

from gsfusion_nb.geometry import pixel_grid, rays
from gsfusion_nb.tracking import depth_pyramid
from gsfusion_nb.tracking.pyramid import reduce_depth, reduced_camera
from gsfusion_nb.types import Camera

CAMERA = Camera(width=37, height=29, fx=30.0, fy=31.0, cx=18.0, cy=15.0)


def slanted_plane(camera, n=(0.1, 0.05, -0.99), d=2.0):
    direction = rays(camera, pixel_grid(camera, dtype=torch.float64))
    return (-d / (direction @ torch.tensor(n, dtype=torch.float64))).float()


def test_a_block_by_hand():
    depth = torch.tensor([[1.0, 1.04, 0.0, 2.0], [0.0, 3.0, 0.0, 0.0]])
    # left: the median of 1, 1.04, 3 is 1.04, and 3 lies on another surface; right: one of four is too few
    expected = 2 / (1 / 1.0 + 1 / 1.04)
    assert reduce_depth(depth, 2).tolist() == [[pytest.approx(expected, rel=1e-6), 0.0]]


@pytest.mark.parametrize("factor", [1, 2, 3, 4, 8])
def test_a_plane_stays_where_it_is(factor):
    small = reduced_camera(CAMERA, factor)
    found = reduce_depth(slanted_plane(CAMERA), factor)
    assert found.shape == (small.height, small.width) == (-(-29 // factor), -(-37 // factor))
    whole = (slice(0, 29 // factor), slice(0, 37 // factor))  # blocks that lie in the image altogether
    near = slanted_plane(small)[whole]
    torch.testing.assert_close(found[whole], near, rtol=1e-6, atol=0)


def test_a_depth_edge_makes_no_point_in_mid_air():
    depth = torch.full((8, 8), 1.0)
    depth[:, 5:] = 3.0
    assert set(reduce_depth(depth, 4).flatten().tolist()) == {1.0, 3.0}


def test_levels_in_the_given_order_with_unusable_pixels_dropped():
    depth = slanted_plane(CAMERA, (0.0, 0.0, -1.0))
    depth[3, 4], depth[5, 6], depth[7, 8] = float("nan"), float("inf"), -1.0
    before = depth.clone()
    levels = depth_pyramid(depth, CAMERA, (4, 2, 1))
    torch.testing.assert_close(depth, before, equal_nan=True)
    assert [level.factor for level in levels] == [4, 2, 1]
    for level in levels:
        known = level.depth_m > 0
        assert bool(torch.isfinite(level.depth_m).all())
        torch.testing.assert_close(level.normal_C[known], torch.tensor([0.0, 0.0, -1.0]).expand(int(known.sum()), 3))
        assert not level.normal_C[~known].any()
    assert not levels[2].depth_m[[3, 5, 7], [4, 6, 8]].any()


def test_grazing_surfaces_are_dropped():
    camera = Camera(width=40, height=160, fx=200.0, fy=200.0, cx=20.0, cy=80.0)
    floor = slanted_plane(camera, (0.0, -1.0, 0.0), 0.5)
    floor = floor.where((floor > 0) & (floor < 5), 0.0)
    level = depth_pyramid(floor, camera, (1,))[0]
    kept = level.depth_m > 0
    ray = rays(camera, pixel_grid(camera))
    cosine = ray[..., 1] / ray.norm(dim=-1)
    assert bool(kept.any())
    assert float(cosine[kept].min()) == pytest.approx(0.2, abs=0.005)
    assert bool(((floor > 0) & (cosine > 0.15) & ~kept).any())


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 9)])
def test_tiny_images(size):
    camera = Camera(width=size[1], height=size[0], fx=5.0, fy=5.0, cx=1.0, cy=1.0)
    for level in depth_pyramid(torch.ones(size), camera, (8, 3, 1)):
        assert not level.depth_m.any()  # no normals, so nothing usable


def test_an_image_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"depth_m must be \[29, 37\], got \[4, 4\]"):
        depth_pyramid(torch.ones(4, 4), CAMERA, (1,))
