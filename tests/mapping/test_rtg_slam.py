"""The RTG-SLAM mapper on the first frames of a slow walk through the room, and on made-up
frames."""

import copy
import dataclasses
import math
from typing import Any

import pytest
import torch

from gsfusion_nb.config import RtgSlamConfig, replace, rtg_slam
from gsfusion_nb.data.room import room, room_sdf
from gsfusion_nb.evaluation import psnr
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import RTGSLAM, StepReport, disc_files, disc_optimisation
from gsfusion_nb.mapping import rtg_slam as rtg_slam_module
from gsfusion_nb.mapping.disc_optimisation import worst_tiles
from gsfusion_nb.tsdf import integrate
from gsfusion_nb.types import Frame

QUICK = {"window__iterations": 8, "keyframes__iterations": 4, "sh_degree": 1}
STABLE_AFTER = {"measured": 36.0, "paper": 12.0, "code": 12.0}
"""Confidence of twelve steps."""


@pytest.fixture(scope="session")
def walk() -> list[Frame]:
    """Twenty frames of 160 x 120, as in a video."""
    scene = room(n_frames=240, width=160, height=120)
    return [scene[i] for i in range(20)]


@pytest.fixture(scope="session")
def small_walk() -> list[Frame]:
    """Fourteen frames of 80 x 60 of the same."""
    scene = room(n_frames=240, width=80, height=60)
    return [scene[i] for i in range(14)]


@pytest.fixture(scope="session")
def mapped(walk) -> tuple[RTGSLAM, list[StepReport]]:
    """A map of the walk, not to be changed."""
    mapper = RTGSLAM(rtg_slam("room"))
    return mapper, [mapper.step(frame) for frame in walk]


def run(
    frames: list[Frame], config: RtgSlamConfig, **options: Any
) -> tuple[RTGSLAM, list[StepReport]]:
    mapper = RTGSLAM(config, **options)
    return mapper, [mapper.step(frame) for frame in frames]


def quick(fidelity: str = "measured", **overrides: Any) -> RtgSlamConfig:
    return rtg_slam(
        "room",
        fidelity,
        **QUICK | {"states__stable_confidence": STABLE_AFTER[fidelity]} | overrides,
    )


def rows(mapper: RTGSLAM) -> dict[str, torch.Tensor]:
    return mapper.gaussians.columns.snapshot()


def assert_same_map(a: RTGSLAM, b: RTGSLAM) -> None:
    ours = rows(a)
    theirs = rows(b)
    assert len(a.gaussians) == len(b.gaussians) > 0
    for name in ours:
        assert torch.equal(ours[name], theirs[name]), name


def test_the_map_shows_what_was_seen(mapped, walk):
    mapper, reports = mapped
    scores = [float(psnr(mapper.render(f.camera, f.T_WC).rgb, f.rgb)) for f in walk]
    assert sum(scores) / len(scores) > 19
    optimised = [r for r in reports[1:] if r.losses]
    assert all(r.psnr_after_db > r.psnr_before_db for r in optimised)
    for report in reports:
        if report.losses:
            assert sum(report.losses[-5:]) < sum(report.losses[:5])
    assert math.isnan(reports[0].psnr_before_db)
    assert reports[0].psnr_after_db > 20


def test_a_long_walk_has_as_many_views_in_the_mesh_as_it_needs(mapped, walk, monkeypatch):
    mapper, _ = mapped
    all_views = mapper.mesh()
    assert mapper.mesh_share == 1.0
    fused = []
    monkeypatch.setattr(disc_files, "MESH_VIEWS", 1)  # as if the walk were 60 times as long
    monkeypatch.setattr(disc_files, "integrate", lambda *given: fused.append(integrate(*given)))
    few_views = mapper.mesh()
    assert 2 <= len(fused) < len(walk) / 2  # by its number alone it would be one
    assert mapper.mesh_share > 0.95
    assert len(few_views.faces) > 0.9 * len(all_views.faces)


def test_the_surface_is_where_the_walls_are(mapped, walk):
    mapper, _ = mapped
    frame = walk[12]
    view = mapper.surface(frame.camera, frame.T_WC)
    both = (view.depth_m > 0) & (frame.depth_m > 0)
    assert both.float().mean() > 0.75  # the rest hits no disc
    error = (view.depth_m - frame.depth_m)[both].abs()
    assert float(error.median()) < 0.01
    out = mapper.render(frame.camera, frame.T_WC)
    assert torch.equal(out.surface_depth_m, view.depth_m)
    mesh = mapper.mesh()
    distance = room_sdf(mesh.vertices_W).abs()
    assert len(mesh.faces) > 1000
    assert float(distance.mean()) < 0.02
    assert float(distance.median()) < 0.01


def test_what_a_step_reports(mapped):
    mapper, reports = mapped
    config = mapper.config
    assert [r.frame_index for r in reports] == list(range(20))
    due = [i == 0 or (i + 1) % config.window.every_frames == 0 for i in range(20)]
    assert [bool(r.losses) for r in reports] == due
    assert {len(r.losses) for r in reports if r.losses} == {config.window.iterations}
    total = 0
    for report in reports:
        counts = report.counts
        total += report.n_seeds - counts["expired"] - counts["oversized"]
        if config.states.on_error == "delete":
            total -= counts["released"]
        assert report.n_gaussians == total
        names = ("stable_opaque", "stable_transparent", "unstable_opaque", "unstable_transparent")
        assert sum(counts[name] for name in names) == total
        assert set(report.seconds) == {"tracking", "seeding", "optimise", "keyframes", "states"}
    assert len(mapper.gaussians) == total
    assert sum(r.is_keyframe for r in reports) == len(mapper.keyframes) > 1
    assert reports[0].is_keyframe
    assert mapper.n_frames == mapper.gaussians.clock.count == 20
    assert len(mapper.window) == config.window.frames
    assert [f.index for f in mapper.window][-1] == 19


def optimised_frames(config: RtgSlamConfig, frames: list[Frame]) -> list[int]:
    return [i for i, r in enumerate(run(frames, config)[1]) if r.losses]


@pytest.mark.parametrize(
    ("moved_m", "turned_deg", "expected"),
    [
        (0.299, 0.0, False),
        (0.301, 0.0, True),
        (0.0, 29.9, False),
        (0.0, 30.1, True),
        (0.29, 29, False),
    ],
)
def test_a_keyframe_is_30_cm_or_30_degrees_away(small_walk, moved_m, turned_deg, expected):
    mapper = RTGSLAM(quick())
    first = small_walk[0]
    assert mapper.is_next_keyframe(first)
    mapper.keyframes.append(first)
    motion = torch.tensor([0.0, moved_m, 0.0, 0.0, 0.0, math.radians(turned_deg)])
    T_WC = first.T_WC @ se3.exp(motion)
    assert mapper.is_next_keyframe(dataclasses.replace(first, T_WC=T_WC)) == expected


def test_a_keyframe_may_take_the_place_of_the_window(small_walk, monkeypatch):
    """Released code; but not while nothing is stable, which a keyframe there needs."""
    monkeypatch.setattr(rtg_slam_module, "KEYFRAME_M", 0.001)
    every: Any = {"window__every_frames": 2, "window__iterations": 7}
    assert optimised_frames(quick(**every), small_walk[:6]) == [0, 1, 3, 5]
    replaced = quick(**every, keyframes__instead_of_window=True)
    assert optimised_frames(replaced, small_walk[:6]) == [
        0,
        1,
    ]  # 14 steps > 12: stable after frame 1
    slow = replace(replaced, states__stable_confidence=1000.0)
    assert optimised_frames(slow, small_walk[:6]) == [0, 1, 3, 5]


def test_the_worst_tiles_are_those_with_the_largest_means():
    error = torch.full((20, 40), 0.5)
    error[3, 5] = 20.0  # mean of its tile of 8x8: 0.80
    error[8:16, 8:16] = 0.7
    error[16:, 32:] = 0.9  # a smaller tile at the border
    error[0:8, 32:40] = 0.6
    expected = torch.zeros_like(error, dtype=torch.bool)
    for y, x in ((0, 0), (8, 8), (16, 32)):
        expected[y : y + 8, x : x + 8] = True
    assert torch.equal(worst_tiles(error, share=0.2, tile_px=8), expected)  # 3 of 15 tiles
    assert int(worst_tiles(error, share=1e-6, tile_px=8).sum()) == 4 * 8
    assert worst_tiles(error, share=1.0).all()


@pytest.mark.parametrize(("fidelity", "worst"), [("paper", "pixels"), ("code", "tiles")])
def test_a_keyframe_counts_where_paper_and_code_say(small_walk, fidelity, worst):
    mapper, _ = run(small_walk, quick())
    config = rtg_slam(fidelity=fidelity).keyframes
    assert config.worst == worst
    mapper.config = dataclasses.replace(mapper.config, keyframes=config)
    keyframe = mapper.keyframes[0]
    view = disc_optimisation._worst_pixels(mapper, keyframe)
    error = (mapper.surface(keyframe.camera, keyframe.T_WC).rgb - keyframe.rgb).abs().mean(dim=-1)
    limit = error.flatten().quantile(0.6)
    has_loss = view.pixels
    assert float(has_loss.float().mean()) == pytest.approx(0.4, abs=0.1)
    assert bool((has_loss == (error >= limit)).all()) == (worst == "pixels")


def test_the_end_of_a_scan(small_walk):
    mapper, _ = run(small_walk, quick())
    keyframes = list(mapper.keyframes)
    centres = mapper.gaussians.params.xyz_W.clone()

    def quality() -> float:
        return sum(
            float(psnr(mapper.render(k.camera, k.T_WC).rgb, k.rgb)) for k in keyframes
        ) / len(keyframes)

    before = quality()
    steps = list(mapper.global_optimise(4))
    assert len(steps) == steps[-1].n_steps == 4 * len(keyframes)
    assert mapper.passes.done == 4
    assert quality() > before + 0.3
    assert torch.equal(mapper.gaussians.params.xyz_W, centres)
    assert mapper.gaussians.is_stable.all()


@pytest.mark.parametrize("poses", ["given", "tracked"])
def test_state_goes_on_where_it_was(small_walk, poses, monkeypatch):
    monkeypatch.setattr(rtg_slam_module, "KEYFRAME_M", 0.05)
    config = quick("code", tracking__poses=poses)
    whole, _ = run(small_walk[:9], config)
    parted, _ = run(small_walk[:5], config)
    state = parted.state_dict()
    parted.step(small_walk[5])  # what was saved stays as it was
    resumed = RTGSLAM.from_state_dict(state)
    assert resumed.n_frames == 5
    for frame in small_walk[5:9]:
        resumed.step(frame)
    assert_same_map(whole, resumed)
    assert torch.equal(torch.stack(whole.trajectory.poses), torch.stack(resumed.trajectory.poses))
    assert len(whole.keyframes) == len(resumed.keyframes)
    torch.testing.assert_close(whole.mesh().vertices_W, resumed.mesh().vertices_W)


@pytest.mark.parametrize("fidelity", ["paper", "code"])
def test_the_end_of_a_scan_goes_on_where_it_was(small_walk, fidelity, monkeypatch):
    monkeypatch.setattr(rtg_slam_module, "KEYFRAME_M", 0.05)
    config = quick(fidelity, seeding__options={"share": 0.2, "fidelity": fidelity})
    whole, parted = (run(small_walk[:9], config)[0] for _ in range(2))
    assert whole.gaussians.is_transparent.any()
    n = len(whole.keyframes)
    assert n > 2
    list(whole.global_optimise(3))
    for step in parted.global_optimise(3):
        if step.step == n + 2:
            break
    resumed = RTGSLAM.from_state_dict(copy.deepcopy(parted.state_dict()))
    list(resumed.global_optimise(3 - resumed.passes.done))
    assert resumed.passes.done == 3
    assert_same_map(whole, resumed)
