"""A frame is mapped as a whole or not at all, and only if it can be mapped."""

import copy
import dataclasses
import signal
from typing import Any

import pytest
import torch

from gsfusion_nb.config import gps_slam, replace, rtg_slam
from gsfusion_nb.data import BadFrameError, apply_options
from gsfusion_nb.large_maps import boxes as row_boxes
from gsfusion_nb.mapping import (
    GPSSLAM,
    RTGSLAM,
    FrameUndone,
    GSFusion,
    HalfMappedError,
    make_mapper,
)
from gsfusion_nb.mapping.check_frame import BLACK, check_frame
from gsfusion_nb.mapping.frame_guard import FrameGuard
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.seeding import SeedContext
from gsfusion_nb.tsdf import FusedView, TsdfVolume
from gsfusion_nb.types import Camera, Frame, Seeds

SYSTEMS = ["gsfusion", "rtg_slam", "gps_slam"]
POSES = ["given", "tracked"]


class Breaking:
    """A rule that draws a random number and then raises, until it is repaired."""

    def __init__(self, at: int):
        self.at = at
        self.broken = True

    def rule(self):
        def breaking(ctx: SeedContext) -> Seeds:
            torch.rand(3, generator=ctx.generator)
            if self.broken and ctx.frame.index >= self.at:
                raise RuntimeError("my rule is broken")
            seeds = ctx.cells()
            return seeds if ctx.volume is None else seeds[ctx.voxel_weight(seeds.xyz_W) == 1]

        return breaking


def settings(system, config, poses="given"):
    if system == "gsfusion":
        return replace(config, tracking__poses=poses, tracking__back_end=False)
    data = {"width": 0, "height": 0, "hold_out_every": 0, "stop": 8}
    tracking = {"poses": poses, "back_end": False}
    if system == "gps_slam":
        schedule = {"every_frames": 2, "window_every": 2, "iterations": 4}
        return gps_slam(
            "room", data=data, tracking=tracking, schedule=schedule, tsdf__voxel_size_m=0.04
        )
    return rtg_slam("room", data=data, tracking=tracking)


def maps_of(mapper) -> dict[str, Any]:
    """The state of a mapper but for its rule, of which there are two here."""
    return {name: value for name, value in mapper.state_dict().items() if name != "rule"}


@pytest.mark.parametrize("poses", POSES)
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_rule_that_fails_changes_nothing_and_the_frame_can_be_given_again(
    system, poses, small_room, config, same
):
    config = settings(system, config, poses)
    frames = list(apply_options(small_room, config.data).mapping)[:6]
    rules = [Breaking(at=frames[3].index), Breaking(at=10**6)]
    mapper, never = (make_mapper(config, seeding=rule.rule()) for rule in rules)
    for frame in frames[:3]:
        mapper.step(frame)
    before = copy.deepcopy(mapper.state_dict())
    for _ in range(2):
        with pytest.raises(RuntimeError, match="my rule is broken"):
            mapper.step(frames[3])
        same(before, mapper.state_dict())
    rules[0].broken = False
    for frame in frames[3:]:
        mapper.step(frame)
    for frame in frames:
        never.step(frame)
    same(maps_of(never), maps_of(mapper))


@pytest.mark.parametrize("whole_below", [0, 10**9])
@pytest.mark.parametrize("system", ["rtg_slam", "gps_slam"])
def test_a_frame_that_is_stopped_at_any_step_leaves_the_map_as_it_was(
    small_room, config, system, whole_below, same, monkeypatch
):
    monkeypatch.setattr(row_boxes, "WHOLE_BELOW", whole_below)
    config = settings(system, config)
    if system == "gps_slam":  # so few pictures would get no Gaussians
        config = replace(config, seeding__rule="uniform", seeding__options={})
    frames = list(apply_options(small_room, config.data).mapping)[:6]
    mapper = make_mapper(config)
    never = make_mapper(config)
    n_stops = 0
    for frame in frames:
        before = copy.deepcopy(mapper.state_dict())
        for wanted_at in range(0, 200, 1 if system == "gps_slam" else 8):
            asked = iter(range(wanted_at))
            mapper.guard.stop_wanted = lambda asked=asked: next(asked, None) is None
            try:
                mapper.step(frame)
                break
            except FrameUndone:
                n_stops += 1
                same(before, mapper.state_dict())
        never.step(frame)
    assert n_stops > 5
    same(maps_of(never), maps_of(mapper))


def test_the_view_before_fusing_finds_what_is_there_after(small_room, config, generator):
    """On every backend: at the seeds of a frame, and at random places around."""
    volume = TsdfVolume(config.tsdf)
    from gsfusion_nb.tsdf import band_blocks, fuse_frame_

    for i in range(6):
        frame = small_room[i]
        points = SeedContext(frame).cells().xyz_W
        around = points[torch.randint(len(points), (3000,), generator=generator)]
        points = torch.cat([points, around + 0.3 * torch.randn(3000, 3, generator=generator)])
        missing = volume.reserve(volume.index.missing(band_blocks(volume, frame)))
        expected = FusedView(volume, frame, missing).sample_nearest(points)
        volume.allocate_missing(missing)
        fuse_frame_(volume, frame)
        found = volume.sample_nearest(points)
        assert torch.equal(expected.W, found.W)
        torch.testing.assert_close(expected.D, found.D, atol=1e-5, rtol=0)
        torch.testing.assert_close(expected.rgb, found.rgb, atol=1e-5, rtol=0)


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_map_with_half_a_frame_takes_no_more(system, small_room, config, monkeypatch):
    mapper: Any = {"gsfusion": GSFusion, "rtg_slam": RTGSLAM, "gps_slam": GPSSLAM}[system](
        settings(system, config)
    )
    mapper.step(small_room[0])

    def full(*_):
        raise MemoryError("no room")

    monkeypatch.setattr(mapper.localiser, "record", full)
    with pytest.raises(MemoryError, match="no room"):
        mapper.step(small_room[1])
    monkeypatch.undo()
    with pytest.raises(
        HalfMappedError, match=r"frame 1 was only half mapped \(MemoryError: no room\)"
    ):
        mapper.step(small_room[1])


def test_ctrl_c_while_the_map_changes_waits_until_the_frame_is_counted(
    small_room, config, monkeypatch, same
):
    run = MappingRun(apply_options(small_room, config.data), GSFusion(config))
    step = GSFusion._optimise_online

    def pressed(self, context, *plan):
        if self.n_frames == 2:
            signal.raise_signal(signal.SIGINT)
        return step(self, context, *plan)

    monkeypatch.setattr(GSFusion, "_optimise_online", pressed)
    with pytest.raises(KeyboardInterrupt):
        list(run.online())
    assert run.mapper.n_frames == len(run.steps) == run.next_position == 3
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.undo()
    list(run.online())
    whole = MappingRun(apply_options(small_room, config.data), GSFusion(config))
    list(whole.online())
    same(maps_of(whole.mapper), maps_of(run.mapper))


GOOD = Frame(
    index=7,
    timestamp_s=0.0,
    rgb=torch.full((3, 4, 3), 0.5),
    depth_m=torch.ones(3, 4),
    camera=Camera(width=4, height=3, fx=4.0, fy=4.0, cx=2.0, cy=1.5),
    T_WC=torch.eye(4),
)


def shifted(metres: float) -> torch.Tensor:
    T = torch.eye(4)
    T[1, 3] = metres
    return T


def test_a_good_frame_comes_back():
    assert check_frame(GOOD, needs_depth=True) is GOOD
    blind = dataclasses.replace(GOOD, depth_m=torch.zeros(3, 4))
    assert check_frame(blind) is blind
    dim = dataclasses.replace(GOOD, rgb=torch.full((3, 4, 3), 1.5 * BLACK))
    assert check_frame(dim) is dim


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"T_WC": torch.diag(torch.tensor([-1.0, 1, 1, 1]))},
            "T_WC of frame 7 must be rigid: .* mirrors the world",
        ),
        ({"T_WC": torch.full((4, 4), torch.nan)}, "T_WC of frame 7 must be finite"),
        (
            {"T_WC": shifted(1e6)},
            r"T_WC of frame 7 must be within 10 km of the origin, got \(0, 1e\+06, 0\) m",
        ),
        ({"T_WC": shifted(1e30)}, "T_WC of frame 7 must be within 10 km of the origin"),
        (
            {"camera": dataclasses.replace(GOOD.camera, fx=1e12)},
            "its camera: fx must be between 0.2 and 400",
        ),
        (
            {"camera": dataclasses.replace(GOOD.camera, cx=-500.0)},
            "its camera: cx must be between -4 and 8",
        ),
        ({"depth_m": torch.full((3, 4), torch.inf)}, "depth_m of frame 7 must be finite"),
        ({"rgb": torch.full((3, 4, 3), torch.nan)}, "rgb of frame 7 must be finite"),
        ({"rgb": torch.full((3, 4, 3), 128.0)}, r"rgb of frame 7 must be in 0\.\.1, got 128"),
        ({"rgb": torch.zeros(3, 4, 3)}, "its picture is black"),
        ({"depth_m": torch.zeros(3, 4)}, "it has no depth at all"),
    ],
)
def test_a_bad_frame_is_refused(change, message):
    with pytest.raises(BadFrameError, match=f"frame 7 cannot be mapped: .*{message}"):
        check_frame(dataclasses.replace(GOOD, **change), needs_depth=True)


def mapped(guard: FrameGuard, index: int, *calls: Any) -> None:
    """The step of a mapper that makes these calls."""
    with guard.while_mapping(index):
        for call in calls:
            call()


def fails(error: Exception) -> Any:
    def call():
        raise error

    return call


def test_one_frame_at_a_time():
    guard = FrameGuard()
    sentence = "frame 5 was given while another thread maps frame 4; give one frame at a time"
    with guard.while_mapping(4), pytest.raises(RuntimeError, match=sentence):
        mapped(guard, 5)
    mapped(guard, 5)


def test_what_fails_before_the_changes_leaves_the_guard_open():
    guard = FrameGuard()
    with pytest.raises(KeyError, match="rule"):
        mapped(guard, 1, fails(KeyError("rule")))
    assert guard.half_mapped == ""
    with pytest.raises(MemoryError, match="no room"):
        mapped(guard, 2, guard.changes_begin, fails(MemoryError("no room")))
    with pytest.raises(
        HalfMappedError,
        match=r"frame 2 was only half mapped \(MemoryError: no room\); this map takes",
    ):
        mapped(guard, 3)


def test_a_frame_is_undone_once_and_only_until_its_changes_stay():
    guard = FrameGuard()
    done = []

    def begin():
        guard.changes_begin(lambda: done.append("undone"))

    def stop():
        try:
            guard.may_stop()
        except FrameUndone:
            done.append(guard.undo())
            raise

    guard.stop_wanted = lambda: True
    with pytest.raises(FrameUndone):
        mapped(guard, 1, stop, begin, stop)  # at first there is nothing to undo
    assert done == ["undone", True]
    assert guard.half_mapped == ""
    mapped(
        guard,
        2,
        begin,
        guard.changes_stay,
        stop,
        lambda: done.append(guard.undo()),
    )
    mapped(guard, 3, lambda: done.append(guard.undo()))  # nothing has changed
    assert done == ["undone", True, False, True]


def test_a_signal_waits_for_the_end_of_the_changes_or_for_a_place_to_stop():
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append("now"))
    try:
        guard = FrameGuard()
        with guard.while_mapping(1):
            signal.raise_signal(signal.SIGINT)
            assert heard == ["now"]  # nothing is changed yet
            guard.changes_begin()
            signal.raise_signal(signal.SIGINT)
            guard.may_stop()  # cannot be undone
            assert heard == ["now"]
        assert heard == ["now"] * 2
        with guard.while_mapping(2):
            guard.changes_begin(lambda: None)
            signal.raise_signal(signal.SIGINT)
            assert heard == ["now"] * 2
            guard.may_stop()
            assert heard == ["now"] * 3
        assert heard == ["now"] * 3
        signal.raise_signal(signal.SIGINT)
        assert heard == ["now"] * 4
    finally:
        signal.signal(signal.SIGINT, before)
