import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import pixel_grid, rays, se3
from gsfusion_nb.tracking import Surface, depth_pyramid, tsdf_surface
from gsfusion_nb.tracking.surface import (
    hybrid_surface,
    reduce_depth,
    reduced_camera,
    smooth_normals,
)
from gsfusion_nb.tsdf import TsdfVolume, integrate
from gsfusion_nb.types import Camera


def test_a_volume_is_a_surface(plane_scene):
    frame = plane_scene("corner").frame(torch.eye(4))
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.04, truncation_voxels=4.0))
    integrate(volume, frame)
    seen = tsdf_surface(volume)(frame.camera, frame.T_WC)
    exact = plane_scene("corner")(frame.camera, frame.T_WC)
    both = (seen.depth_m > 0) & (exact.depth_m > 0)
    assert float(both.double().mean()) > 0.9
    assert float((seen.depth_m - exact.depth_m).abs()[both].median()) < 2e-3
    assert float((seen.normal_W * exact.normal_W).sum(-1)[both].median()) > 0.99


def test_a_hybrid_takes_the_frame_where_the_model_is_missing_or_off(plane_scene):
    T_WC = se3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.1, 0.0]))
    scene = plane_scene("wall")
    frame = scene.frame(T_WC)
    model = scene(frame.camera, T_WC)
    depth_m = model.depth_m.clone()
    depth_m[20:40] = 0.0
    depth_m[50:70] += 0.02
    depth_m[80:100] += 0.004
    measured = frame.depth_m.clone()
    measured[:, :30] = 0.0
    model = Surface(depth_m=depth_m, normal_W=model.normal_W, camera=model.camera, T_WC=T_WC)
    mixed = hybrid_surface(model, measured)
    assert torch.equal(
        mixed.depth_m[20:40, 30:],
        frame.depth_m[20:40, 30:],
    )
    assert not mixed.depth_m[20:40, :30].any()
    assert torch.equal(
        mixed.depth_m[52:68, 32:],
        frame.depth_m[52:68, 32:],
    )
    assert torch.equal(
        mixed.depth_m[82:98, 32:-2],
        depth_m[82:98, 32:-2],
    )
    assert torch.equal(mixed.depth_m[50:70, :30], depth_m[50:70, :30])
    torch.testing.assert_close(
        mixed.normal_W[60, 80],
        torch.tensor([0.0, 0.0, -1.0]),
        atol=1e-4,
        rtol=0,
    )


def test_smoothing_averages_noise_away_and_leaves_the_unknown_unknown(plane_scene, generator):
    T_WC = se3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.1, 0.0]))
    clean = plane_scene("wall")(plane_scene("wall").frame(T_WC).camera, T_WC)
    noise = 0.5 * torch.randn(clean.normal_W.shape, generator=generator)
    noisy = torch.nn.functional.normalize(clean.normal_W + noise, dim=-1)
    noisy[:10] = 0.0
    model = Surface(depth_m=clean.depth_m, normal_W=noisy, camera=clean.camera, T_WC=T_WC)
    smooth = smooth_normals(model)
    assert not smooth.normal_W[:10].any()
    inner = (slice(12, -2), slice(2, -2))
    before, after = (
        (n * clean.normal_W).sum(-1)[inner].clamp(-1, 1).acos().rad2deg()
        for n in (noisy, smooth.normal_W)
    )
    assert float(before.mean()) > 25
    assert float(after.mean()) < 0.45 * float(before.mean())
    torch.testing.assert_close(smooth.normal_W[inner].norm(dim=-1), torch.ones_like(after))
    assert torch.equal(smooth.depth_m, model.depth_m)
    # the mean of nine equal vectors, made a unit vector again: some 13 roundings of 2^-24 = 8e-7 of
    # each component
    torch.testing.assert_close(
        smooth_normals(clean).normal_W[60, 80],
        clean.normal_W[60, 80],
        rtol=8e-7,
        atol=1e-9,
    )


CAMERA = Camera(
    width=37,
    height=29,
    fx=30.0,
    fy=31.0,
    cx=18.0,
    cy=15.0,
)


def slanted_plane(camera, n=(0.1, 0.05, -0.99), d=2.0):
    direction = rays(camera, pixel_grid(camera, dtype=torch.float64))
    return (-d / (direction @ torch.tensor(n, dtype=torch.float64))).float()


@pytest.mark.parametrize("factor", [1, 2, 3, 4, 8])
def test_a_plane_stays_where_it_is(factor):
    small = reduced_camera(CAMERA, factor)
    found = reduce_depth(slanted_plane(CAMERA), factor)
    assert found.shape == (small.height, small.width) == (-(-29 // factor), -(-37 // factor))
    whole = (
        slice(0, 29 // factor),
        slice(0, 37 // factor),
    )  # blocks that lie in the image altogether
    near = slanted_plane(small)[whole]
    torch.testing.assert_close(found[whole], near, rtol=1e-6, atol=0)


def test_levels_in_the_given_order_with_unusable_pixels_dropped():
    depth = slanted_plane(CAMERA, (0.0, 0.0, -1.0))
    depth[3, 4] = float("nan")
    depth[5, 6] = float("inf")
    depth[7, 8] = -1.0
    before = depth.clone()
    levels = depth_pyramid(depth, CAMERA, (4, 2, 1))
    torch.testing.assert_close(depth, before, equal_nan=True)
    assert [level.factor for level in levels] == [4, 2, 1]
    for level in levels:
        known = level.depth_m > 0
        assert bool(torch.isfinite(level.depth_m).all())
        torch.testing.assert_close(
            level.normal_C[known],
            torch.tensor([0.0, 0.0, -1.0]).expand(int(known.sum()), 3),
        )
        assert not level.normal_C[~known].any()
    assert not levels[2].depth_m[[3, 5, 7], [4, 6, 8]].any()


def test_sizes_must_fit():
    camera = Camera(
        width=4,
        height=3,
        fx=1.0,
        fy=1.0,
        cx=2.0,
        cy=1.5,
    )
    with pytest.raises(ValueError, match=r"depth_m of the surface must be \[3, 4\], got \[4, 3\]"):
        Surface(
            depth_m=torch.zeros(4, 3),
            normal_W=torch.zeros(4, 3, 3),
            camera=camera,
            T_WC=torch.eye(4),
        )


def test_a_block_by_hand():
    depth = torch.tensor([[1.0, 1.04, 0.0, 2.0], [0.0, 3.0, 0.0, 0.0]])
    # left: the median of 1, 1.04, 3 is 1.04, and 3 lies on another surface; right: one of four is
    # too few
    expected = 2 / (1 / 1.0 + 1 / 1.04)
    assert reduce_depth(depth, 2).tolist() == [[pytest.approx(expected, rel=1e-6), 0.0]]


def test_a_depth_edge_makes_no_point_in_mid_air():
    depth = torch.full((8, 8), 1.0)
    depth[:, 5:] = 3.0
    assert set(reduce_depth(depth, 4).flatten().tolist()) == {1.0, 3.0}


def test_grazing_surfaces_are_dropped():
    camera = Camera(
        width=40,
        height=160,
        fx=200.0,
        fy=200.0,
        cx=20.0,
        cy=80.0,
    )
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
    camera = Camera(
        width=size[1],
        height=size[0],
        fx=5.0,
        fy=5.0,
        cx=1.0,
        cy=1.0,
    )
    for level in depth_pyramid(torch.ones(size), camera, (8, 3, 1)):
        assert not level.depth_m.any()  # no normals, so nothing usable


def test_an_image_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"depth_m must be \[29, 37\], got \[4, 4\]"):
        depth_pyramid(torch.ones(4, 4), CAMERA, (1,))
