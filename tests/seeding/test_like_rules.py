"""Rules that edit the map: what they remove and add after steps, and the settings that they
bring."""

import dataclasses
from typing import Any

import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.seeding import SeedContext, Seeds, StepStats, apply_rule
from gsfusion_nb.seeding.points import add_up
from gsfusion_nb.seeding.rules import cone_gs, game, monogs_like, splatam_like, vg_mapping
from gsfusion_nb.seeding.rules.splatam import PRUNED_AFTER
from gsfusion_nb.tsdf import TsdfVolume
from gsfusion_nb.types import Camera, Frame


@pytest.fixture
def frame() -> Frame:
    """A plain wall 3 m away, its lowest row 6 m."""
    depth_m = torch.full((6, 8), 3.0)
    depth_m[5] = 6.0
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.full((6, 8, 3), 0.5),
        depth_m=depth_m,
        camera=Camera(width=8, height=6, fx=8.0, fy=8.0, cx=4.0, cy=3.0),
        T_WC=torch.eye(4),
    )


def model_with(opacity: list[float], scale_m: list[float]) -> GaussianModel:
    model = GaussianModel(sh_degree=0)
    n = len(opacity)
    seeds = Seeds.isotropic(
        torch.zeros(n, 3),
        torch.full((n, 3), 0.5),
        torch.tensor(scale_m),
    )
    model.append(dataclasses.replace(seeds, opacity=torch.tensor(opacity)))
    return model


def stats_of(frame: Frame, **values: Any) -> StepStats:
    defaults = {"step": 1, "stage": "online", "step_in_frame": 1, "steps_in_frame": 60}
    return StepStats(
        **(defaults | values),
        frame_index=0,
        camera=frame.camera,
        T_WC=frame.T_WC,
        target=frame.rgb,
        loss=torch.tensor(0.0),
    )


def test_splatam_like_seeds_as_splatam_and_remembers_the_radius(frame):
    memory: dict[str, Any] = {}
    ctx = SeedContext(frame, gaussians=GaussianModel(sh_degree=0), memory=memory)
    assert len(apply_rule("splatam_like", ctx)) == len(apply_rule("splatam", ctx)) == 48
    assert memory == {"scene_radius_m": pytest.approx(2.0)}


def test_monogs_like_clones_splits_and_removes_every_150_steps(frame):
    model = model_with(
        [0.9] * 4 + [0.6, 0.9, 0.9],
        [0.005, 0.02, 0.005, 0.02, 0.005, 0.11, 0.005],
    )
    # mean length, in units of half the image
    large = torch.tensor([3e-4, 3e-4, 1e-4, 1e-4, 3e-4, 3e-4, 3e-4])
    v_uv = torch.stack([large / 4.0, torch.zeros(7)], dim=1)  # half the width is 4 pixels
    add_up(model, torch.ones(7, dtype=torch.bool), v_uv, frame.camera)
    rule = monogs_like()
    ctx = SeedContext(frame, gaussians=model)
    seen = {
        "visible": torch.ones(7, dtype=torch.bool),
        "radius_px": torch.tensor([5.0] * 6 + [21.0]),
    }
    assert rule.after_step(ctx, stats_of(frame, step=149, **seen), {}) is None
    narrow = seen | {"radius_px": torch.full((7,), 5.0)}  # the largest radius is remembered
    edit = rule.after_step(ctx, stats_of(frame, step=150, **narrow), {})
    assert edit is not None
    assert edit.clone is not None
    assert edit.split is not None
    assert edit.keep is not None
    assert edit.clone.tolist() == [True] + [False] * 6
    assert edit.split.tolist() == [False, True] + [False] * 5
    assert edit.keep.tolist() == [True] * 4 + [False] * 3
    model.edit(edit, torch.Generator().manual_seed(0), 0)
    assert len(model) == 3 + 1 + 2  # kept and not split; the clone; the halves
    assert model.row_memory("largest_radius_px").tolist() == [0.0] * 6


def placed(opacity: list[float], z: list[float]) -> GaussianModel:
    """Large Gaussians in the middle of the view, at these depths."""
    model = GaussianModel(sh_degree=0)
    xyz_W = torch.tensor([[0.0, 0.0, depth] for depth in z])
    seeds = Seeds.isotropic(
        xyz_W,
        torch.full_like(xyz_W, 0.9),
        torch.full((len(z),), 2.0),
    )
    model.append(dataclasses.replace(seeds, opacity=torch.tensor(opacity)))
    return model


@pytest.mark.parametrize(
    ("values", "prunes"),
    [({}, True), ({"step_in_frame": 2}, False), ({"stage": "passes"}, False)],
)
def test_vg_mapping_removes_what_the_frame_sees_through(frame, values, prunes):
    # the wall is 3 m away
    ctx = SeedContext(frame, gaussians=placed([0.5] * 4, [2.98, 2.99, 3.1, 1.0]))
    edit = vg_mapping().after_step(ctx, stats_of(frame, **values), {})
    assert (edit is not None) == prunes
    if edit is not None and edit.keep is not None:
        assert edit.keep.tolist() == [False, True, True, False]


@pytest.mark.parametrize(
    ("voxel_m", "keep"),
    [(0.02, [False, True, True]), (0.04, [True, True, True]), (0.005, [False, False, True])],
)
def test_vg_mapping_spares_what_is_nearer_than_a_voxel_and_a_half(frame, voxel_m, keep):
    """Three Gaussians 4 cm, 2 cm and 1 cm before the wall, which is 3 m away; at least 1.5 cm are
    spared."""
    volume = TsdfVolume(TsdfConfig(voxel_size_m=voxel_m))
    model = placed([0.5] * 3, [2.96, 2.98, 2.99])
    ctx = SeedContext(frame, gaussians=model, volume=volume)
    edit = vg_mapping().after_step(ctx, stats_of(frame), {})
    assert (
        edit.keep.tolist() if edit is not None and edit.keep is not None else [True] * 3
    ) == keep
    assert vg_mapping(prunes=False).after_step(ctx, stats_of(frame), {}) is None


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        ({"step_in_frame": 31}, [True, True, False, True]),
        ({"step_in_frame": 30}, None),
        ({"step_in_frame": 60}, [True, False, False, True]),
        ({"step_in_frame": 60, "stage": "passes"}, None),
    ],
)
def test_game_removes_faint_ones_halfway_and_stale_ones_at_the_end(frame, values, kept):
    """The map's picture is brighter than the wall. The second is 6 cm before it, the fourth 4 cm,
    the third is faint and far behind."""
    ctx = SeedContext(
        frame,
        gaussians=placed([0.5, 0.9, 0.09, 0.9], [3.5, 2.94, 9.0, 2.96]),
    )
    edit = game().after_step(ctx, stats_of(frame, **values), {})
    assert (edit and edit.keep is not None and edit.keep.tolist()) == kept


def test_game_keeps_what_has_the_right_colour(frame):
    grey = dataclasses.replace(frame, rgb=torch.full((6, 8, 3), 0.9))
    ctx = SeedContext(grey, gaussians=placed([0.99], [2.5]))
    assert (ctx.render().rgb - 0.9).abs().mean(dim=-1)[2:4, 3:5].max() < 0.1
    assert game().after_step(ctx, stats_of(grey, step_in_frame=60), {}) is None


@pytest.mark.parametrize(
    ("values", "share", "kept"),
    [
        ({"step_in_frame": 21}, 1.0, [True, False, False, True]),
        (
            {"step_in_frame": 21},
            0.25,
            [True, False, True, True],
        ),  # four times as few, twice as large
        ({"step_in_frame": 20}, 1.0, None),
        ({"step_in_frame": 21, "stage": "passes"}, 1.0, None),
    ],
)
def test_splatam_like_removes_faint_and_large_ones(frame, values, share, kept):
    """A tenth of a radius of 2 m is the limit of size, 0.005 that of opacity."""
    assert 21 in PRUNED_AFTER
    ctx = SeedContext(
        frame,
        gaussians=model_with([0.5, 0.0049, 0.5, 0.0051], [0.19, 0.1, 0.21, 0.1]),
    )
    edit = splatam_like(share=share).after_step(
        ctx, stats_of(frame, **values), {"scene_radius_m": 2.0}
    )
    assert (edit and edit.keep is not None and edit.keep.tolist()) == kept


@pytest.mark.parametrize(
    ("step", "kept"),
    [(100, [True, False, True]), (300, [True, False, True]), (101, None)],
)
def test_cone_gs_removes_faint_ones_every_100_steps(frame, step, kept):
    ctx = SeedContext(frame, gaussians=model_with([0.5, 0.0049, 0.0051], [0.1] * 3))
    edit = cone_gs().after_step(ctx, stats_of(frame, step=step), {})
    assert (edit and edit.keep is not None and edit.keep.tolist()) == kept
    whole = SeedContext(frame, gaussians=model_with([0.5, 0.1], [0.1] * 2))
    assert cone_gs().after_step(whole, stats_of(frame, step=100), {}) is None


@pytest.mark.parametrize(
    ("values", "reset_every", "set_to"),
    [
        ({"step": 2001}, 2001, [0.4, 0.4]),
        ({"step": 2000}, 2001, None),
        ({"step": 2001}, 0, None),
        ({"step": 2001, "stage": "passes"}, 2001, None),
    ],
)
def test_monogs_like_gives_hidden_ones_an_opacity_of_their_own(frame, values, reset_every, set_to):
    model = model_with([0.9, 0.8, 0.7], [0.01] * 3)
    seen = {"visible": torch.tensor([True, False, False]), "radius_px": torch.zeros(3)}
    rule = monogs_like(reset_every=reset_every)
    edit = rule.after_step(
        SeedContext(frame, gaussians=model), stats_of(frame, **values, **seen), {}
    )
    if set_to is None:
        assert edit is None
    else:
        assert edit is not None
        rows, opacity = edit.set["opacity"]
        assert rows.tolist() == [False, True, True]
        assert opacity.tolist() == pytest.approx(set_to)
        assert edit.clone is edit.split is edit.keep is None
