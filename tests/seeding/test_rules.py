"""The first rules: GSFusion's, dense and uniform; values of seeds; cells without depth."""

import dataclasses
import importlib
from dataclasses import dataclass, field
from math import sqrt
from typing import Any

import pytest
import torch

from gsfusion_nb.config import SeedingConfig, TsdfConfig
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry import project, se3
from gsfusion_nb.seeding import SeedContext, Seeds, apply_rule, check_contexts
from gsfusion_nb.seeding.depth_from_sides import depth_from_sides
from gsfusion_nb.seeding.depth_holes import cells_without_depth
from gsfusion_nb.seeding.discs import LONGEST
from gsfusion_nb.tsdf import TsdfVolume, integrate
from gsfusion_nb.types import Camera, Frame, RenderOutput


@pytest.fixture
def half_seen() -> SeedContext:
    return check_contexts()["half seen"]


def xyz_C(ctx: SeedContext, seeds) -> torch.Tensor:
    return se3.apply(se3.inverse(ctx.frame.T_WC), seeds.xyz_W)


@pytest.mark.parametrize("name", ["gsfusion", "uniform", "dense"])
def test_only_voxels_observed_for_the_first_time(name, half_seen):
    voxel = half_seen.volume.config.voxel_size_m  # pyright: ignore[reportOptionalMemberAccess]
    seeds = apply_rule(name, half_seen)
    assert (half_seen.voxel_weight(seeds.xyz_W) == 1).all()
    assert xyz_C(half_seen, seeds)[:, 0].min() > -voxel
    before = apply_rule(name, half_seen, {"required_weight": 3.0})
    assert len(before) > 0
    assert xyz_C(half_seen, before)[:, 0].max() < voxel


@pytest.mark.parametrize("name", ["gsfusion", "uniform", "dense"])
def test_without_coverage_no_volume_is_needed(name, half_seen):
    alone = SeedContext(half_seen.frame, config=half_seen.config)
    everywhere = apply_rule(name, alone, {"coverage": False})
    assert len(everywhere) > 1.5 * len(apply_rule(name, half_seen))
    with pytest.raises(ValueError, match="voxel_weight needs a TSDF volume"):
        apply_rule(name, alone)


def test_gsfusion_takes_every_unseen_cell():
    ctx = check_contexts()["new"]
    cells = ctx.cells()
    seeds = apply_rule("gsfusion", ctx)
    assert len(seeds) == int((ctx.voxel_weight(cells.xyz_W) == 1).sum())
    assert seeds.tag.unique().tolist() == cells.tag.unique().tolist()


def test_uniform_draws_the_fraction_without_replacement():
    ctx = check_contexts()["new"]
    for fraction in (0.05, 0.5, 1.0):
        fresh = dataclasses.replace(ctx, generator=torch.Generator().manual_seed(3))
        seeds = apply_rule("uniform", fresh, {"fraction": fraction})
        assert len(seeds) == round(fraction * 61 * 47)
        assert len(torch.unique(seeds.xyz_W, dim=0)) == len(seeds)
        z = xyz_C(ctx, seeds)[:, 2]
        torch.testing.assert_close(
            seeds.scale_m[:, 0] * ctx.camera.fx / z,
            torch.full_like(z, (0.5 / fraction) ** 0.5),
        )


def mapped(*frames) -> SeedContext:
    """A context on the last frame, after a real volume took in all of them."""
    made_up = check_contexts()["new"]
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.04, truncation_voxels=4.0))
    for frame in frames:
        integrate(volume, frame)
    return SeedContext(frames[-1], volume, config=made_up.config)


def test_a_surface_that_appears_in_voxels_seen_empty_is_never_seeded():
    """The consequence of "weight == 1" that the rule's description warns of."""
    frame = check_contexts()["new"].frame
    # inside the 0.16 m band in front
    nearer = dataclasses.replace(frame, depth_m=(frame.depth_m - 0.1).clamp_min(0.5))
    fresh = apply_rule("gsfusion", mapped(nearer))
    after = apply_rule("gsfusion", mapped(frame, nearer))
    assert len(after) < 0.2 * len(fresh)


W = 64
H = 48
FX = 60.0
FY = 50.0
Z = 2.0
WIDTH = 2 / 60
HEIGHT = 2 / 50
D3 = sqrt((2 * WIDTH**2 + HEIGHT**2) / 3)
"""sqrt(nn2): root mean square distance to the 3 nearest of all pixels."""
SPLATAM = 2 / 55
"""z / ((fx + fy) / 2)."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """What a rule must seed at one place of the picture."""

    sigma: tuple[float, float, float]
    opacity: float = 0.5
    options: dict[str, Any] = field(default_factory=dict)
    at: tuple[float, float] = (32.5, 24.5)
    z: float = Z
    picture: str = "grey"
    mapped: bool = False
    """Whether there is a map already, elsewhere, so that the frame shows nothing of it."""


def ball(sigma: float) -> tuple[float, float, float]:
    return (sigma, sigma, sigma)


def disc(sigma: float, thickness: float = 0.1) -> tuple[float, float, float]:
    return (sigma, sigma, thickness * sigma)


ALL = {"share": 1.0}
HALF_DIAGONAL_PX = 40.0  # sqrt(32^2 + 24^2): a plain picture is one leaf of the quadtree
STEP_P = 0.75 * 22 / 37  # B |Laplacian| 1.5 pixels left of a step (test_a_step_halved_and_enlarged)
# 1/32 in the first frame
# P = 1.05: one pixel
CASES: dict[str, Case] = {
    "gsfusion": Case(  # cut four times: 4 x 3 pixels at 2 m are 8 cm
        sigma=disc(Z * HALF_DIAGONAL_PX / 16 / FX, 0.2), opacity=0.9, at=(34.0, 25.5)
    ),
    "vg_mapping": Case(  # n = 1 / (1 + (0, 0, 1)) = (1, 1, 1/2), |n| = 3/2
        sigma=disc(Z * HALF_DIAGONAL_PX / FX * 2 / 3, 0.5), at=(32.0, 24.0)
    ),
    "uniform": Case(
        sigma=ball(Z * sqrt(1 / (2 * 0.05)) / FX),
        options={"coverage": False},
    ),
    "dense": Case(sigma=ball(Z / FX)),
    "splatam": Case(sigma=ball(SPLATAM)),
    "splatam_like": Case(sigma=ball(SPLATAM)),
    "mm3dgs": Case(sigma=ball(SPLATAM)),
    "hf_slam": Case(sigma=ball(SPLATAM)),
    "gaus_slam": Case(sigma=disc(SPLATAM)),
    "vtgaussian": Case(sigma=ball(1.005 * SPLATAM), z=1.005 * Z),
    "vtgaussian, fine": Case(
        sigma=ball(1.005 * SPLATAM / 2),
        at=(32.25, 24.25),
        z=1.005 * Z,
        picture="step",
    ),
    "monogs": Case(sigma=ball(sqrt(0.05) * D3), options={"density": 32.0}),
    "monogs_like": Case(sigma=ball(sqrt(0.05) * D3), options={"density": 32.0}),
    "gaussian_slam": Case(sigma=ball(1.005 * D3), z=1.005 * Z),
    "gs_slam": Case(sigma=ball(D3), options={"first_share": 1.0}),
    "cg_slam": Case(sigma=ball(D3)),
    "game": Case(sigma=ball(sqrt(0.05) * D3), options=ALL),
    "photo_slam": Case(sigma=ball(10 * D3), opacity=0.1, picture="corners"),
    # 3 x 3 points of a grid of 4 pixels: variance 2/3 of the distance squared; 2 z^1.5 = 5.657
    "gs_icp": Case(
        sigma=(1e-7**0.5, sqrt(2 / 3) * 4 * WIDTH / 5.656854, sqrt(2 / 3) * 4 * HEIGHT / 5.656854),
        opacity=0.1,
        options={"density": 6.25, "neighbours": 9},
    ),
    "rtg_slam": Case(sigma=disc(D3), opacity=0.99, options=ALL),
    "two_dgs_slam": Case(sigma=disc(D3), opacity=0.73087, options=ALL),  # sigmoid(0.999)
    "gps_slam": Case(sigma=disc(0.01), options=ALL | {"surface": "depth"}),
    "vings": Case(sigma=disc(D3), opacity=0.1, options=ALL),
    "vings, later": Case(sigma=disc(D3), opacity=0.8, options=ALL, mapped=True),
    "on_the_fly_nvs": Case(sigma=ball(Z / FX), opacity=0.07, picture="step", at=(31.5, 24.5)),
    "on_the_fly_nvs, sparse": Case(
        sigma=ball(Z / FX / sqrt(2 * STEP_P)),
        opacity=0.07,
        picture="step",
        at=(30.5, 24.5),
    ),
    "edge_discs": Case(
        sigma=disc(0.7 * 4 * Z / FX, 0.2),
        opacity=0.9,
        at=(33.0, 22.784610),
    ),
    "edge_strokes": Case(
        sigma=disc(0.7 * 4 * Z / FX, 0.2),
        opacity=0.9,
        at=(33.0, 22.784610),
    ),
    "default_strategy": Case(sigma=ball(SPLATAM / sqrt(0.05))),
    "mcmc": Case(sigma=ball(SPLATAM / sqrt(0.05))),
    "cone_gs": Case(sigma=ball(D3), opacity=0.1, options=ALL),
    "cone_gs, later": Case(  # the diameter of a pixel's cone
        sigma=ball((WIDTH + HEIGHT) / 2),
        opacity=0.1,
        options={"share": 1e3},
        mapped=True,
    ),
}
"""Rule, with a word on the case where there are several -> what it seeds."""


def every_tenth_pixel(frame: Frame, count: int) -> torch.Tensor:
    """In place of the corners of an image."""
    u, v = torch.meshgrid(
        torch.arange(2.5, W, 10),
        torch.arange(4.5, H, 10),
        indexing="xy",
    )
    return torch.stack([u, v], dim=-1).reshape(-1, 2)


def context(case: Case) -> SeedContext:
    rgb = torch.full((H, W, 3), 0.5)
    if case.picture == "step":
        rgb = (torch.arange(W) >= W // 2).float()[None, :, None].expand(H, W, 3).contiguous()
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=torch.full((H, W), Z),
        camera=Camera(width=W, height=H, fx=FX, fy=FY, cx=W / 2, cy=H / 2),
        T_WC=torch.eye(4),
    )
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.05))
    integrate(volume, frame)
    model = GaussianModel(sh_degree=0)
    if case.mapped:
        behind = torch.tensor([[0.0, 0.0, -5.0]])
        model.append(
            Seeds.isotropic(
                behind,
                torch.full_like(behind, 0.5),
                torch.tensor([0.02]),
            )
        )
    return SeedContext(frame, volume, model)


@pytest.mark.parametrize("name", CASES)
def test_place_size_and_opacity(monkeypatch, name):
    case = CASES[name]
    if case.picture == "corners":
        monogs = importlib.import_module("gsfusion_nb.seeding.rules.monogs")
        monkeypatch.setattr(monogs, "orb_corners", every_tenth_pixel)
    ctx = context(case)
    seeds = apply_rule(name.partition(",")[0], ctx, case.options)
    z = seeds.xyz_W[:, 2]
    uv = torch.stack(
        [seeds.xyz_W[:, 0] / z * FX + W / 2, seeds.xyz_W[:, 1] / z * FY + H / 2],
        dim=1,
    )
    off = (uv - torch.tensor(case.at)).norm(dim=1)
    drawn = case.options.get("density", 1) <= 1 and name in ("uniform", "default_strategy", "mcmc")
    row = int(off.argmin())
    assert float(off[row]) < (5.0 if drawn else 1e-3)  # a rule that draws pixels may miss this one
    assert float(z[row]) == pytest.approx(case.z, rel=1e-6)
    assert sorted(seeds.scale_m[row].tolist()) == pytest.approx(sorted(case.sigma), rel=1e-4)
    assert float(seeds.opacity[row]) == pytest.approx(case.opacity, abs=1e-5)


FINE = SeedingConfig(quadtree_threshold=0.02, quadtree_contrast="std")


def test_depth_is_the_mean_of_the_four_sides_by_the_square_of_their_nearness():
    depth_m = torch.zeros(5, 7)
    depth_m[2, 0] = 2.0
    depth_m[2, 4] = 4.0
    depth_m[0, 2] = 3.0
    depth_m[1, 6] = 9.0
    filled = depth_from_sides(depth_m, depth_m > 0)
    assert filled[2, 2].item() == 3.0  # three sides at a distance of 2
    torch.testing.assert_close(
        filled[2, 1],
        torch.tensor((2.0 + 4.0 / 9) / (1 + 1 / 9)),
    )
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
    # middles of cells lie at whole and half pixels
    uv = project(frame.camera, xyz_C).mul(2).round() / 2
    i, j = uv.floor().long().unbind(-1)
    assert (frame.depth_m[j, i] == 0).all()
    assert ((xyz_C[:, 2] / small_walk[0].depth_m[j, i]).log().abs() < 0.5).all()
    torch.testing.assert_close(seeds.rgb, frame.rgb[j, i])
    # no cell narrower than 3 pixels
    assert (seeds.scale_m[:, 0] * frame.camera.fx / xyz_C[:, 2] > 1.9).all()


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown(SeedContext):
    """A context whose map covers the picture by this much."""

    alpha: torch.Tensor

    def render(self) -> RenderOutput:
        zero = torch.zeros_like(self.alpha)
        return RenderOutput(
            rgb=zero[..., None].expand(-1, -1, 3),
            depth_m=zero,
            alpha=self.alpha,
            first_index=None,
            dominant_index=None,
        )


@pytest.mark.parametrize(
    ("covered", "seeded"),
    [(0.0, True), (0.49, True), (0.5, False), (1.0, False)],
)
def test_cells_in_the_hole_that_the_map_shows_already_get_none(small_walk, covered, seeded):
    """The right half of the picture is covered by so much, the left half not at all; from 0.5 on a
    pixel is shown."""
    frame = holed(small_walk[0])
    model = GaussianModel(sh_degree=0)
    behind = torch.tensor([[0.0, 0.0, -5.0]])
    model.append(
        Seeds.isotropic(
            behind,
            torch.full_like(behind, 0.5),
            torch.tensor([0.02]),
        )
    )
    alpha = torch.zeros_like(frame.depth_m)
    alpha[:, 40:] = covered
    ctx = Shown(frame, gaussians=model, config=FINE, alpha=alpha)
    u_all = columns(ctx, cells_without_depth(SeedContext(frame, config=FINE)))
    u = columns(ctx, cells_without_depth(ctx))
    assert (u_all > 41).sum() > 5
    assert torch.equal(u, u_all if seeded else u_all[u_all < 39.9])


def columns(ctx: SeedContext, seeds: Seeds) -> torch.Tensor:
    """Where in the picture the seeds are, from the left, pixels."""
    return project(ctx.camera, xyz_C(ctx, seeds))[:, 0]


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.01, float("nan")])
def test_uniform_refuses_what_is_no_share(fraction):
    with pytest.raises(
        ValueError, match=f"uniform: fraction must be above 0 and at most 1, got {fraction}"
    ):
        apply_rule("uniform", check_contexts()["new"], {"fraction": fraction})


@pytest.mark.parametrize("name", ["gsfusion", "uniform", "dense"])
def test_a_second_look_at_the_same_view_seeds_nothing(name):
    frame = check_contexts()["new"].frame
    first = apply_rule(name, mapped(frame))
    assert len(first) > 0.8 * len(apply_rule(name, mapped(frame), {"coverage": False}))
    assert len(apply_rule(name, mapped(frame, frame))) == 0


def test_a_fine_gaussian_comes_besides_the_coarse_one():
    ctx = context(CASES["vtgaussian, fine"])
    seeds = apply_rule("vtgaussian", ctx)
    edges = int(ctx.edges(50.0, 200.0, 3, euclidean=True).sum())
    assert edges > 0
    assert len(seeds) == W * H + 4 * edges
    assert len(apply_rule("vtgaussian", ctx, {"fine": False})) == W * H


def test_the_euclidean_gradient_is_the_shorter_one():
    """A diagonal step of 30 grey levels: |gx| + |gy| is above OpenCV's 100, the root of the squares
    is not."""
    step = (
        (torch.arange(W)[None] + torch.arange(H)[:, None] >= 55).float()[..., None].expand(H, W, 3)
    )
    ctx = context(CASES["dense"])
    ctx = SeedContext(dataclasses.replace(ctx.frame, rgb=0.3 + step * 18 / 255))
    assert ctx.edges(100.0, 100.0).any()
    assert not ctx.edges(100.0, 100.0, euclidean=True).any()


def test_none_where_the_map_shows_something_or_nothing_is_missing(small_walk):
    frame = holed(small_walk[0])
    whole = SeedContext(small_walk[0], config=FINE)
    assert len(cells_without_depth(whole)) == 0
    assert (
        len(
            cells_without_depth(
                SeedContext(dataclasses.replace(frame, depth_m=torch.zeros(60, 80)))
            )
        )
        == 0
    )
    opaque = dataclasses.replace(
        whole.cells(),
        opacity=torch.full((len(whole.cells()),), 0.95),
    )
    half = opaque[whole.quadtree_cells().centre_uv[:, 0] < 40]
    gaussians = GaussianModel(0)
    gaussians.append(half, 0)
    ctx = SeedContext(frame, gaussians=gaussians, config=FINE)
    xyz_C = se3.apply(se3.inverse(frame.T_WC), cells_without_depth(ctx).xyz_W)
    u = project(frame.camera, xyz_C)[:, 0]
    assert (u > 40).float().mean() > 0.9


def test_the_setting_adds_them_to_the_rule_and_skip_is_as_published(small_walk):
    frame = holed(small_walk[0])
    whole = dataclasses.replace(FINE, quadtree_largest_m=0.0)
    skip = SeedContext(frame, config=dataclasses.replace(whole, without_depth="skip"))
    with_depth = apply_rule("gsfusion", skip, {"coverage": False})
    both = apply_rule("gsfusion", SeedContext(frame, config=whole), {"coverage": False})
    assert torch.equal(with_depth.xyz_W, skip.cells().xyz_W)
    n = len(with_depth)
    assert torch.equal(both.xyz_W[:n], with_depth.xyz_W)
    assert len(both) - n == len(cells_without_depth(SeedContext(frame, config=whole))) > 0


def test_cells_in_a_hole_are_cut_by_the_depth_around_it(small_walk):
    """No cell is larger than the setting says, measured or guessed, and no disc larger than it may
    be for its cell."""
    frame = holed(small_walk[0])
    coarse = dataclasses.replace(FINE, quadtree_threshold=0.1)
    for largest_m, is_reached in ((0.0, False), (0.4, True)):
        ctx = SeedContext(frame, config=dataclasses.replace(coarse, quadtree_largest_m=largest_m))
        guessed = cells_without_depth(ctx), 1.0  # as balls
        measured = ctx.cells(), ctx.config.thickness
        for seeds, thickness in (guessed, measured):
            assert len(seeds) > 0
            assert (seeds.scale_m.max() <= LONGEST * 0.4) == is_reached
            assert (seeds.scale_m[:, 2].max() <= thickness * 0.4) == is_reached


@pytest.mark.parametrize("contrast", ["released", "std"])
def test_coarser_cells_are_larger_and_less_even(contrast):
    """Twice the coarseness: twice the largest size, and twice the deviation of colours."""
    ramp = torch.linspace(0, 1, 64).expand(48, 64)[..., None].expand(48, 64, 3)
    ctx = context(CASES["gsfusion"])
    ctx = dataclasses.replace(ctx, frame=dataclasses.replace(ctx.frame, colour=ramp.contiguous()))
    threshold = {"released": 0.004, "std": 0.1}[contrast]
    settings = SeedingConfig(
        quadtree_threshold=threshold, quadtree_contrast=contrast, quadtree_largest_m=0.4
    )
    by_hand = dataclasses.replace(
        settings,
        quadtree_threshold=threshold * (4 if contrast == "released" else 2),
        quadtree_largest_m=0.8,
    )
    fine = apply_rule("gsfusion", dataclasses.replace(ctx, config=settings))
    coarse = apply_rule("gsfusion", dataclasses.replace(ctx, config=settings), {"coarseness": 2.0})
    expected = apply_rule("gsfusion", dataclasses.replace(ctx, config=by_hand))
    assert 1 < len(coarse) < len(fine)
    assert torch.equal(coarse.xyz_W, expected.xyz_W)
    with pytest.raises(ValueError, match="coarseness must be above 0, got 0"):
        apply_rule("gsfusion", dataclasses.replace(ctx, config=settings), {"coarseness": 0.0})


def test_the_rule_follows_the_settings_of_size_shape_and_opacity():
    """A plain wall, 64 x 48 pixels at 2 m: as published one ball of 40 pixels; one cut makes four
    of 32 x 24, each with a disc of its size on the wall."""
    ctx = context(CASES["gsfusion"])
    d = Z * HALF_DIAGONAL_PX / FX
    for settings, n, sigma in (
        (SeedingConfig(quadtree_largest_m=0.0, thickness=1.0, opacity=0.5), 1, ball(d)),
        (
            SeedingConfig(quadtree_largest_m=d * 0.9, thickness=0.5, opacity=0.7),
            4,
            disc(d / 2, 0.5),
        ),
    ):
        seeds = apply_rule("gsfusion", dataclasses.replace(ctx, config=settings))
        expected = torch.tensor(sigma).repeat(n, 1)
        if settings.thickness < 1:
            expected[:, :2] = torch.tensor([32.0 / FX, 24.0 / FY]) / 2**0.5 * Z
        torch.testing.assert_close(seeds.scale_m, expected)
        torch.testing.assert_close(seeds.opacity, torch.full((n,), settings.opacity))
