import json

import pytest

from gsfusion_nb.config import (
    GSFusionConfig,
    from_dict,
    gsfusion,
    gsfusion_fidelity,
    presets,
    replace,
    to_dict,
)


@pytest.mark.parametrize(
    ("preset", "m", "n", "random", "passes", "all_frames"),
    [
        ("replica", 5, 3, 2, 10, False),
        ("scannetpp", 10, 1, 9, 10, True),
        ("tum", 10, 5, 5, 20, False),
    ],
)
@pytest.mark.parametrize("fidelity", ["paper_steps", "paper", "code"])
def test_presets_carry_the_published_numbers(preset, m, n, random, passes, all_frames, fidelity):
    c = gsfusion(preset, fidelity)
    o = c.optim
    assert (o.keyframe_iterations, o.frame_iterations, o.random_keyframe_iterations) == (
        m,
        n,
        random,
    )
    assert (o.global_iterations, c.keep_all_frames) == (passes, all_frames)
    assert (o.lr_xyz, o.lr_sh_dc, o.lr_sh_rest) == (1.6e-4, 2.5e-3, 1.25e-4)
    assert (o.lr_opacity_logit, o.lr_log_scale, o.lr_quat) == (0.05, 1e-3, 1e-3)
    assert (o.depth_weight, o.depth_over_alpha, c.keyframe_max_gap) == (0.0, False, 0)
    assert (c.tsdf.voxel_size_m, c.tsdf.truncation_m, c.tsdf.max_weight) == (
        0.01,
        pytest.approx(0.08),
        100,
    )
    assert (c.seeding.quadtree_threshold, c.keyframe_min_seeds, c.sh_degree) == (0.1, 50, 3)


@pytest.mark.parametrize("preset", presets())
def test_what_the_paper_says(preset):
    c = gsfusion(preset, "paper")
    assert (c.tsdf.sdf, c.tsdf.average, c.tsdf.outlier_guard) == ("z", "eq9", False)
    assert (c.optim.ssim_weight, c.optim.adam_steps) == (0.0, "shared")
    assert c.seeding.one_per_voxel
    assert (c.data.hold_out_every, c.data.scored_views) == (0, 0)


@pytest.mark.parametrize("preset", presets())
def test_what_the_released_code_does(preset):
    c = gsfusion(preset, "code")
    assert (c.tsdf.sdf, c.tsdf.average, c.tsdf.outlier_guard) == ("ray", "int16", False)
    assert (c.optim.ssim_weight, c.optim.adam_steps) == (0.2, "shared")
    assert not c.seeding.one_per_voxel
    assert (c.data.hold_out_every, c.data.scored_views) == (0, 0)
    assert c.optim.keyframe_iterations == gsfusion(preset, "paper_steps").optim.keyframe_iterations


def test_measured_is_the_default():
    assert gsfusion("room") == gsfusion("room", "measured")
    with pytest.raises(
        KeyError, match="no fidelity 'papre'; known: code, measured, paper, paper_steps"
    ):
        gsfusion("room", "papre")


@pytest.mark.parametrize("preset", presets())
def test_measured_has_its_loss_on_all_data_and_its_steps_where_views_are_close(preset):
    ours = gsfusion(preset)
    papers = gsfusion(preset, "paper_steps")
    default = gsfusion()
    depth = (ours.optim.depth_weight, ours.optim.depth_over_alpha, ours.optim.depth_coverage)
    assert depth == (0.2, True, 0.1)
    assert ours.keyframe_max_gap == 5
    seeding = ours.seeding
    assert (seeding.quadtree_largest_m, seeding.thickness, seeding.opacity) == (0.1, 0.2, 0.9)
    papers_seeds = replace(ours, seeding=papers.seeding)
    assert replace(papers_seeds, optim=papers.optim, keyframe_max_gap=0) == papers
    assert ours.optim.global_iterations == {"tum": 20, "online": 0}.get(preset, 10)
    assert ours.keep_all_frames == (preset == "scannetpp")
    if preset == "scannetpp":
        without_depth = replace(ours.optim, depth_weight=0.0, depth_over_alpha=False)
        assert without_depth == papers.optim
    else:
        assert replace(ours.optim, global_iterations=10) == default.optim
        assert (ours.optim.keyframe_iterations, ours.optim.lr_xyz) == (3, 2 * papers.optim.lr_xyz)


@pytest.mark.parametrize("preset", presets())
@pytest.mark.parametrize("fidelity", ["measured", "paper", "code"])
def test_settings_know_what_they_follow(preset, fidelity):
    assert (
        gsfusion_fidelity(gsfusion(preset, fidelity, sh_degree=0, tsdf__voxel_size_m=0.05))
        == fidelity
    )


def test_settings_know_their_exceptions():
    mixed = gsfusion("replica", "code", optim__ssim_weight=0.0)
    assert gsfusion_fidelity(mixed) == "code, but optim.ssim_weight 0.0"
    held_out = gsfusion("replica", "paper", data__hold_out_every=8, optim__adam_steps="none")
    assert gsfusion_fidelity(held_out) == "paper, but data.hold_out_every 8, optim.adam_steps none"


def test_overrides_reach_nested_fields():
    c = gsfusion("tum", "code", tsdf__voxel_size_m=0.02, sh_degree=0, optim={"lr_xyz": 1.0})
    assert c.tsdf.voxel_size_m == 0.02
    assert c.tsdf.truncation_m == pytest.approx(0.16)
    assert (c.sh_degree, c.optim.lr_xyz, c.optim.keyframe_iterations) == (0, 1.0, 10)


@pytest.mark.parametrize("preset", presets())
def test_json_round_trip(preset):
    c = gsfusion(preset, seeding__options={"fraction": 0.1})
    assert from_dict(GSFusionConfig, json.loads(json.dumps(to_dict(c)))) == c


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(
        ValueError, match=r"tsdf: unknown keys \['voxel_sise_m'\]; known: .*'voxel_size_m'"
    ):
        gsfusion("replica", tsdf__voxel_sise_m=0.1)
    with pytest.raises(ValueError, match="config: unknown keys"):
        replace(GSFusionConfig(), sh=1)
    with pytest.raises(KeyError, match="no preset 'repilca'; known: azure, online, replica"):
        gsfusion("repilca")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ({"tsdf__voxel_size_m": 0.0}, r"tsdf.voxel_size_m must be between"),
        ({"data__scored_views": -1}, "scored_views must be"),
        ({"tsdf__near_m": 7.0}, "near_m must be below far_m"),
        ({"seeding__quadtree_threshold": -1.0}, "quadtree_threshold must be > 0"),
        ({"seeding__quadtree_min_cell_px": 0}, "quadtree_min_cell_px must be"),
        ({"optim__frame_iterations": -1}, "frame_iterations must be"),
        ({"optim__ssim_weight": 1.5}, "ssim_weight must be between 0 and 1"),
        ({"data__stride": 0}, "stride must be"),
        ({"data__hold_out_every": 1}, "would hold out every frame"),
        (
            {"tsdf__voxel_size_m": 0.0001},
            r"tsdf.voxel_size_m must be between 0.001 and 1, got 0.0001",
        ),
        ({"tsdf__far_m": float("inf")}, "tsdf.far_m must be finite"),
        ({"optim__lr_xyz": float("nan")}, r"optim.lr_xyz must be finite, got nan"),
        (
            {"data__depth_min_m": 5.0, "data__depth_max_m": 1.0},
            r"depth_max_m must be above depth_min_m 5.0",
        ),
        ({"sh_degree": 5}, "sh_degree must be"),
        (
            {"optim__beta1": 0.99, "optim__beta2": 0.9},
            r"beta2 must be above beta1 squared, 0.9801, got 0.9",
        ),
        ({"optim__beta1": 1.0}, r"optim.beta1 must be between 0 and 0.999"),
    ],
)
def test_bad_values_are_sentences(override, message):
    with pytest.raises(ValueError, match=message):
        gsfusion("replica", **override)
