"""RTG-SLAM's rule and its gaps."""

import dataclasses
import math
import sys

import pytest
import torch

from gsfusion_nb.gaussians import STABLE, UNSTABLE, SurfelModel
from gsfusion_nb.geometry import project, quaternion, se3
from gsfusion_nb.render import SurfaceView
from gsfusion_nb.seeding import SeedContext, apply_rule, check_contexts, disc_view
from gsfusion_nb.seeding.rules.rtg_slam import (
    BORDER_M,
    COLOUR_ERROR,
    DEPTH_ERROR,
    ERROR_SHARE,
    NEW_AREA,
    gaps_around,
    is_near,
    wrong_pixels,
)
from gsfusion_nb.types import Camera, Frame, Seeds

W = 64
H = 24
CAMERA = Camera(
    width=W,
    height=H,
    fx=60.0,
    fy=60.0,
    cx=W / 2,
    cy=H / 2,
)
LEFT = slice(3, 13)
MIDDLE = slice(27, 37)
RIGHT = slice(51, 61)
"""Columns well inside the three patches of the wall below."""


def wall(z: float = 2.0, grey: float = 0.5) -> Frame:
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.full((H, W, 3), grey),
        depth_m=torch.full((H, W), z),
        camera=CAMERA,
        T_WC=torch.eye(4),
    )


def patches(*, stable: bool = True) -> SurfelModel:
    """Three wide discs side by side: as the wall is; 0.3 m before it; of another colour. Gaps of
    new area between."""
    x = torch.tensor([-0.8, 0.0, 0.8])
    z = torch.tensor([2.0, 1.7, 2.0])
    model = SurfelModel(sh_degree=0)
    model.append(
        Seeds(
            xyz_W=torch.stack([x * z / 2.0, torch.zeros(3), z], dim=1),
            rgb=torch.tensor([[0.5] * 3, [0.5] * 3, [0.95, 0.5, 0.5]]),
            scale_m=torch.tensor([[0.13, 10.0, 0.001]]).repeat(3, 1),
            quat=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
            opacity=torch.full((3,), 0.99),
            tag=torch.zeros(3, dtype=torch.int32),
        )
    )
    if stable:
        model.state.fill_(STABLE)
    return model


def context(model, frame: Frame | None = None, seed: int = 0) -> SeedContext:
    return SeedContext(
        frame or wall(), gaussians=model, generator=torch.Generator().manual_seed(seed)
    )


def columns(ctx: SeedContext, seeds: Seeds) -> torch.Tensor:
    xyz_C = se3.apply(se3.inverse(ctx.frame.T_WC), seeds.xyz_W)
    return project(ctx.camera, xyz_C)[:, 0]


def masks(ctx: SeedContext, fidelity: str = "paper") -> dict[int, torch.Tensor]:
    usable = ctx.has_depth() & (ctx.normals() != 0).any(dim=-1)
    return wrong_pixels(ctx, disc_view(ctx), usable, 0.5, 0.1, 0.1, fidelity)


def test_a_pixel_has_the_first_kind_that_applies():
    """By hand, one pixel each (all with depth 2): T, rendered depth, rendered grey -> kind."""
    by_hand = [
        (0.51, 1.0, 0.0, NEW_AREA),  # whatever its depth and colour
        (0.50, 2.0, 0.5, None),
        (0.20, 1.89, 0.0, DEPTH_ERROR),  # whatever its colour
        (0.20, 2.11, 0.5, DEPTH_ERROR),  # behind as well as before
        (0.20, 2.09, 0.5, None),
        (0.20, 2.0, 0.61, COLOUR_ERROR),
        (0.20, 2.0, 0.39, COLOUR_ERROR),
        (0.20, 2.0, 0.59, None),
        (0.20, 0.0, 0.5, None),  # no disc is hit
        (0.20, 0.0, 0.0, COLOUR_ERROR),
    ]
    T, depth, grey, _ = zip(*by_hand, strict=True)
    camera = dataclasses.replace(CAMERA, width=len(by_hand), height=1)
    frame = dataclasses.replace(
        wall(),
        camera=camera,
        rgb=torch.full((1, len(T), 3), 0.5),
        depth_m=torch.full((1, len(T)), 2.0),
    )
    none = torch.full((1, len(T)), -1)
    view = SurfaceView(
        rgb=torch.tensor([grey])[..., None].repeat(1, 1, 3),
        transmittance=torch.tensor([T]),
        depth_m=torch.tensor([depth]),
        normal_W=torch.zeros(1, len(T), 3),
        hit_index=none,
        dominant_index=none,
    )
    ctx = SeedContext(frame)
    usable = torch.ones(1, len(T), dtype=torch.bool)
    kinds = wrong_pixels(ctx, view, usable, 0.5, 0.1, 0.1, "measured")
    for i, (*_, kind) in enumerate(by_hand):
        assert [k for k, mask in kinds.items() if mask[0, i]] == ([] if kind is None else [kind]), (
            by_hand[i]
        )
    pooled = wrong_pixels(ctx, view, usable, 0.5, 0.1, 0.1, "code")
    assert torch.equal(pooled[NEW_AREA], kinds[NEW_AREA])
    assert torch.equal(pooled[DEPTH_ERROR], kinds[DEPTH_ERROR] | kinds[COLOUR_ERROR])
    printed = wrong_pixels(ctx, view, usable, 0.5, 0.1, 0.1, "paper")  # depth -1 where none is hit
    assert torch.equal(printed[DEPTH_ERROR], kinds[DEPTH_ERROR] | (view.depth_m == 0))
    assert torch.equal(printed[COLOUR_ERROR], kinds[COLOUR_ERROR] & (view.depth_m > 0))
    nowhere = wrong_pixels(ctx, view, ~usable, 0.5, 0.1, 0.1, "paper")
    assert not any(mask.any() for mask in nowhere.values())


def test_without_a_map_every_pixel_is_new_and_disc_lies_in_the_surface():
    ctx = check_contexts()["new"]
    for alone in (ctx, SeedContext(ctx.frame)):
        seeds = apply_rule("rtg_slam", alone, {"share": 0.2})
        known = int((alone.has_depth() & (alone.normals() != 0).any(-1)).sum())
        assert len(seeds) == round(0.2 * known)
        assert seeds.tag.eq(NEW_AREA).all()
        assert seeds.opacity.unique().tolist() == [pytest.approx(0.99)]
        uv = project(
            ctx.camera,
            se3.apply(se3.inverse(ctx.frame.T_WC), seeds.xyz_W),
        )
        i, j = uv.floor().long().unbind(-1)
        torch.testing.assert_close(uv, uv.floor() + 0.5, atol=1e-3, rtol=0)
        normal = quaternion.to_matrix(seeds.quat)[:, :, 2]
        torch.testing.assert_close(
            normal,
            ctx.normals_W()[j, i],
            atol=1e-5,
            rtol=0,
        )
        assert torch.equal(seeds.rgb, ctx.frame.rgb[j, i])
        torch.testing.assert_close(seeds.scale_m[:, 1], seeds.scale_m[:, 0])
        torch.testing.assert_close(seeds.scale_m[:, 2], 0.1 * seeds.scale_m[:, 0])
        assert 0.001 <= seeds.scale_m[:, 0].min() <= seeds.scale_m[:, 0].max() <= 0.05


def test_stable_discs_get_a_transparent_one_over_their_wrong_colour():
    ctx = context(patches())
    seeds = apply_rule("rtg_slam", ctx, {"share": 0.3, "fidelity": "paper"})
    u = columns(ctx, seeds)
    clear = seeds.opacity < 0.5
    assert seeds.opacity[clear].unique().tolist() == [pytest.approx(0.1)]
    assert (seeds.tag[clear] == COLOUR_ERROR).all()
    assert (seeds.tag[~clear] != COLOUR_ERROR).all()
    i, j = project(ctx.camera, seeds.xyz_W).floor().long().unbind(-1)
    # also the rims, dim before the black behind them
    asked = masks(ctx)[COLOUR_ERROR] & (disc_view(ctx).hit_index >= 0)
    assert asked[j[clear], i[clear]].all()
    assert (u[clear] > RIGHT.start).sum() > 20
    assert seeds.scale_m[clear].max() <= 0.01 + 1e-7
    over_middle = (u > MIDDLE.start) & (u < MIDDLE.stop)
    assert (seeds.tag[over_middle] == DEPTH_ERROR).all()
    assert (seeds.opacity[over_middle] > 0.9).all()
    assert over_middle.sum() > 20
    over_left = (u > LEFT.start + 3) & (u < LEFT.stop - 3)
    assert not over_left.any()


@pytest.mark.parametrize("share", [0.0, -0.1, 1.01, float("nan")])
def test_a_share_that_is_none_is_refused(share):
    with pytest.raises(
        ValueError, match=f"rtg_slam: share must be above 0 and at most 1, got {share}"
    ):
        apply_rule("rtg_slam", context(patches()), {"share": share})


def test_without_transparent_discs_the_opaque_ones_stay():
    options = {"share": 0.3, "fidelity": "paper"}
    both = apply_rule("rtg_slam", context(patches()), options)
    opaque = apply_rule("rtg_slam", context(patches()), options | {"transparent": False})
    assert (both.opacity < 0.5).sum() > 20
    assert torch.equal(opaque.xyz_W, both.xyz_W[both.opacity > 0.5])
    assert (opaque.opacity > 0.5).all()


def test_code_without_transparent_discs_adds_none_on_a_stable_plane():
    model = small_discs(24, 2.0 - 0.04, 0.01, (0.95, 0.05, 0.05), stable=True)
    both = apply_rule("rtg_slam", context(model), CODE)
    opaque = apply_rule("rtg_slam", context(model), CODE | {"transparent": False})
    assert (both.opacity < 0.5).any()
    assert len(opaque)
    assert (opaque.opacity > 0.5).all()


def test_transparent_discs_are_not_piled_up():
    """One of radius 0.1 m in the middle of the wrong colour covers 0.3 m; in the paper it covers
    nothing."""
    ctx = context(patches())
    one = Seeds.isotropic(
        torch.tensor([[0.8, 0.0, 2.0]]),
        torch.full((1, 3), 0.5),
        torch.tensor([0.1]),
        opacity=0.1,
    )
    assert ctx.gaussians is not None
    ctx.gaussians.append(one)
    before = patches()
    after = ctx.gaussians

    def distances(model: SurfelModel, fidelity: str) -> torch.Tensor:
        seeds = apply_rule("rtg_slam", context(model), {"share": 0.5, "fidelity": fidelity})
        clear = seeds.opacity < 0.5
        assert clear.sum() > 20
        return (seeds.xyz_W[clear] - one.xyz_W).norm(dim=1)

    assert distances(before, "measured").min() < 0.3
    assert distances(after, "paper").min() < 0.3
    assert 0.3 <= distances(after, "measured").min() < 0.4


def test_transparent_discs_far_from_new_ones_are_not_searched(monkeypatch):
    """Of two hundred in the rooms beside this one; the seeds are the same without them."""
    near = torch.tensor([[0.8, 0.0, 2.0], [0.7, 0.1, 2.0]])
    far = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) + 5.0
    seeds_of = {}
    searched = []
    rule = sys.modules[gaps_around.__module__]
    search = rule.k_nearest

    def count(points, others, k):
        searched.append(len(others))
        return search(points, others, k)

    monkeypatch.setattr(rule, "k_nearest", count)
    for name, xyz_W in (("near", near), ("all", torch.cat([near, far]))):
        model = patches()
        n = len(xyz_W)
        radius_m = torch.full((n,), 0.1)
        model.append(Seeds.isotropic(xyz_W, torch.full((n, 3), 0.5), radius_m, opacity=0.1))
        seeds_of[name] = apply_rule("rtg_slam", context(model), {"share": 0.5})
    assert searched == [2, 2]
    assert torch.equal(seeds_of["all"].xyz_W, seeds_of["near"].xyz_W)
    assert torch.equal(seeds_of["all"].scale_m, seeds_of["near"].scale_m)


def small_discs(
    n_side: int,
    z: float,
    radius_m: float,
    rgb: tuple[float, float, float],
    stable: bool,
) -> SurfelModel:
    """A sheet of discs three and a half radii apart, all over the view."""
    step = 3.5 * radius_m
    a = (torch.arange(n_side) - (n_side - 1) / 2) * step
    x, y = (t.flatten() for t in torch.meshgrid(a, a, indexing="xy"))
    n = len(x)
    model = SurfelModel(sh_degree=0)
    model.append(
        Seeds(
            xyz_W=torch.stack([x, y, torch.full((n,), z)], dim=1),
            rgb=torch.tensor([rgb]).repeat(n, 1),
            scale_m=torch.tensor([[radius_m, radius_m, 0.1 * radius_m]]).repeat(n, 1),
            quat=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
            opacity=torch.full((n,), 0.99),
            tag=torch.zeros(n, dtype=torch.int32),
        )
    )
    if stable:
        model.state.fill_(STABLE)
    return model


CODE = {"share": 0.2, "fidelity": "code"}


def test_code_near_the_plane_of_a_stable_disc_is_transparent():
    """A sheet of discs 4 cm before the wall, then 6 cm: half of the 10 cm limit lies between."""
    for before, opacity in ((0.04, 0.1), (0.06, 0.99)):
        model = small_discs(24, 2.0 - before, 0.01, (0.95, 0.05, 0.05), stable=True)
        seeds = apply_rule("rtg_slam", context(model), CODE)
        assert len(seeds) > 20
        u = columns(context(model), seeds)
        over = (u > 26) & (u < 38)  # the sheet covers the middle of the view
        assert over.any()
        seen = seeds.opacity[over].unique().tolist()
        assert pytest.approx(opacity) in seen
        if opacity == 0.99:
            assert len(seen) == 1


@pytest.mark.parametrize("stable", [False, True])
def test_code_adds_nothing_within_six_tenths_of_a_radius_of_an_unstable_disc(stable):
    """A faint disc of radius 0.3 m in the wall lets through enough light for every pixel to be new.
    Most of its pixels have other pixels for their three nearest neighbours, so no gap forbids them:
    only the disc's own state does."""
    model = SurfelModel(sh_degree=0)
    disc = Seeds.isotropic(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.full((1, 3), 0.5),
        torch.ones(1),
        opacity=0.3,
    )
    model.append(dataclasses.replace(disc, scale_m=torch.tensor([[0.3, 0.3, 0.001]])))
    model.state.fill_(STABLE if stable else UNSTABLE)
    seeds = apply_rule("rtg_slam", context(model), {"share": 1.0, "fidelity": "code"})
    distance = (seeds.xyz_W - torch.tensor([0.0, 0.0, 2.0])).norm(dim=1)
    assert (distance > 0.181).sum() > 500
    assert (distance < 0.179).any() == stable


def test_by_hand_with_an_existing_disc():
    """Points at x = 0, 0.1, 0.3; a disc of radius 0.03 at x = 0.14 covers 0.05 .. 0.23."""
    xyz = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    gaps = gaps_around(
        xyz,
        torch.tensor([[0.14, 0.0, 0.0]]),
        torch.tensor([0.03]),
    )
    expected = [[0.05, 0.1, 0.3], [-0.05, 0.1, 0.2], [0.07, 0.2, 0.3]]
    torch.testing.assert_close(gaps.gap_m.sort(dim=1).values, torch.tensor(expected))
    assert gaps.overlaps.tolist() == [False, True, False]
    rms = [math.sqrt(sum(max(g, 0.0) ** 2 for g in row) / 3) for row in expected]
    torch.testing.assert_close(gaps.size_m, torch.tensor(rms))


def brute_force(xyz, other, radius, reach: float, k: int) -> torch.Tensor:
    """Distances to every other centre in the padded box, less the reach of the k nearest."""
    low = xyz.amin(0) - BORDER_M
    high = xyz.amax(0) + BORDER_M
    rows = []
    for i in range(len(xyz)):
        found = [(float((xyz[i] - xyz[j]).norm()), 0.0) for j in range(len(xyz)) if j != i]
        for x, r in zip(other, radius, strict=True):
            if ((x >= low) & (x <= high)).all():
                found.append((float((xyz[i] - x).norm()), float(r)))
        rows.append([d - reach * r for d, r in sorted(found)[:k]])
    return torch.tensor(rows)


@pytest.mark.parametrize(
    ("m", "n"),
    [(2, 5), (30, 0), (25, 40)],
)
def test_agrees_with_a_loop_over_all_pairs(generator, m, n):
    xyz = torch.rand(m, 3, generator=generator) * 0.3
    other = torch.rand(n, 3, generator=generator) * 0.6 - 0.15
    radius = torch.rand(n, generator=generator) * 0.03
    gaps = gaps_around(xyz, other, radius)
    torch.testing.assert_close(
        gaps.gap_m, brute_force(xyz, other, radius, 3.0, 3), atol=1e-6, rtol=1e-5
    )


NONE = torch.zeros(0, 3), torch.zeros(0)


def grid(n: int, spacing: float) -> torch.Tensor:
    a = torch.arange(n) * spacing
    return torch.stack(
        [*torch.meshgrid(a, a, indexing="ij"), torch.zeros(n, n)],
        dim=-1,
    ).reshape(-1, 3)


def test_the_middle_of_a_grid_is_as_wide_as_its_spacing():
    size = gaps_around(grid(5, 0.02), *NONE).size_m.view(5, 5)
    torch.testing.assert_close(
        size[1:-1, 1:-1],
        torch.full((3, 3), 0.02),
    )
    # a corner has neighbours at 1, 1 and sqrt(2) spacings: sqrt((1 + 1 + 2) / 3)
    assert float(size[0, 0]) == pytest.approx(0.02 * math.sqrt(4 / 3), rel=1e-5)


@pytest.mark.parametrize("copies", [2, 3, 4, 6])
def test_duplicates_are_each_others_neighbours_and_never_their_own(copies):
    xyz = torch.cat([torch.zeros(copies, 3), torch.tensor([[0.5, 0, 0], [0, 0.7, 0], [0, 0, 0.9]])])
    gaps = gaps_around(xyz, *NONE).gap_m[:copies].sort(dim=1).values
    zeros = min(copies - 1, 3)
    expected = ([0.0] * zeros + [0.5, 0.7, 0.9])[:3]
    torch.testing.assert_close(gaps, torch.tensor([expected]).repeat(copies, 1))


def test_distant_discs_do_not_count():
    """One 6 cm beyond the points' box, however large."""
    gaps = gaps_around(
        torch.tensor([[0.0, 0, 0], [0.1, 0, 0]]),
        torch.tensor([[0.161, 0.0, 0.0]]),
        torch.ones(1),
    )
    torch.testing.assert_close(gaps.gap_m, torch.full((2, 1), 0.1))


@pytest.mark.parametrize("n_discs", [0, 2, 30])
def test_reach_of_the_nearest_discs_by_a_loop(generator, n_discs):
    """Of the discs that count, the three nearest; others of the map are as near, and do not."""
    model = SurfelModel(sh_degree=0)
    for xyz in (torch.rand(n_discs, 3, generator=generator), torch.rand(9, 3, generator=generator)):
        discs = Seeds.isotropic(xyz, xyz, torch.rand(len(xyz), generator=generator) / 5 + 0.05)
        model.append(discs)
    counts = torch.arange(len(model)) < n_discs
    new_xyz = torch.rand(60, 3, generator=generator)
    new = Seeds.isotropic(new_xyz, new_xyz, torch.full((60,), 0.1))
    away = (new_xyz[:, None] - model.params.xyz_W[:n_discs]).norm(dim=-1)
    expected = [
        any(row[i] < 1.5 * model.radius_m[i] for i in row.argsort()[:3].tolist()) for row in away
    ]
    assert is_near(context(model), new, counts, 1.5).tolist() == expected
    assert any(expected) == (n_discs > 0)


@pytest.mark.parametrize("share", [0.05, 0.3, 1.0])
def test_a_share_of_each_kind_is_drawn(share):
    ctx = context(patches())
    kinds = masks(ctx)
    seeds = apply_rule("rtg_slam", ctx, {"share": share, "fidelity": "paper"})
    for kind in (NEW_AREA, DEPTH_ERROR, COLOUR_ERROR):
        assert int((seeds.tag == kind).sum()) == round(share * int(kinds[kind].sum())) > 0
    assert len(torch.unique(seeds.xyz_W, dim=0)) == len(seeds)


def test_measured_leaves_out_opaque_discs_in_the_reach_of_others():
    """On a sheet of discs in the wall, of another colour; a sheet 20 cm before the wall reaches
    nothing there."""

    def near(fidelity: str, z: float) -> tuple[int, int, int]:
        """Seeds within three radii of a disc that are opaque, all that are transparent, depth
        errors."""
        model = small_discs(6, z, 0.03, (0.95, 0.05, 0.05), stable=True)
        seeds = apply_rule("rtg_slam", context(model), {"share": 0.03, "fidelity": fidelity})
        away = torch.cdist(seeds.xyz_W, model.params.xyz_W).amin(1)
        opaque = seeds.opacity > 0.5
        return (
            int((opaque & (away < 0.09)).sum()),
            int((~opaque).sum()),
            int((seeds.tag == DEPTH_ERROR).sum()),
        )

    in_reach, clear, _ = near("paper", 2.0)
    left, clear_too, wrong_too = near("measured", 2.0)
    assert in_reach > left == wrong_too == 0
    assert min(clear, clear_too) > 0
    assert near("measured", 1.8)[2] > 0


def test_code_adds_nothing_near_unstable_discs_nor_in_reach_of_any():
    ctx = context(
        small_discs(
            24,
            2.0,
            0.01,
            (0.95, 0.05, 0.05),
            stable=False,
        )
    )
    seeds = apply_rule("rtg_slam", ctx, CODE)
    away = torch.cdist(seeds.xyz_W, ctx.map.xyz_W).amin(1)
    assert away.min() > 0.03  # three radii
    assert seeds.opacity.unique().tolist() == [pytest.approx(0.99)]
    assert seeds.scale_m.max() <= 0.05 + 1e-7


def test_code_draws_its_own_share_of_wrong_pixels():
    ctx = context(patches())
    kinds = masks(ctx, "code")
    seeds = apply_rule("rtg_slam", ctx, {"share": 1.0, "fidelity": "code"})
    assert (
        0
        < int((seeds.tag == DEPTH_ERROR).sum())
        <= round(ERROR_SHARE * int(kinds[DEPTH_ERROR].sum()))
    )
    assert not (seeds.tag == COLOUR_ERROR).any()
