"""Gaussians for cells without depth: where, at which depth, and none where depth or a map is there."""

import dataclasses

import torch

from gsfusion_nb.config import SeedingConfig
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry import project, se3
from gsfusion_nb.seeding import SeedContext, apply_rule
from gsfusion_nb.seeding.sampling import cells_without_depth, depth_from_sides

FINE = SeedingConfig(quadtree_threshold=0.02, quadtree_contrast="std")


def test_depth_is_the_mean_of_the_four_sides_by_the_square_of_their_nearness():
    depth_m = torch.zeros(5, 7)
    depth_m[2, 0], depth_m[2, 4], depth_m[0, 2], depth_m[1, 6] = 2.0, 4.0, 3.0, 9.0
    filled = depth_from_sides(depth_m, depth_m > 0)
    assert filled[2, 2].item() == 3.0  # three sides at a distance of 2
    torch.testing.assert_close(filled[2, 1], torch.tensor((2.0 + 4.0 / 9) / (1 + 1 / 9)))
    assert filled[2, 4].item() == 4.0  # itself
    assert filled[4, 5].item() == 0.0  # nothing known in its row or column


def holed(frame):
    depth_m = frame.depth_m.clone()
    depth_m[10:40, 20:60] = 0.0
    return dataclasses.replace(frame, depth_m=depth_m)


def test_cells_in_the_hole_get_a_gaussian_at_the_depth_around_it(small_walk):
    frame = holed(small_walk[0])
    ctx = SeedContext(frame, config=FINE)
    seeds = cells_without_depth(ctx)
    assert len(seeds) > 10
    xyz_C = se3.apply(se3.inverse(frame.T_WC), seeds.xyz_W)
    uv = project(frame.camera, xyz_C).mul(2).round() / 2  # middles of cells lie at whole and half pixels
    i, j = uv.floor().long().unbind(-1)
    assert (frame.depth_m[j, i] == 0).all()
    assert ((xyz_C[:, 2] / small_walk[0].depth_m[j, i]).log().abs() < 0.5).all()
    torch.testing.assert_close(seeds.rgb, frame.rgb[j, i])
    assert (seeds.scale_m[:, 0] * frame.camera.fx / xyz_C[:, 2] > 1.9).all()  # no cell narrower than 3 pixels


def test_none_where_the_map_shows_something_or_nothing_is_missing(small_walk):
    frame = holed(small_walk[0])
    whole = SeedContext(small_walk[0], config=FINE)
    assert len(cells_without_depth(whole)) == 0
    assert len(cells_without_depth(SeedContext(dataclasses.replace(frame, depth_m=torch.zeros(60, 80))))) == 0
    opaque = dataclasses.replace(whole.cells(), opacity=torch.full((len(whole.cells()),), 0.95))
    half = opaque[whole.quadtree_cells().centre_uv[:, 0] < 40]
    gaussians = GaussianModel(0)
    gaussians.append(half, 0)
    ctx = SeedContext(frame, gaussians=gaussians, config=FINE)
    xyz_C = se3.apply(se3.inverse(frame.T_WC), cells_without_depth(ctx).xyz_W)
    u = project(frame.camera, xyz_C)[:, 0]
    assert (u > 40).float().mean() > 0.9


def test_the_setting_adds_them_to_the_rule_and_skip_is_as_published(small_walk):
    frame = holed(small_walk[0])
    skip = SeedContext(frame, config=dataclasses.replace(FINE, without_depth="skip"))
    with_depth = apply_rule("gsfusion", skip, {"coverage": False})
    both = apply_rule("gsfusion", SeedContext(frame, config=FINE), {"coverage": False})
    assert torch.equal(with_depth.xyz_W, skip.cells().xyz_W)
    n = len(with_depth)
    assert torch.equal(both.xyz_W[:n], with_depth.xyz_W)
    assert len(both) - n == len(cells_without_depth(SeedContext(frame, config=FINE))) > 0
