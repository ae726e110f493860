"""What each rule chooses."""

import dataclasses

import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.seeding import SeedContext, apply_rule, check_contexts
from gsfusion_nb.tsdf.integrate import integrate
from gsfusion_nb.tsdf.volume import TsdfVolume


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
        torch.testing.assert_close(seeds.scale_m[:, 0] * ctx.camera.fx / z, torch.full_like(z, (0.5 / fraction) ** 0.5))


def mapped(*frames) -> SeedContext:
    """A context on the last frame, after a real volume took in all of them."""
    made_up = check_contexts()["new"]
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.04, truncation_voxels=4.0))
    for frame in frames:
        integrate(volume, frame)
    return SeedContext(frames[-1], volume, config=made_up.config)


@pytest.mark.parametrize("name", ["gsfusion", "uniform", "dense"])
def test_a_second_look_at_the_same_view_seeds_nothing(name):
    frame = check_contexts()["new"].frame
    first = apply_rule(name, mapped(frame))
    assert len(first) > 0.8 * len(apply_rule(name, mapped(frame), {"coverage": False}))
    assert len(apply_rule(name, mapped(frame, frame))) == 0


def test_a_surface_that_appears_in_voxels_seen_empty_is_never_seeded():
    """The consequence of "weight == 1" that the rule's description warns of."""
    frame = check_contexts()["new"].frame
    nearer = dataclasses.replace(frame, depth_m=(frame.depth_m - 0.1).clamp_min(0.5))  # inside the 0.16 m band in front
    fresh = apply_rule("gsfusion", mapped(nearer))
    after = apply_rule("gsfusion", mapped(frame, nearer))
    assert len(after) < 0.2 * len(fresh)
