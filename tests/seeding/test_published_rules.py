"""The published rules choose what their publications say, counted on a wall with a map whose
rendering is given."""

import dataclasses
import importlib
import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsfusion_nb.config import SeedingConfig, TsdfConfig
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.seeding import SeedContext, Seeds, apply_rule
from gsfusion_nb.seeding.coverage import depth_error_m, in_front, unmapped_pixels
from gsfusion_nb.seeding.discs import as_discs
from gsfusion_nb.seeding.draws import one_pixel_seeds
from gsfusion_nb.seeding.image_features import orb_corners, without_detail
from gsfusion_nb.seeding.rules.gaussian_slam import PRESETS as gaussian_slam_presets
from gsfusion_nb.seeding.rules.monogs import PRESETS as monogs_presets
from gsfusion_nb.seeding.rules.splatam import alpha_behind
from gsfusion_nb.seeding.shapes import pushed_back, sized_by_neighbours
from gsfusion_nb.tsdf import RaycastOutput
from gsfusion_nb.types import Camera, Frame, RenderOutput

W = 64
H = 48
F = 60.0
N = W * H


@dataclass(frozen=True, eq=False, kw_only=True)
class Staged(SeedContext):
    """A context in which ``render`` shows what the test says."""

    view: Any = None

    def render(self) -> RenderOutput:
        """The given picture."""
        return self.view


def wall(
    rgb: torch.Tensor | None = None,
    depth_m: torch.Tensor | None = None,
    fy: float = F,
) -> Frame:
    """A grey wall 2 m away, seen straight on by 64 x 48 pixels."""
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.full((H, W, 3), 0.5) if rgb is None else rgb,
        depth_m=torch.full((H, W), 2.0) if depth_m is None else depth_m,
        camera=Camera(width=W, height=H, fx=F, fy=fy, cx=W / 2, cy=H / 2),
        T_WC=torch.eye(4),
    )


def model_of(xyz_W: torch.Tensor, scale_m: float = 0.02) -> GaussianModel:
    """A map with round Gaussians at these places."""
    model = GaussianModel(sh_degree=0)
    model.append(
        Seeds.isotropic(
            xyz_W,
            torch.full_like(xyz_W, 0.5),
            torch.full((len(xyz_W),), scale_m),
        )
    )
    return model


def first(frame: Frame | None = None, **more: Any) -> SeedContext:
    """A context without any Gaussian."""
    return SeedContext(frame or wall(), gaussians=GaussianModel(sh_degree=0), **more)


def staged(
    frame: Frame | None = None,
    alpha: torch.Tensor | float = 1.0,
    depth_m: torch.Tensor | float = 2.0,
    rgb: torch.Tensor | float = 0.5,
    xyz_W: torch.Tensor | None = None,
    **more: Any,
) -> SeedContext:
    """A context whose map shows these images; its Gaussians are elsewhere unless their places are
    given."""

    def image(value: torch.Tensor | float, *channels: int) -> torch.Tensor:
        return torch.as_tensor(value, dtype=torch.float32).expand(H, W, *channels)

    view = RenderOutput(
        rgb=image(rgb, 3),
        depth_m=image(depth_m),
        alpha=image(alpha),
        first_index=None,
        dominant_index=None,
    )
    places = torch.tensor([[0.0, 0.0, -5.0]]) if xyz_W is None else xyz_W
    return Staged(frame or wall(), gaussians=model_of(places), view=view, **more)


def some(count: int, where: str = "left") -> torch.Tensor:
    """A mask of the first ``count`` pixels of the left or right half, column by column."""
    column, row = torch.meshgrid(
        torch.arange(W),
        torch.arange(H),
        indexing="xy",
    )
    order = (column if where == "left" else W - 1 - column) * H + row
    return order < count


def with_values(fill: float, *parts: tuple[torch.Tensor, float]) -> torch.Tensor:
    """An image of one value with others where the masks say."""
    image = torch.full((H, W), fill)
    for mask, value in parts:
        image[mask] = value
    return image


def pixels_of(ctx: SeedContext, seeds: Seeds) -> torch.Tensor:
    """The pixels that contain the seeds, as a mask."""
    mask = torch.zeros(H, W, dtype=torch.bool)
    z = seeds.xyz_W[:, 2]
    u = seeds.xyz_W[:, 0] / z * F + W / 2
    v = seeds.xyz_W[:, 1] / z * ctx.camera.fy + H / 2
    mask[v.floor().long(), u.floor().long()] = True
    return mask


def half_wrong() -> SeedContext:
    """A quarter is not covered (768 pixels), 40 pixels are covered by 0.55 only, 20 are 1 m wrong,
    of these 12 too far away; the rest is wrong by 1 cm, so that is the median."""
    bare = some(768, "right")
    thin = some(40)
    far = some(52) & ~some(40)
    near = some(60) & ~some(52)
    alpha = with_values(1.0, (bare, 0.0), (thin, 0.55))
    return staged(
        alpha=alpha,
        depth_m=with_values(2.01, (bare, 0.0), (far, 3.0), (near, 1.0)),
    )


@pytest.mark.parametrize(
    ("rule", "options", "count"),
    [
        ("splatam", {}, 768 + 12),
        ("splatam", {"min_alpha": 0.6}, 768 + 40 + 12),
        ("splatam", {"median_factor": 101.0}, 768),  # 1 m is 100 medians
        ("splatam", {"share": 0.1}, 78),
        ("mm3dgs", {}, 768 + 20),
        ("mm3dgs", {"method": "splatam"}, 768 + 12),
        ("gaus_slam", {}, 768 + 40 + 12),
        ("gaus_slam", {"share": 0.5}, (768 + 40 + 12) // 2),
        ("gaussian_slam", {"share": 0.5}, (768 + 40 + 12) // 2),
        ("vtgaussian", {}, 768 + 12),
        ("cg_slam", {}, 768),
        ("cg_slam", {"share": 0.25}, 192),
        ("gs_slam", {}, 768 + 20),
        ("gs_slam", {"depth_error": 1.5, "share": 0.5}, 384),
        ("hf_slam", {"as_released": False}, 768 + 20),
        ("hf_slam", {"as_released": False, "relative_depth_error": 0.6}, 768),
        ("game", {"share": 1.0}, 768 + 40 + 12),  # over white, 0.55 of the grey is too bright
    ],
)
def test_pixels_that_the_map_does_not_show_rightly(rule, options, count):
    assert len(apply_rule(rule, half_wrong(), options)) == count


def test_hf_slam_looks_at_colours_and_at_depth_relative_to_the_distance():
    red = some(30)
    rgb = torch.full((H, W, 3), 0.05)
    rgb[red] = 0.66  # 0.61 more; 0.6 is the limit
    far = some(70) & ~red
    depth = with_values(
        2.0,
        (some(110) & ~some(70), 2.19),
        (far, 2.21),
    )  # 10 % are the limit
    ctx = staged(
        wall(rgb=torch.full((H, W, 3), 0.05)),
        depth_m=depth,
        rgb=rgb,
    )
    assert torch.equal(
        pixels_of(ctx, apply_rule("hf_slam", ctx, {"as_released": False})), red | far
    )


@pytest.mark.parametrize(
    ("preset", "one_in", "point_size"),
    [("replica", 64, 0.05), ("tum", 128, 0.02)],
)
def test_monogs_draws_a_share_whatever_is_mapped(preset, one_in, point_size):
    assert len(apply_rule("monogs", first(), {"preset": preset})) == N // 32
    ctx = staged()
    seeds = apply_rule("monogs", ctx, {"preset": preset})
    assert len(seeds) == N // one_in
    assert (
        len(apply_rule("monogs", staged(), {"preset": preset, "density": 2.0})) == 2 * N // one_in
    )
    near = (
        torch.cdist(seeds.xyz_W.double(), seeds.xyz_W.double()).topk(4, largest=False).values[:, 1:]
    )
    wanted = (near.square().mean(dim=1) * point_size).sqrt()
    torch.testing.assert_close(
        seeds.scale_m[:, 0].double(),
        wanted,
        atol=1e-6,
        rtol=1e-4,
    )


def test_gaussian_slam_starts_a_submap_with_random_pixels_gradients_and_edges():
    start = importlib.import_module("gsfusion_nb.seeding.rules.gaussian_slam")._start_of_submap
    assert int(start(first(), 100).sum()) == 100
    rgb = torch.zeros(H, W, 3)
    rgb[:, W // 2 :] = 1.0
    column = torch.arange(W).expand(H, W)
    chosen = start(first(wall(rgb=rgb)), 0)
    step = (column == W // 2 - 1) | (column == W // 2)  # where central differences see it
    assert (chosen & step).sum() == 2 * H
    assert not (chosen & ((column < W // 2 - 2) | (column > W // 2 + 1))).any()


@pytest.mark.parametrize(
    ("preset", "least_m"),
    [("replica", 1e-7**0.5), ("tum", 0.01), ("scannetpp", 1e-4)],
)
def test_gaussian_slam_rejects_points_close_to_the_map(preset, least_m):
    """In the middle row the map has Gaussians a little nearer than the least distance to 8 of the
    points, and a little farther than it to 8 others."""
    everywhere = apply_rule("gaussian_slam", first(), {"preset": preset})
    middle = W * (H // 2) + W // 2
    near = slice(middle - 20, middle - 12)
    far = slice(middle + 8, middle + 16)
    aside = torch.tensor([0.0, least_m, 0.0])
    places = torch.cat(
        [everywhere.xyz_W[near] + 0.99 * aside, everywhere.xyz_W[far] + 1.01 * aside]
    )
    ctx = staged(alpha=0.0, depth_m=0.0, xyz_W=places)
    seeds = apply_rule("gaussian_slam", ctx, {"preset": preset, "restart": False})
    rejected = torch.cdist(everywhere.xyz_W.double(), seeds.xyz_W.double()).amin(dim=1) > 1e-6
    assert rejected[near].all()
    assert not rejected[far].any()


def test_sizes_by_neighbours_are_capped_at_a_multiple_of_their_mean():
    """Four points in a row, 1 cm apart, and one 1 m away: with the root mean square distances to
    the 3 nearest."""
    x = torch.tensor([0.0, 0.01, 0.02, 0.03, 1.03])
    points = torch.stack([x, torch.zeros(5), torch.ones(5)], dim=1)
    seeds = Seeds.isotropic(
        points,
        torch.full((5, 3), 0.5),
        torch.ones(5),
    )
    end = (14e-4 / 3) ** 0.5  # 1, 2, 3 cm and 1, 1, 2 cm
    inner = (6e-4 / 3) ** 0.5
    alone = ((1.01**2 + 1.02**2 + 1) / 3) ** 0.5
    size = torch.tensor([end, inner, inner, end, alone])
    torch.testing.assert_close(
        sized_by_neighbours(first(), seeds).scale_m,
        size[:, None].expand(-1, 3),
    )
    capped = sized_by_neighbours(first(), seeds, factor=2.0, max_of_mean=1.5)
    torch.testing.assert_close(
        capped.scale_m[:, 1],
        2 * size.clamp(max=1.5 * float(size.mean())),
    )
    assert float(capped.scale_m[4, 0]) < 0.4 * 2 * alone


def test_photo_slam_takes_every_corner_with_depth():
    rgb = torch.rand(
        H // 4,
        W // 4,
        3,
        generator=torch.Generator().manual_seed(0),
    )
    frame = wall(rgb=rgb.repeat_interleave(4, 0).repeat_interleave(4, 1))
    corners = orb_corners(frame, 1000)
    assert len(corners) > 20
    for ctx in (first(frame), staged(frame)):
        seeds = apply_rule("photo_slam", ctx)
        assert len(seeds) == len(corners)
        assert seeds.opacity.unique().tolist() == pytest.approx([0.1])
    hole = dataclasses.replace(frame, depth_m=with_values(2.0, (some(N // 2), 0.0)))
    assert len(apply_rule("photo_slam", first(hole))) == int((corners[:, 0] > W // 2).sum())
    assert len(apply_rule("photo_slam", first(frame), {"max_depth_m": 1.9})) == 0


def test_gs_icp_adds_the_whole_grid_or_nothing():
    assert len(apply_rule("gs_icp", first())) == math.ceil(W / 10) * math.ceil(H / 10)
    ctx = first()
    grid = ctx.seeds_at(ctx.pixels(), 1.0).xyz_W.view(H, W, 3)[::5, ::5].reshape(-1, 3)
    count = len(grid)
    tum = {"preset": "tum"}
    assert len(apply_rule("gs_icp", first(), tum | {"density": 0.5})) == round(
        0.98 * math.ceil(W / 7) * math.ceil(H / 7)
    )
    enough = grid[: math.ceil(0.81 * count)]
    assert (
        len(
            apply_rule(
                "gs_icp",
                staged(xyz_W=enough, past_T_WC=poses(29)),
                tum,
            )
        )
        == 0
    )
    assert (
        len(
            apply_rule(
                "gs_icp",
                staged(xyz_W=enough, past_T_WC=poses(30)),
                tum,
            )
        )
        == count
    )
    memory: dict[str, Any] = {}
    too_few = staged(
        xyz_W=grid[: count // 2],
        past_T_WC=poses(7),
        memory=memory,
    )
    assert len(apply_rule("gs_icp", too_few, tum)) == count
    assert list(memory.values()) == [7]
    assert (
        len(
            apply_rule(
                "gs_icp",
                staged(xyz_W=enough, past_T_WC=poses(30), memory=memory),
                tum,
            )
        )
        == 0
    )
    assert (
        len(
            apply_rule(
                "gs_icp",
                staged(xyz_W=enough, past_T_WC=poses(37), memory=memory),
                tum,
            )
        )
        == count
    )


def poses(n: int) -> tuple[torch.Tensor, ...]:
    """As many past frames."""
    return (torch.eye(4),) * n


def test_two_dgs_slam_seeds_empty_voxels_only():
    ctx = first()
    assert len(apply_rule("two_dgs_slam", ctx)) == round(0.1 * N)
    held = ctx.seeds_at(ctx.pixels(some(N // 2)), 1.0).xyz_W
    held = held[held[:, 0] < -0.05]  # whole voxels
    seeds = apply_rule("two_dgs_slam", staged(xyz_W=held), {"share": 1.0})
    assert len(seeds) == int((ctx.seeds_at(ctx.pixels(), 1.0).xyz_W[:, 0] >= -0.05).sum())
    assert seeds.opacity[0].item() == pytest.approx(1 / (1 + math.exp(-0.999)))
    torch.testing.assert_close(seeds.scale_m[:, 2], 0.1 * seeds.scale_m[:, 0])
    assert apply_rule("two_dgs_slam", ctx, {"as_released": False}).opacity[
        0
    ].item() == pytest.approx(0.999)
    one = apply_rule("two_dgs_slam", ctx, {"one_per_voxel": True, "share": 1.0})
    assert len(one) == len((one.xyz_W / 0.05).floor().unique(dim=0)) < N


class SeenVolume:
    """A TSDF whose surface is 3 m away on the left half of the view, with the wall's colour but on
    some pixels."""

    config = TsdfConfig()

    def sample_nearest(self, xyz_W: torch.Tensor) -> Any:
        return SimpleNamespace(
            D=xyz_W[:, 0] * 0,
            W=xyz_W[:, 0] * 0 + 1,
        )

    def raycast(self, camera: Camera, T_WC: torch.Tensor) -> RaycastOutput:
        rgb = torch.full((H, W, 3), 0.5)
        rgb[some(100)] = 0.6
        depth_m = with_values(3.0, (some(N // 2, "right"), 0.0))
        normal_W = torch.zeros(H, W, 3)
        normal_W[..., 0] = 1.0
        return RaycastOutput(depth_m=depth_m, normal_W=normal_W, rgb=rgb)


def test_gps_slam_seeds_the_surface_of_the_tsdf_where_the_colour_is_wrong():
    ctx = first(volume=SeenVolume())
    seeds = apply_rule("gps_slam", ctx)
    assert len(seeds) == N // 2 // 4
    torch.testing.assert_close(
        seeds.xyz_W[:, 2],
        torch.full((len(seeds),), 3.0),
    )
    assert seeds.scale_m[:, 0].max().item() == pytest.approx(0.01)
    torch.testing.assert_close(seeds.scale_m[:, 2], 0.1 * seeds.scale_m[:, 0])
    assert quaternion.to_matrix(seeds.quat)[0, :, 2].tolist() == pytest.approx(
        [1.0, 0.0, 0.0], abs=1e-6
    )
    assert len(apply_rule("gps_slam", ctx, {"base": "tsdf"})) == 25
    assert len(apply_rule("gps_slam", first(), {"surface": "depth"})) == N // 4
    shown = staged(rgb=0.56, volume=SeenVolume())
    assert len(apply_rule("gps_slam", shown)) == N // 8
    assert len(apply_rule("gps_slam", shown, {"colour_error": 0.07})) == 0


def test_gps_slam_waits_until_a_voxel_is_sure():
    """The weight of ``SeenTwice`` is 2 in the upper half and 5 in the lower."""

    class SeenTwice(SeenVolume):
        def sample_nearest(self, xyz_W):
            return SimpleNamespace(W=torch.where(xyz_W[:, 1] < 0, 2.0, 5.0))

    ctx = first(volume=SeenTwice())
    whole = apply_rule("gps_slam", ctx)
    assert len(apply_rule("gps_slam", ctx, {"min_confidence": 2.0})) == len(whole)
    sure = apply_rule("gps_slam", ctx, {"min_confidence": 2.5})
    assert 0 < len(sure) < 0.7 * len(whole)
    assert (sure.xyz_W[:, 1] >= 0).all()
    assert len(apply_rule("gps_slam", ctx, {"min_confidence": 6.0})) == 0


def test_vings_counts_the_wrong_pixels_and_draws_from_all():
    bare = some(N // 4, "right")
    ctx = staged(alpha=with_values(1.0, (bare, 0.98)), depth_m=2.0)
    released = apply_rule("vings", ctx, {"share": 100 / (N // 4)})
    assert len(released) == 100
    assert (pixels_of(ctx, released) & ~bare).any()
    assert released.opacity.unique().tolist() == pytest.approx([0.8])
    assert len(released.quat.unique(dim=0)) == 100
    from_mask = apply_rule("vings", ctx, {"share": 100 / (N // 4), "as_released": False})
    assert len(from_mask) == 100
    assert not (pixels_of(ctx, from_mask) & ~bare).any()
    begin = apply_rule("vings", first())
    assert len(begin) == round(0.13 * N)
    assert begin.opacity.unique().tolist() == pytest.approx([0.1])


def test_gaus_slam_divides_the_depth_by_the_opacity():
    """Half of the view is covered by 0.7 at 2 m, so D^ is 1.4 m; 30 pixels are 1 m too far away."""
    far = some(30)
    alpha = with_values(1.0, (some(N // 2, "right"), 0.7))
    ctx = staged(alpha=alpha, depth_m=alpha * with_values(2.0, (far, 3.0)))
    assert torch.equal(pixels_of(ctx, apply_rule("gaus_slam", ctx)), far)
    near = staged(
        wall(depth_m=torch.full((H, W), 1.5)),
        alpha=0.7,
        depth_m=0.7 * 2.0,
    )
    # 1.4 m, undivided, is in front of 1.5 m
    assert len(apply_rule("gaus_slam", near, {"median_factor": 0.5})) == N
    assert len(apply_rule("splatam", near, {"median_factor": 0.5})) == 0


def stripes() -> Frame:
    """A wall with black and white stripes of eight pixels."""
    white = (torch.arange(W) // 8 % 2).float()
    return wall(rgb=white[None, :, None].expand(H, W, 3).contiguous())


def test_on_the_fly_nvs_seeds_detail_that_the_picture_lacks():
    fine = stripes()
    everything = {"density": 1e3}  # P above 1 near every edge of the stripes
    seeds = apply_rule("on_the_fly_nvs", first(fine), everything)
    column = pixels_of(first(fine), seeds).all(dim=0)
    assert column[3:61].all()  # the outer stripes have one edge
    assert len(apply_rule("on_the_fly_nvs", first())) == 0  # a plain wall
    assert (
        len(
            apply_rule(
                "on_the_fly_nvs",
                staged(fine, rgb=without_detail(fine.rgb)),
                everything,
            )
        )
        == 0
    )  # nothing is lacking
    assert len(apply_rule("on_the_fly_nvs", staged(fine, rgb=0.5), everything)) == len(seeds)


def test_cone_gs_draws_pixels_by_their_colour_error():
    red = some(100)
    rgb = torch.full((H, W, 3), 0.5)
    rgb[red] = 0.9
    ctx = staged(rgb=rgb)
    seeds = apply_rule("cone_gs", ctx, {"share": 2.0})
    assert len(seeds) == 80  # 2 x 100 x 0.4
    assert not (pixels_of(ctx, seeds) & ~red).any()
    # there is one Gaussian
    assert len(apply_rule("cone_gs", ctx, {"share": 2.0, "max_points": 11})) == 10


def test_vg_mapping_seeds_what_is_new_or_looks_different():
    fine = stripes()
    seen = SimpleNamespace(
        config=TsdfConfig(),
        sample_nearest=lambda xyz: SimpleNamespace(W=xyz[:, 0] * 0 + 5),
    )
    new = SimpleNamespace(
        config=TsdfConfig(),
        sample_nearest=lambda xyz: SimpleNamespace(W=(xyz[:, 0] < 0).float() * 4),
    )
    settings = SeedingConfig(quadtree_contrast="std", quadtree_threshold=0.05)
    count = len(first(fine, config=settings).cells(largest_m=0.0))  # vg_mapping has whole cells
    assert (
        len(apply_rule("vg_mapping", staged(fine, rgb=fine.rgb, volume=seen, config=settings))) == 0
    )
    half = apply_rule(
        "vg_mapping",
        staged(
            fine,
            rgb=fine.rgb,
            volume=new,
            config=settings,
        ),
    )
    assert 0 < len(half) < count
    assert bool((half.xyz_W[:, 0] >= 0).all())
    assert (
        len(
            apply_rule(
                "vg_mapping",
                staged(fine, rgb=1 - fine.rgb, volume=seen, config=settings),
            )
        )
        > count // 2
    )


def test_which_errors_are_large_depends_on_sides_and_median():
    ctx = half_wrong()  # 768 bare, 40 thin; 12 too far away, 8 too near
    assert int(unmapped_pixels(ctx, 0.5, 50.0).sum()) == 768 + 12
    assert int(unmapped_pixels(ctx, 0.5, 50.0, sides="both").sum()) == 768 + 20
    assert int(unmapped_pixels(ctx, 0.6, 50.0).sum()) == 768 + 40 + 12
    # most pixels have no depth: the median of all is 0
    holes = with_values(2.0, (some(2000, "right"), 0.0))
    beside = staged(
        wall(depth_m=holes),
        depth_m=with_values(2.01, (some(30), 2.2)),
    )
    assert int(unmapped_pixels(beside, 0.5, 10.0).sum()) == N - 2000
    assert torch.equal(unmapped_pixels(beside, 0.5, 10.0, median_of="measured"), some(30))
    assert torch.equal(unmapped_pixels(first(wall(depth_m=holes)), 0.5, 10.0), holes > 0)
    torch.testing.assert_close(
        depth_error_m(beside),
        with_values(0.01, (some(30), 0.2), (some(2000, "right"), 0.0)),
    )


def test_one_pixel_seeds_of_a_grid_and_of_a_share():
    ctx = first(wall(fy=40.0))
    everywhere = torch.ones(H, W, dtype=torch.bool)
    pixel_m = 2.0 / ((F + 40.0) / 2)
    for options, count, factor in [
        ({}, N, 1.0),
        ({"every_px": 2}, N // 4, 2.0),
        ({"every_px": 5}, math.ceil(W / 5) * math.ceil(H / 5), 5.0),
        ({"share": 0.25}, N // 4, 2.0),
        ({"share": 0.25, "every_px": 2}, N // 16, 4.0),
    ]:
        seeds = one_pixel_seeds(ctx, everywhere, **options)
        assert len(seeds) == count
        torch.testing.assert_close(seeds.scale_m, torch.full((count, 3), factor * pixel_m))
    grid = pixels_of(ctx, one_pixel_seeds(ctx, everywhere, every_px=2))
    assert grid[::2, ::2].all()
    assert int(grid.sum()) == N // 4
    for share in (0.0, 1.1, -1.0):
        with pytest.raises(ValueError, match=f"share must be above 0 and at most 1, got {share}"):
            one_pixel_seeds(ctx, everywhere, share=share)
    with pytest.raises(ValueError, match="every_px must be at least 1, got 0"):
        one_pixel_seeds(ctx, everywhere, every_px=0)


def test_what_lies_in_front_of_the_measured_depth():
    """The wall is 2 m away and 64 x 48 pixels with f = 60 wide: from -1.067 to 1.067 and from -0.8
    to 0.8 metres."""
    places = {
        (0.0, 0.0, 1.89): True,
        (0.0, 0.0, 1.91): False,  # within the margin
        (0.0, 0.0, 2.5): False,
        (0.0, 0.0, -1.0): False,
        (-0.53, 0.0, 1.0): True,
        (-0.54, 0.0, 1.0): False,  # beside the image
        (0.53, 0.39, 1.0): True,
        (0.53, 0.41, 1.0): False,
        (0.0, -0.41, 1.0): False,
        (0.2, 0.2, 1.0): False,  # a pixel without depth: column 44, row 36
    }
    depth_m = torch.full((H, W), 2.0)
    depth_m[36, 44] = 0.0
    ctx = staged(wall(depth_m=depth_m), xyz_W=torch.tensor(list(places)))
    assert in_front(ctx, 0.1).tolist() == list(places.values())
    left = torch.arange(W).expand(H, W) < W // 2
    assert in_front(ctx, 0.1, left).tolist() == [
        seen and x < 0 for (x, _, _), seen in places.items()
    ]


def test_pushed_back_discs_face_the_camera_where_there_is_no_normal():
    T_WC = torch.eye(4)
    T_WC[:3, 3] = torch.tensor([1.0, 0.0, 0.0])
    ctx = first(dataclasses.replace(wall(), T_WC=T_WC))
    xyz = torch.tensor([[1.0, 0.0, 2.0], [3.0, 0.0, 2.0]])
    seeds = Seeds.isotropic(
        xyz,
        torch.full((2, 3), 0.5),
        torch.tensor([0.1, 0.2]),
    )
    far = pushed_back(ctx, seeds, 1.5)
    torch.testing.assert_close(
        far.xyz_W,
        torch.tensor([[1.0, 0.0, 3.0], [4.0, 0.0, 3.0]]),
    )
    torch.testing.assert_close(
        far.scale_m,
        torch.tensor([[0.15] * 3, [0.3] * 3]),
    )
    discs = as_discs(
        ctx,
        seeds,
        torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
        0.2,
    )
    axes = quaternion.to_matrix(discs.quat)[:, :, 2]
    torch.testing.assert_close(
        axes,
        torch.tensor([[1.0, 0.0, 0.0], [-(0.5**0.5), 0.0, -(0.5**0.5)]]),
    )
    torch.testing.assert_close(
        discs.scale_m,
        torch.tensor([[0.1, 0.1, 0.02], [0.2, 0.2, 0.04]]),
    )


def test_monogs_leaves_out_black_and_sees_points_by_their_depth():
    """The size of a point is c times the median depth, at most 0.05: 0.05 m at 1 m and beyond for
    Replica."""
    assert monogs_presets == {"replica": (1 / 64, 0.05), "tum": (1 / 128, 0.01)}
    rgb = torch.full((H, W, 3), 0.5)
    rgb[:, : W // 2] = 0.003  # R + G + B is 0.009
    seeds = apply_rule("monogs", first(wall(rgb=rgb)), {"density": 32.0})
    assert torch.equal(
        pixels_of(first(), seeds),
        torch.arange(W).expand(H, W) >= W // 2,
    )
    near = apply_rule(
        "monogs",
        first(wall(depth_m=torch.full((H, W), 0.5))),
        {"density": 32.0},
    )
    far = apply_rule("monogs", first(), {"density": 32.0})
    # points four times as close, point size half as large
    ratio = float((near.scale_m[0, 0] / far.scale_m[0, 0]) ** 2)
    assert ratio == pytest.approx((0.5 / 2.0) ** 2 * 0.025 / 0.05, rel=1e-4)


@pytest.mark.parametrize("rule", ["splatam", "mm3dgs", "gaus_slam", "hf_slam"])
def test_every_pixel_of_the_first_frame_as_large_as_a_pixel(rule):
    ctx = first(wall(fy=30.0))
    seeds = apply_rule(rule, ctx)
    assert pixels_of(ctx, seeds).all()
    assert len(seeds) == N
    # z over the mean of 60 and 30
    torch.testing.assert_close(seeds.scale_m[:, 0], torch.full((N,), 2.0 / 45.0))
    assert (seeds.opacity == 0.5).all()


@pytest.mark.parametrize("rule", ["splatam", "mm3dgs", "gaus_slam", "vtgaussian"])
def test_with_holes_the_median_over_all_pixels_is_zero(rule):
    """Of 1,200 pixels with depth, 1,100 are 1 cm too far away and 100 1 cm too near; 1,872 have no
    depth."""
    hole = some(N - 1200, "right")
    near = some(100)
    ctx = staged(
        wall(depth_m=with_values(2.0, (hole, 0.0))),
        depth_m=with_values(2.01, (near, 1.99)),
    )
    assert len(apply_rule(rule, ctx)) == (1200 if rule == "mm3dgs" else 1100)
    assert len(apply_rule(rule, ctx, {"median_of": "measured"})) == 0


def test_gaussian_slam_reseeds_where_a_submap_starts():
    assert len(apply_rule("gaussian_slam", staged())) == 0
    again = staged(starts_submap=True)
    assert len(apply_rule("gaussian_slam", again)) == N
    assert len(apply_rule("gaussian_slam", again, {"restart": False})) == 0


@pytest.mark.parametrize(
    ("preset", "left"),
    [("replica", N), ("tum", N - 100), ("scannetpp", N)],
)
def test_gaussian_slam_pushes_back_and_rejects_what_is_near(preset, left):
    everything = apply_rule("gaussian_slam", first())
    torch.testing.assert_close(
        everything.xyz_W[:, 2],
        torch.full((N,), 2.0 * 1.005),
    )
    spacing = 2.0 * 1.005 / F
    inside = everything.scale_m[:, 0].view(H, W)[2:-2, 2:-2]
    torch.testing.assert_close(
        inside,
        torch.full_like(inside, spacing),
        atol=1e-5,
        rtol=0,
    )
    # 5 mm: between the limits 0.3 mm and 1 cm
    beside = everything.xyz_W[:100] + torch.tensor([0.0, 0.0, 0.005])
    ctx = staged(alpha=0.0, xyz_W=beside)
    module = importlib.import_module("gsfusion_nb.seeding.rules.gaussian_slam")
    kept = dataclasses.replace(module.PRESETS[preset], removes_outliers=False, frame_points=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(module.PRESETS, preset, kept)
        assert len(apply_rule("gaussian_slam", ctx, {"preset": preset})) == left


@pytest.mark.parametrize(("preset", "filters"), [("replica", False), ("tum", True)])
def test_gaussian_slam_leaves_out_a_lone_point_but_in_the_first_frame(preset, filters):
    """One pixel is 1 m behind the wall; its 40 nearest points are a metre away, those of the others
    a few pixels."""
    middle = W * (H // 2) + W // 2
    depth_m = torch.full((N,), 2.0)
    depth_m[middle] = 3.0
    frame = wall(depth_m=depth_m.view(H, W))
    everything = apply_rule("gaussian_slam", first(frame), {"preset": preset})
    assert everything.xyz_W[middle, 2] == pytest.approx(3.0 * 1.005)
    seeds = apply_rule("gaussian_slam", staged(frame, alpha=0.0), {"preset": preset})
    assert bool((seeds.xyz_W[:, 2] > 2.5).any()) != filters
    inside = torch.zeros(H, W, dtype=torch.bool)
    inside[8:-8, 8:-8] = True
    inside[H // 2, W // 2] = False
    assert pixels_of(staged(frame), seeds)[inside].all()


def pair() -> torch.Tensor:
    """Two places in the image."""
    return torch.tensor([[60.5, 1.5], [50.5, 3.5]])


def test_cg_slam_measures_distances_to_the_map_as_well():
    bare = staged(
        alpha=with_values(1.0, (some(1, "right"), 0.0)),
        xyz_W=first().seeds_at(pair(), 1.0).xyz_W,
    )
    seeds = apply_rule("cg_slam", bare)
    assert len(seeds) == 1
    distances = (bare.map.xyz_W - seeds.xyz_W).norm(dim=1)
    torch.testing.assert_close(
        seeds.scale_m[0, 0],
        distances.square().mean().sqrt(),
    )


def test_gs_icp_takes_the_shape_of_the_neighbourhood():
    seeds = apply_rule("gs_icp", first(), {"density": 6.25, "neighbours": 9})
    middle = ((seeds.xyz_W[:, :2].abs() < 0.5).all(dim=1)).nonzero()[0, 0]
    # 3 x 3 grid points 4 px apart: variance 2/3 of the distance squared along x and y, none along z
    spacing = 4 * 2.0 / F
    wanted = (2 / 3) ** 0.5 * spacing / (2 * 2.0**1.5)
    assert seeds.scale_m[middle].tolist() == pytest.approx([1e-7**0.5, wanted, wanted], rel=1e-4)
    thin = quaternion.to_matrix(seeds.quat)[middle, :, 0]
    assert thin.abs().tolist() == pytest.approx([0.0, 0.0, 1.0], abs=1e-5)


def test_hf_slam_sums_opacities_behind_each_gaussian():
    """Two Gaussians over the whole view, of opacity a: a (1 - a) + a (1 - a)^2 in place of a + (1 -
    a) a."""
    model = GaussianModel(sh_degree=0)
    centres = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]])
    model.append(
        Seeds.isotropic(
            centres,
            torch.full_like(centres, 0.5),
            torch.full((2,), 1e3),
            opacity=0.6,
        )
    )
    ctx = SeedContext(wall(), gaussians=model)
    torch.testing.assert_close(
        ctx.render().alpha,
        torch.full((H, W), 0.84),
        atol=1e-4,
        rtol=0,
    )
    torch.testing.assert_close(
        alpha_behind(ctx),
        torch.full((H, W), 0.24 + 0.096),
        atol=1e-4,
        rtol=0,
    )
    assert len(apply_rule("hf_slam", ctx)) == N  # 0.336 is below 0.5


@pytest.mark.parametrize(
    ("z", "opacity", "hidden"),
    [(1.9, 0.98, True), (2.1, 0.98, False), (1.5, 0.5, False)],
)
def test_on_the_fly_nvs_drops_what_the_map_hides(z, opacity, hidden):
    """A Gaussian over the whole view at z: hidden is 2 m >= z / opacity."""
    model = GaussianModel(sh_degree=0)
    centre = torch.tensor([[0.0, 0.0, z]])
    model.append(
        Seeds.isotropic(
            centre,
            torch.full_like(centre, 0.5),
            torch.full((1,), 1e3),
            opacity=opacity,
        )
    )
    ctx = SeedContext(stripes(), gaussians=model)
    assert (len(apply_rule("on_the_fly_nvs", ctx)) == 0) == hidden
    assert len(apply_rule("on_the_fly_nvs", ctx, {"drop_hidden": False})) > 0


def test_the_numbers_of_gaussian_slams_release():
    """Points of a submap's first frame and of others, least distance (squared), outlier filter, by
    data set."""
    presets = {name: tuple(vars(preset).values()) for name, preset in gaussian_slam_presets.items()}
    assert presets == {
        "replica": (600_000, 0, 1e-7, False),
        "tum": (100_000, 30_000, 1e-4, True),
        "scannetpp": (400_000, 100_000, 1e-8, False),
    }


@pytest.mark.parametrize(
    ("max_points", "count"),
    [(0, 614), (700, 614), (614, 614), (100, 100)],
)
def test_cone_gs_keeps_to_its_budget_in_the_first_frame(max_points, count):
    assert len(apply_rule("cone_gs", first(), {"share": 0.2, "max_points": max_points})) == count
