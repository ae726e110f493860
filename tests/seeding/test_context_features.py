"""What a context offers beyond frame, volume and map: picture features, questions about points, the
past, raycasts."""

import dataclasses

import pytest
import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.seeding import (
    SeedContext,
    Seeds,
    absolute_laplacian,
    apply_rule,
    disc_view,
    draw_rows,
    draw_weighted_rows,
    first_in_voxel,
    gradient_length,
    luma,
    orb_corners,
    outliers,
    quat_from_normals,
    raycast_volume,
    structure_directions,
)
from gsfusion_nb.seeding.image_features import box_blur, disc_blur, without_detail
from gsfusion_nb.tsdf import FusedView, TsdfVolume, fuse_frame_, new_band_blocks, raycast
from gsfusion_nb.types import Camera, Frame

W = 40
H = 30


def frame(rgb: torch.Tensor | None = None, index: int = 0) -> Frame:
    return Frame(
        index=index,
        timestamp_s=0.0,
        rgb=torch.full((H, W, 3), 0.5) if rgb is None else rgb,
        depth_m=torch.full((H, W), 1.0),
        camera=Camera(width=W, height=H, fx=40.0, fy=40.0, cx=W / 2, cy=H / 2),
        T_WC=torch.eye(4),
    )


def square() -> SeedContext:
    """A white square on black: columns 10 to 29, rows 8 to 21."""
    rgb = torch.zeros(H, W, 3)
    rgb[8:22, 10:30] = 1.0
    return SeedContext(frame(rgb))


def with_map(xyz_W: torch.Tensor, **more) -> SeedContext:
    model = GaussianModel(sh_degree=0)
    model.append(
        Seeds.isotropic(xyz_W, torch.full_like(xyz_W, 0.25), torch.full((len(xyz_W),), 0.1)),
        3,
    )
    model.clock.advance(50)
    return SeedContext(frame(index=7), gaussians=model, **more)


def test_corners_of_a_square():
    found = orb_corners(square().frame, 50)
    true = torch.tensor([[10.0, 8.0], [30.0, 8.0], [10.0, 22.0], [30.0, 22.0]])
    assert (torch.cdist(true, found).min(dim=1).values < 2.5).all()
    assert (torch.cdist(found, true).min(dim=1).values < 8.0).all()
    assert ((found - 0.5) % 1 == 0).all()
    assert len(orb_corners(square().frame, 1)) <= 1
    assert len(orb_corners(frame(), 50)) == 0


def test_nearest_neighbours_and_the_usual_size():
    ctx = with_map(torch.tensor([[0.0, 0.0, 1.0]]))
    new = torch.tensor([[1.0, 0.0, 1.0], [3.0, 0.0, 1.0], [3.0, 0.0, 1.0]])
    among_new = ctx.nearest(new)
    assert among_new.distance_m.tolist() == [
        [2.0, 2.0, torch.inf],
        [0.0, 2.0, torch.inf],
        [0.0, 2.0, torch.inf],
    ]
    assert among_new.row[:, 2].tolist() == [-1, -1, -1]
    assert among_new.spacing_m.tolist() == pytest.approx([2.0, 2**0.5, 2**0.5])
    both = ctx.nearest(new, among="new and map")
    assert both.row[0].tolist()[0] == 3
    assert both.distance_m[0].tolist() == [1.0, 2.0, 2.0]
    existing = ctx.nearest(new, 1, "map")
    assert existing.distance_m[:, 0].tolist() == [1.0, 3.0, 3.0]
    assert existing.row[:, 0].tolist() == [0, 0, 0]
    alone = SeedContext(frame())
    assert alone.nearest(new[:1]).spacing_m.isnan().all()
    assert alone.nearest(new, 1, "map").distance_m.isinf().all()


def test_draws():
    ctx = SeedContext(frame())
    drawn = draw_rows(ctx, 10, 4)
    assert len(drawn.unique()) == 4
    assert (drawn.diff() > 0).all()
    assert draw_rows(ctx, 3, 5).tolist() == [0, 1, 2]
    weight = torch.tensor([0.0, 1.0, 0.0, 3.0, 0.0])
    assert draw_weighted_rows(ctx, weight, 4).tolist() == [1, 3]
    assert len(draw_weighted_rows(ctx, weight, 0)) == 0
    heavy = sum(draw_weighted_rows(ctx, weight, 1).item() == 3 for _ in range(400))
    assert heavy == pytest.approx(300, abs=40)  # 4.6 standard deviations


def test_orientations_from_normals():
    normal = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(1)),
        dim=1,
    )
    special = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]])
    quat = quat_from_normals(torch.cat([normal, special]))
    torch.testing.assert_close(quat.norm(dim=1), torch.ones(53))
    turned = quaternion.to_matrix(quat)[:, :, 2]
    torch.testing.assert_close(turned[:50], normal, atol=1e-5, rtol=0)
    assert turned[50:, 2].tolist() == pytest.approx([1.0, -1.0, 1.0])


def test_raycast_shows_the_volume_with_the_frame_in_it(small_walk):
    config = dataclasses.replace(gsfusion("room").tsdf, voxel_size_m=0.04)
    volume = TsdfVolume(config)
    for past in small_walk[:2]:
        volume.allocate_missing(volume.reserve(new_band_blocks(volume, past)))
        fuse_frame_(volume, past)
    now = small_walk[2]
    missing = volume.reserve(new_band_blocks(volume, now))
    before = volume.D.clone()
    preview = raycast_volume(SeedContext(now, FusedView(volume, now, missing)))
    assert torch.equal(volume.D, before)
    volume.allocate_missing(missing)
    fuse_frame_(volume, now)
    after = raycast_volume(SeedContext(now, volume))
    assert torch.equal(preview.depth_m, after.depth_m)
    assert torch.equal(after.normal_W, raycast(volume, now.camera, now.T_WC).normal_W)
    assert (after.depth_m > 0).float().mean() > 0.5


@pytest.mark.parametrize("window_px", [0, 2, -1])
def test_directions_need_a_window_with_a_middle(window_px):
    with pytest.raises(ValueError, match=f"window_px must be odd and at least 1, got {window_px}"):
        structure_directions(luma(square().frame.rgb), window_px)


@pytest.mark.parametrize(
    ("ask", "sentence"),
    [
        (
            lambda ctx: ctx.voxel_weight(torch.zeros(1, 3)),
            "voxel_weight needs a TSDF volume, .* pass volume=",
        ),
        (lambda ctx: disc_view(ctx), "disc_view.* needs a Gaussian map, .* pass gaussians="),
        (
            lambda ctx: ctx.quadtree_cells(depth=1),
            r"unknown settings \['depth'\]; known: \['contrast', 'largest_m', 'min_cell_px'",
        ),
        (
            lambda ctx: ctx.quadtree_cells(contrast="mean"),
            "contrast must be 'released' or 'std', got 'mean'",
        ),
        (lambda ctx: ctx.quadtree_cells(min_cell_px=0), "min_cell_px must be >= 1, got 0"),
        (lambda ctx: ctx.quadtree_cells(threshold=-0.1), "threshold must be >= 0, got -0.1"),
    ],
)
def test_a_context_says_what_it_lacks(ask, sentence):
    with pytest.raises(ValueError, match=sentence):
        ask(SeedContext(frame()))


def test_detail_of_the_picture():
    ctx = square()
    assert luma(ctx.frame.rgb)[10, 15].item() == pytest.approx(0.9999, abs=1e-4)
    assert gradient_length(luma(ctx.frame.rgb))[15, 9:12].tolist() == pytest.approx(
        [0.5, 0.5, 0.0], abs=1e-3
    )
    lap = absolute_laplacian(ctx.frame.rgb)
    assert lap[15, 8:13].tolist() == [0.0, 3.0, 3.0, 0.0, 0.0]
    assert lap[8, 10].item() == 6.0  # a corner of the square
    assert ctx.normals_W() is ctx.normals_W()
    thin = ctx.edges()
    wide = ctx.edges(dilate_px=2)
    assert thin.any()
    assert not thin[12:18, 13:27].any()
    assert (wide & ~thin).any()
    assert not (thin & ~wide).any()


def one_per_5_cm(ctx: SeedContext) -> Seeds:
    seeds = ctx.seeds_at(ctx.pixels(), 1.0)
    seeds = seeds[~ctx.occupied(seeds.xyz_W, 0.05)]
    return seeds[first_in_voxel(seeds.xyz_W, 0.05)]


def test_one_gaussian_a_voxel_across_frames():
    model = GaussianModel(sh_degree=0)
    for shift in (0.0, 0.01, 0.3):
        view = frame()
        view.T_WC[0, 3] = shift
        model.append(apply_rule(one_per_5_cm, SeedContext(view, gaussians=model)))
    voxels = (model.params.xyz_W / 0.05).floor()
    assert len(voxels.unique(dim=0)) == len(model) > 100


def test_outliers_are_far_from_all_others():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    points[7] += 10.0
    assert outliers(points).nonzero()[:, 0].tolist() == [7]
    assert outliers(points[:1]).tolist() == [False]


def test_first_in_a_voxel_and_voxels_that_are_held():
    points = torch.tensor(
        [[0.01, 0, 0], [0.09, 0, 0], [-0.01, 0, 0], [0.11, 0, 0], [0.19, 0.05, 0.09]]
    )
    ctx = with_map(torch.tensor([[0.05, 0.05, 0.05], [-0.05, 0.15, 0.0]]))
    assert first_in_voxel(points, 0.1).tolist() == [True, False, True, True, False]
    assert ctx.occupied(points, 0.1).tolist() == [True, True, False, False, False]
    assert not SeedContext(frame()).occupied(points, 0.1).any()


def test_the_laplacian_of_a_parabola_and_of_a_dot():
    u, v = torch.meshgrid(
        torch.arange(9.0),
        torch.arange(7.0),
        indexing="xy",
    )
    rgb = torch.stack(
        [0.01 * u * u, -0.02 * v * v, 0.1 * u + 0.2 * v],
        dim=-1,
    )
    inside = absolute_laplacian(rgb)[1:-1, 1:-1]
    torch.testing.assert_close(
        inside,
        torch.full((5, 7), 0.02 + 0.04),
        atol=1e-5,
        rtol=0,
    )
    dot = torch.zeros(5, 5, 3)
    dot[2, 2, 0] = 1.0
    expected = torch.zeros(5, 5)
    expected[2, 2] = 4.0
    expected[1, 2] = expected[3, 2] = expected[2, 1] = expected[2, 3] = 1.0
    assert torch.equal(absolute_laplacian(dot), expected)
    corner = torch.zeros(5, 5, 3)
    corner[0, 0] = 1.0  # two of its neighbours are outside and equal it
    assert absolute_laplacian(corner)[0, :2].tolist() == [6.0, 3.0]


def test_blurs_of_a_dot_are_their_windows():
    dot = torch.zeros(9, 9)
    dot[4, 4] = 1.0
    assert int((disc_blur(dot, 3.5) > 0).sum()) == 37  # the pixels within 3.5
    assert float(disc_blur(dot, 3.5).sum()) == pytest.approx(1.0)
    assert float(disc_blur(dot, 3.5)[4, 4]) == pytest.approx(1 / 37)
    box = box_blur(dot[..., None], 5)[..., 0]
    assert int((box > 0).sum()) == 25
    assert float(box[4, 4]) == pytest.approx(1 / 25)
    torch.testing.assert_close(
        box_blur(torch.full((4, 6, 2), 0.3), 3),
        torch.full((4, 6, 2), 0.3),
    )


def test_a_step_halved_and_enlarged():
    """Columns 0 to 3 black, 4 to 7 white: halved it is still a step, enlarged one of 0, 1/4, 3/4
    and 1."""
    rgb = (torch.arange(8) >= 4).float()[None, :, None].expand(6, 8, 3).contiguous()
    torch.testing.assert_close(
        without_detail(rgb)[0, :, 0],
        torch.tensor([0.0, 0, 0, 0.25, 0.75, 1, 1, 1]),
    )
