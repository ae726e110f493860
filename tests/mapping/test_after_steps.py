"""Rules that edit the map after gradient steps: what they are told, what an error undoes; nothing
else changes."""

import copy
import signal
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch

from gsfusion_nb.config import gps_slam, gsfusion, replace, rtg_slam
from gsfusion_nb.data.room import room
from gsfusion_nb.mapping import FrameUndone, make_mapper
from gsfusion_nb.mapping import rtg_slam as rtg_slam_module
from gsfusion_nb.render import footprints
from gsfusion_nb.seeding import (
    Edit,
    MapRule,
    SeedContext,
    StepStats,
    abs_image_gradient,
    image_gradient,
    restart_statistics,
    times_visible,
)

SYSTEMS = ["gsfusion", "rtg_slam", "gps_slam"]


@pytest.fixture(scope="module")
def frames() -> list[Any]:
    view = room(n_frames=120, width=32, height=24)
    return [view[i] for i in range(0, 10, 2)]


def settings(system: str, **more: Any) -> Any:
    if system == "gsfusion":
        optim = {
            "optim__frame_iterations": 2,
            "optim__keyframe_iterations": 3,
            "optim__random_keyframe_iterations": 1,
        }
        tsdf = {"tsdf__voxel_size_m": 0.08, "tsdf__truncation_voxels": 3.0}
        return gsfusion("replica", sh_degree=1, keyframe_every=2, **optim, **tsdf, **more)
    if system == "gps_slam":
        schedule = {"every_frames": 2, "window_every": 2, "iterations": 6}
        tsdf = {"voxel_size_m": 0.08, "truncation_voxels": 3.0}
        return gps_slam("replica", sh_degree=1, schedule=schedule, tsdf=tsdf, **more)
    small = {
        "window__every_frames": 2,
        "window__iterations": 4,
        "keyframes__iterations": 3,
        "sh_degree": 1,
    }
    return replace(rtg_slam("room", data__width=0, data__height=0), **small, **more)


@dataclass(frozen=True, kw_only=True)
class Base(MapRule):
    """Seeds a fifth of the pixels of the new ground."""

    def seeds(self, ctx, memory):
        seeds = ctx.seeds_at(ctx.pixels()[:: 5 + ctx.frame_number], 1.0)
        return seeds if ctx.frame_number < 3 else seeds[:20]


def editing(broken: dict[str, int]) -> type[MapRule]:
    """A rule that uses every kind of edit, random numbers, its memory and numbers for each row; it
    raises at the call whose number is in ``broken``."""

    @dataclass(frozen=True, kw_only=True)
    class edits_all(Base):
        needs: ClassVar[frozenset[str]] = frozenset({"visibility", "image_gradients"})

        def after_step(
            self, ctx: SeedContext, stats: StepStats, memory: dict[str, Any]
        ) -> Edit | None:
            memory["calls"] = memory.get("calls", 0) + 1
            ctx.gaussians.row_memory("seen").add_(stats.visible)
            n = len(ctx.map)
            drawn = torch.rand(len(ctx.map), generator=ctx.generator)
            memory["drawn"] = drawn[:3]
            if memory["calls"] == broken.get("at"):
                raise RuntimeError("my rule is broken")
            rows = drawn.argsort()
            return Edit(
                rates={"xyz_W": (drawn > 0.1).float()},
                set={"xyz_W": (rows[:2], ctx.map.xyz_W[rows[:2]] + 0.01)},
                reset_opacity=0.9,
                relocate=(rows[2:4], rows[4:6]),
                clone=rows[6:8],
                split=rows[8:9],
                add=ctx.seeds_at(ctx.pixels()[:1], 1.0),
                keep=~torch.isin(torch.arange(n), rows[9:13]),
            )

    return edits_all


def state_of(mapper: Any) -> dict[str, Any]:
    """Everything but which of two equal rules it has, which differ in a number that they refer
    to."""
    state = copy.deepcopy(mapper.state_dict())
    return state | {"rule": {"memory": state["rule"]["memory"]}}


@pytest.mark.parametrize("system", SYSTEMS)
def test_an_error_after_a_step_undoes_the_frame_and_it_can_be_given_again(system, frames, same):
    """In the second call of a frame in the middle: what the first call did to the map is undone,
    too."""
    calls = {}
    counted = make_mapper(settings(system), seeding=editing(calls))
    per_frame = []
    for frame in frames:
        counted.step(frame)
        per_frame.append(counted.rule_in_use.memory.get("calls", 0))
    two = next(i for i in range(1, len(frames)) if per_frame[i] >= per_frame[i - 1] + 2)
    calls["at"] = per_frame[two - 1] + 2
    mapper = make_mapper(settings(system), seeding=editing(calls))
    for frame in frames[:two]:
        mapper.step(frame)
    before = state_of(mapper)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="my rule is broken"):
            mapper.step(frames[two])
        same(before, state_of(mapper))
    calls["at"] = 0
    for frame in frames[two:]:
        mapper.step(frame)
    same(state_of(counted), state_of(mapper))
    for _ in zip(mapper.global_optimise(1), range(3), strict=False):
        pass
    assert mapper.rule_in_use.memory["calls"] > per_frame[-1]


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_resumed_run_goes_on_as_if_it_had_not_stopped(system, frames, same):
    rule = editing({})
    whole, part = (make_mapper(settings(system), seeding=rule) for _ in range(2))
    for mapper, some in ((whole, frames), (part, frames[:3])):
        for frame in some:
            mapper.step(frame)
    again = type(part).from_state_dict(part.state_dict(), seeding=rule)
    for frame in frames[3:]:
        again.step(frame)
    same(state_of(whole), state_of(again))
    for mapper in (whole, again):
        for _ in zip(mapper.global_optimise(1), range(2), strict=False):
            pass
    resumed = type(part).from_state_dict(whole.state_dict(), seeding=rule)
    for mapper in (again, resumed):
        list(mapper.global_optimise(1))
    same(state_of(again), state_of(resumed))


@pytest.mark.parametrize(
    "needs",
    [
        (),
        ("visibility",),
        ("image_gradients",),
        ("abs_image_gradients", "image_gradients"),
        ("visibility", "render"),
    ],
)
@pytest.mark.parametrize("system", SYSTEMS)
def test_what_a_rule_is_told_and_that_asking_changes_nothing(system, needs, frames, same):
    told: list[Any] = []
    now = []

    @dataclass(frozen=True, kw_only=True)
    class listening(Base):
        def after_step(self, ctx, stats, memory):
            told.append(stats)
            now.append((ctx.frame.index, len(ctx.map)))

    listening.needs = frozenset(needs)
    mapper, deaf = (make_mapper(settings(system), seeding=rule) for rule in (listening, Base))
    for frame in frames[:3]:
        mapper.step(frame)
        deaf.step(frame)
    online = len(told)
    optimised = [step.loss for step in mapper.global_optimise(1)]
    list(deaf.global_optimise(1))
    same(deaf.files.maps(), mapper.files.maps())
    assert {stats.stage for stats in told[:online]} == {"online"}
    assert {(s.stage, s.step_in_frame, s.steps_in_frame) for s in told[online:]} == {
        ("passes", 1, 1)
    }
    assert [float(s.loss) for s in told[online:]] == optimised
    numbers = [stats.step for stats in told]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == mapper.after_steps.n_steps
    assert all(s.step_in_frame <= s.steps_in_frame for s in told)
    for told_of, (_, n) in zip(told, now, strict=True):
        stats: Any = told_of
        camera = stats.camera
        assert stats.target.shape == (camera.height, camera.width, 3)
        assert (
            (stats.visible is not None)
            == (stats.radius_px is not None)
            == bool({*needs} & {"visibility", "image_gradients"})
        )
        assert (stats.v_uv is not None) == ("image_gradients" in needs)
        assert (stats.v_uv_abs is not None) == ("abs_image_gradients" in needs)
        assert (stats.rgb is not None) == ("render" in needs)
        if stats.visible is not None:
            assert stats.visible.shape == stats.radius_px.shape == (n,)
            assert stats.visible.any()
            assert torch.equal(stats.visible, stats.radius_px > 0)
        if stats.v_uv is not None:
            assert stats.v_uv.shape == (n, 2)
            assert stats.v_uv.any()
            assert stats.visible is None or not stats.v_uv[~stats.visible].any()
        if stats.v_uv is not None and stats.v_uv_abs is not None:
            assert (stats.v_uv_abs >= 0.999 * stats.v_uv.abs()).all()
            assert torch.equal(stats.v_uv_abs.any(dim=1), stats.v_uv.any(dim=1))
            assert stats.v_uv_abs.sum() > 1.2 * stats.v_uv.abs().sum()
    if "render" in needs:
        first = told[0]
        error = (first.rgb - first.target).abs().mean()
        assert float(error) < 0.5
    assert (times_visible(mapper.gaussians) is not None) == bool({*needs} - {"render"})


def test_statistics_of_each_row_are_sums_over_the_steps(frames):
    told: list[Any] = []

    @dataclass(frozen=True, kw_only=True)
    class listening(Base):
        needs: ClassVar[frozenset[str]] = frozenset({"image_gradients", "abs_image_gradients"})

        def after_step(self, ctx, stats, memory):
            told.append(stats)

    mapper = make_mapper(settings("gsfusion"), seeding=listening)
    mapper.step(frames[0])
    model = mapper.gaussians
    half = torch.tensor([16.0, 12.0])
    times = torch.stack([s.visible for s in told]).sum(0).float()
    length = torch.stack([(s.v_uv * half).norm(dim=1) for s in told]).sum(0) / times.clamp_min(1)
    assert torch.equal(model.memory["times_visible"], times)
    torch.testing.assert_close(image_gradient(model), length)
    abs_length = torch.stack([(s.v_uv_abs * half).norm(dim=1) for s in told]).sum(
        0
    ) / times.clamp_min(1)
    torch.testing.assert_close(abs_image_gradient(model), abs_length)
    context = mapper.seed_context(frames[1])
    assert torch.equal(context.map.times_visible, times)
    torch.testing.assert_close(context.map.image_gradient, length)
    torch.testing.assert_close(context.map.abs_image_gradient, abs_length)
    seen = footprints(model.params, frames[0].camera, frames[0].T_WC)
    assert float((seen.visible == told[-1].visible).float().mean()) > 0.95
    restart_statistics(model)
    assert not any(
        model.memory[name].any()
        for name in ("times_visible", "image_gradient", "abs_image_gradient")
    )


def stop_in(monkeypatch: pytest.MonkeyPatch, mapper: Any, at: int, act: Any) -> None:
    """Call ``act`` at the ``at``-th look for a stop."""
    looks = []
    may_stop = mapper.guard.may_stop

    def watched():
        looks.append(0)
        if len(looks) == at:
            act()
        may_stop()

    monkeypatch.setattr(mapper.guard, "may_stop", watched)


@pytest.mark.parametrize("at", [1, 3, 5, 8])
@pytest.mark.parametrize("kind", ["stop", "Ctrl-C"])
def test_between_two_gradient_steps_a_frame_can_be_given_up(frames, monkeypatch, at, kind, same):
    """Also after the window was written back, while keyframes are optimised."""
    monkeypatch.setattr(rtg_slam_module, "KEYFRAME_DEG", 0.1)
    mapper, whole = (make_mapper(settings("rtg_slam")) for _ in range(2))
    for frame in frames:
        whole.step(frame)
    for frame in frames[:3]:
        mapper.step(frame)
    before = copy.deepcopy(mapper.state_dict())
    with monkeypatch.context() as patch:
        if kind == "stop":
            stop_in(
                patch, mapper, at, lambda: patch.setattr(mapper.guard, "stop_wanted", lambda: True)
            )
        else:
            stop_in(patch, mapper, at, lambda: signal.raise_signal(signal.SIGINT))
        with pytest.raises(FrameUndone if kind == "stop" else KeyboardInterrupt):
            mapper.step(frames[3])
    same(before, mapper.state_dict())
    for frame in frames[3:]:
        mapper.step(frame)
    same(whole.state_dict(), mapper.state_dict())
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
