"""GPS-SLAM: its presets, rounds, holes, and that Gaussians over a surface are better than the
surface alone."""

import dataclasses
from typing import Any

import pytest
import torch

from gsfusion_nb.config import ScheduleConfig, gps_slam, gps_slam_fidelity
from gsfusion_nb.data import open_sequence
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import GPSSLAM, make_mapper, tsdf_mapping
from gsfusion_nb.mapping.gps_rounds import remove_useless
from gsfusion_nb.mapping.gps_views import ViewRound
from gsfusion_nb.optim import fit_pose_by_flow
from gsfusion_nb.render import surface_picture
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.runs.scores import score
from gsfusion_nb.seeding.rules.gps_slam import gps_slam as gps_slam_rule
from gsfusion_nb.types import Seeds

ROOM: dict[str, Any] = {"path_or_name": "room", "n_frames": 240, "width": 64, "height": 48}
SMALL: dict[str, Any] = {
    "data__width": 0,
    "data__height": 0,
    "tsdf__voxel_size_m": 0.04,
    "final__passes": 1,
}


def mapped(n: int, **changes: Any) -> MappingRun:
    config = gps_slam("room", **{"data__stop": n, "data__hold_out_every": 8, **SMALL, **changes})
    run = MappingRun(
        open_sequence(**ROOM, data=config.data),
        make_mapper(config),
        source=ROOM,
    )
    list(run.online())
    return run


@pytest.fixture(scope="module")
def run() -> MappingRun:
    """At 64x48 there are few pixels, so more of them are seeded than usual."""
    return mapped(
        30,
        seeding__options={"colour_error": 0.03, "share": 0.25, "max_weight": 1.0, "in_holes": True},
    )


def test_the_released_numbers():
    c = gps_slam("replica", "code")
    assert (c.tsdf.voxel_size_m, c.tsdf.truncation_m, c.tsdf.max_weight) == (
        0.005,
        pytest.approx(0.02),
        100,
    )
    assert (c.base.holes, c.base.resolution, c.base.behind_m) == ("black", "full", 0.1)
    s = c.schedule
    r = c.residual
    assert (s.every_frames, s.iterations, s.window_every, s.keyframes, s.recalled) == (
        10,
        20,
        5,
        7,
        7,
    )
    assert (r.lr_xyz, r.lr_log_scale, r.lr_opacity_logit) == (1.6e-4, 5e-3, 5e-2)
    assert (r.lr_sh_dc, r.lr_sh_rest, r.min_radius_m, r.max_radius_m) == (2.5e-3, 5e-4, 0.003, 0.1)
    assert (c.views.rotation_deg, c.views.translation_m, c.final.passes, c.sh_degree) == (
        30,
        0.3,
        0,
        3,
    )
    assert (c.tsdf.average, c.seeding.options["only_with_depth"]) == ("int16", False)
    assert (c.tsdf.colour_band_voxels, c.tsdf.colour_weights, c.tsdf.colour_by_distance) == (
        1.0,
        "equal",
        False,
    )
    rule = SETTINGS_OF_THE_RULE | c.seeding.options
    assert (rule["max_weight"], rule["max_radius_m"], rule["surface"]) == (5.0, 0.01, "tsdf")


SETTINGS_OF_THE_RULE = {field.name: field.default for field in dataclasses.fields(gps_slam_rule)}


def test_the_numbers_of_the_paper():
    """arXiv 2509.11574 v2: sections 3.2 and 4.1, A.1, App. C, Eq. 6 to 8."""
    c = gps_slam("replica", "paper")
    rule = SETTINGS_OF_THE_RULE | c.seeding.options
    assert (rule["colour_error"], rule["max_weight"], rule["share"], rule["most"]) == (
        0.05,
        4.0,
        0.25,
        1.0,
    )
    assert (rule["surface"], rule["max_radius_m"], rule["opacity"], rule["in_holes"]) == (
        "tsdf",
        0.1,
        0.5,
        False,
    )
    s = c.schedule
    r = c.residual
    assert (s.every_frames, s.iterations, s.spread) == (10, 20, False)
    assert (c.views.rotation_deg, c.views.translation_m, c.views.every_frames) == (30, 0.3, 0)
    assert (r.loss, r.min_radius_m, r.max_radius_m) == ("l1", 0.003, 0.1)
    assert (r.lr_xyz, r.lr_sh_dc, r.lr_sh_rest) == (1.6e-4, 2.5e-3, 5e-4)
    assert (r.lr_opacity_logit, r.lr_log_scale, r.adam.lr_quat) == (0.05, 5e-3, 1e-3)
    assert (c.tsdf.voxel_size_m, c.final.passes, c.sh_degree) == (0.005, 0, 3)
    assert gps_slam_fidelity(c) == "paper"


def test_the_numbers_of_the_next_paper():
    c = gps_slam("replica", "rrg")
    rule = SETTINGS_OF_THE_RULE | c.seeding.options
    assert (rule["max_weight"], rule["surface"], rule["max_radius_m"]) == (3.0, "depth", 0.01)
    assert (c.schedule.iterations, c.base.behind_m) == (30, 0.02)
    assert gps_slam_fidelity(c) == "rrg"
    assert GPSSLAM.description.fidelities == ("measured", "paper", "rrg", "code")


def test_a_round_has_its_steps_however_they_are_spread():
    for every, steps in ((10, 20), (7, 20), (10, 3), (1, 5)):
        even = ViewRound(ScheduleConfig(every_frames=every, iterations=steps))
        assert sum(even.steps_in(n) for n in range(3 * every)) == 3 * steps
        burst = ViewRound(ScheduleConfig(every_frames=every, iterations=steps, spread=False))
        assert [burst.steps_in(n) for n in range(2 * every + 1)].count(steps) == (
            2 if every > 1 else 2 * every
        )
        assert burst.steps_in(0) == 0


def test_the_passes_improve_the_map_beyond_the_surface(run):
    before = score(run)
    mapper = run.mapper
    list(mapper.global_optimise(20))
    after = score(run)
    for name in ("psnr_held_out_db", "psnr_mapped_db"):
        assert after[name] > before[name] + 0.3
    frame = run.sequence.mapping[12]
    both = mapper.render(frame.camera, frame.T_WC)
    base = mapper.surface_picture(frame.camera, frame.T_WC).base
    error, base_error = (float((x - frame.rgb).square().mean()) for x in (both.rgb, base.rgb))
    assert len(mapper.gaussians) > 50
    assert error < 0.95 * base_error
    assert torch.equal(both.surface_depth_m, base.depth_m)


def test_each_pass_ends_with_the_removal_of_small_large_and_transparent_rows(run):
    """With the published limits few rows are beyond them; with narrow ones many become so in the
    passes."""
    narrow = mapped(
        30, seeding__options=dict(run.mapper.config.seeding.options), residual__max_radius_m=0.012
    )
    limits = narrow.mapper.config.residual
    mapper = narrow.mapper
    n_before = len(mapper.gaussians)
    list(mapper.global_optimise(3))
    params = mapper.gaussians.params
    radius_m = params.log_scale.amax(dim=1).exp()
    assert 0 < len(mapper.gaussians) < n_before
    assert float(radius_m.max()) <= limits.max_radius_m
    assert float(radius_m.min()) >= limits.min_radius_m
    assert float(params.opacity_logit.sigmoid().min()) >= 0.005


def test_a_keyframe_is_more_than_30_cm_or_30_degrees_away(run):
    mapper = GPSSLAM(gps_slam("room", "code", data__width=0, data__height=0))
    frame = run.sequence.mapping[0]
    mapper.keyframes.append(frame)
    for moved, expected in (
        ([0.299, 0, 0, 0, 0, 0], False),
        ([0, 0.301, 0, 0, 0, 0], True),
        ([0] * 5 + [0.52], False),  # 29.8 degrees
        ([0] * 5 + [0.53], True),
    ):
        T_WC = frame.T_WC @ se3.exp(torch.tensor(moved, dtype=torch.float32))
        assert mapper.is_next_keyframe(dataclasses.replace(frame, T_WC=T_WC)) == expected


@pytest.mark.parametrize(("fidelity", "expected"), [("code", True), ("measured", False)])
def test_as_released_nobody_asks_whether_a_place_was_seen_before(
    run, monkeypatch, fidelity, expected
):
    mapper = GPSSLAM(gps_slam("room", fidelity, data__width=0, data__height=0))
    assert bool(mapper.config.views.every_frames) != expected
    frame = run.sequence.mapping[0]
    mapper.keyframes.append(frame)
    aside = se3.exp(torch.tensor([2.0, 0, 0, 0, 0, 0]))
    monkeypatch.setattr(tsdf_mapping.TsdfMapping, "_seen_before", lambda *_: True)
    far = dataclasses.replace(frame, T_WC=frame.T_WC @ aside)
    assert mapper.is_next_keyframe(far) == expected


def test_rows_that_are_small_large_or_transparent_are_useless():
    """The limits themselves are not beyond the limits."""
    mapper = GPSSLAM(gps_slam("room"))
    limits = mapper.config.residual
    low = limits.min_radius_m
    high = limits.max_radius_m
    scale_m = torch.tensor([0.99 * low, 1.01 * low, 0.99 * high, 1.01 * high, low * 2, low * 2])
    opacity = torch.tensor([0.5, 0.5, 0.5, 0.5, 0.0049, 0.0051])
    x = torch.arange(6.0)
    seeds = Seeds.isotropic(torch.stack([x, x, x], dim=1), torch.full((6, 3), 0.5), scale_m)
    mapper.gaussians.append(dataclasses.replace(seeds, opacity=opacity))
    remove_useless(mapper)
    assert mapper.gaussians.params.xyz_W[:, 0].tolist() == [1.0, 2.0, 5.0]


def test_looking_again_adds_few_keyframes_and_few_gaussians(run, monkeypatch):
    """The same walk back and forth: numbers after the first walk and at the end, and where nothing
    counts as seen."""
    frames = list(run.sequence.mapping)[:24]
    monkeypatch.setattr(tsdf_mapping, "LATEST", 3)

    def sizes() -> list[tuple[int, int]]:
        mapper = make_mapper(run.mapper.config)
        found = []
        for walk in (frames, frames[::-1], frames, frames[::-1]):
            for frame in walk:
                mapper.step(
                    dataclasses.replace(
                        frame, index=mapper.n_frames, timestamp_s=float(mapper.n_frames)
                    )
                )
            found.append((len(mapper.keyframes), len(mapper.gaussians)))
        return [found[0], found[-1]]

    first, last = sizes()
    monkeypatch.setattr(tsdf_mapping, "SEEN_WITHIN_M", -1.0)
    first_without, last_without = sizes()
    assert first == first_without
    assert (first[0], last_without[0]) == (12, 48)
    assert last[0] < 2 * first[0]
    assert last[1] - first[1] < 0.5 * (last_without[1] - first[1])


def test_holes_are_filled_black_or_without_weight():
    rgb = torch.full((8, 12, 3), 0.6)
    depth_m = torch.full((8, 12), 2.0)
    rgb[2:5, 3:7] = 0.0
    depth_m[2:5, 3:7] = 0.0
    hole = depth_m == 0
    views = {
        holes: surface_picture(rgb, depth_m, (8, 12), holes, 0.1)
        for holes in ("filled", "black", "gaussians")
    }
    assert all(torch.equal(view.base.depth_m, depth_m) for view in views.values())
    torch.testing.assert_close(
        views["filled"].base.rgb,
        torch.full((8, 12, 3), 0.6),
    )
    torch.testing.assert_close(views["black"].depth_everywhere_m, torch.full((8, 12), 2.0))
    assert not views["black"].base.rgb[hole].any()
    assert not views["gaussians"].base.weight[hole].any()
    assert views["black"].base.weight.all()
    assert views["gaussians"].base.weight[~hole].all()
    nothing = surface_picture(
        torch.zeros(8, 12, 3),
        torch.zeros(8, 12),
        (8, 12),
        "filled",
        0.1,
    )
    assert not nothing.base.rgb.any()


def test_a_disturbed_pose_is_found_again_though_the_surface_has_no_gradient(run):
    mapper = run.mapper
    frame = run.sequence.mapping[12]
    picture = mapper.render(frame.camera, frame.T_WC).rgb
    for axis in (0, 1, 5):
        xi = torch.zeros(6)
        xi[axis] = 0.01
        fit = fit_pose_by_flow(
            mapper.render,
            frame.camera,
            picture,
            frame.T_WC @ se3.exp(xi),
        )
        assert fit.mse_after < 0.1 * fit.mse_before
        turned, moved = se3.log(se3.inverse(frame.T_WC) @ fit.T_WC).split(3)[::-1]
        assert float((turned**2).sum() + (moved**2).sum()) < float((xi**2).sum())
    still = fit_pose_by_flow(mapper.render, frame.camera, picture, frame.T_WC)
    assert torch.equal(still.T_WC, frame.T_WC)
    with pytest.raises(ValueError, match="steps"):
        fit_pose_by_flow(mapper.render, frame.camera, picture, frame.T_WC, steps=0)
