"""A run says when much of the measured depth is not mapped, once, and with the options that would
map it."""

import dataclasses
from typing import Any

import pytest
import torch

from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam
from gsfusion_nb.data import open_sequence
from gsfusion_nb.data.room import room
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.runs.range_watch import LOOKED_AT, RangeWatch
from gsfusion_nb.runs.run_warnings import RunWarnings

SMALL: dict[str, Any] = {"data__width": 32, "data__height": 24, "data__hold_out_every": 0}


def run_of(config, n_frames=LOOKED_AT + 2):
    """A run of a few small frames, mapped without passes."""
    sequence = open_sequence("room", data=config.data, n_frames=n_frames, width=32, height=24)
    run = MappingRun(sequence, make_mapper(config))
    for _ in run.online():
        pass
    return run


def about_range(run):
    return [sentence for sentence in run.warnings if "where nothing is mapped" in sentence]


NEAR = {
    "gsfusion": gsfusion("room", tsdf__near_m=2.0, tsdf__voxel_size_m=0.08, **SMALL),
    "gps_slam": gps_slam("room", tsdf__near_m=2.0, tsdf__voxel_size_m=0.08, **SMALL),
    "rtg_slam": rtg_slam("room", data__depth_min_m=2.0, **SMALL),
}


@pytest.mark.parametrize("system", NEAR)
def test_near_depth_that_is_not_mapped_is_said_once(system):
    said = about_range(run_of(NEAR[system]))
    assert len(said) == 1
    name = "data.depth_min_m" if system == "rtg_slam" else "tsdf.near_m"
    assert f"of the measured depth is nearer than {name} (2 m)" in said[0]
    assert f"to map it: --{name.replace('_', '-')} " in said[0]


def test_far_depth_that_is_not_mapped_is_said():
    config = gsfusion("room", tsdf__far_m=2.0, tsdf__voxel_size_m=0.08, **SMALL)
    (said,) = about_range(run_of(config))
    assert "farther than tsdf.far_m (2 m)" in said
    assert "--tsdf.far-m " in said


@pytest.mark.parametrize(
    "config",
    [
        gsfusion("room", tsdf__voxel_size_m=0.08, **SMALL),
        gps_slam("room", tsdf__voxel_size_m=0.08, **SMALL),
        rtg_slam("room", **SMALL),
    ],
    ids=NEAR,
)
def test_nothing_is_said_of_a_usual_recording(config):
    assert about_range(run_of(config)) == []


def test_a_run_that_ends_early_is_judged_by_what_it_had():
    assert len(about_range(run_of(NEAR["gsfusion"], n_frames=3))) == 1


@dataclasses.dataclass
class FakeRun:
    """What the watch needs of a run."""

    mapper: object
    steps: list
    warnings: RunWarnings
    sequence: object = None
    resumable: bool = True


def test_a_run_that_goes_on_is_not_judged_by_later_frames():
    frames = room(n_frames=4, width=32, height=24)
    mapper = make_mapper(NEAR["gsfusion"])
    run = FakeRun(mapper, steps=[None] * (LOOKED_AT + 1), warnings=RunWarnings())
    watch = RangeWatch()
    for frame in frames:
        watch.look(run, frame)
        run.steps.append(None)
    watch.look(run, None)
    assert run.warnings == []


def test_of_a_stream_only_depth_within_the_limits_is_known():
    frame = room(n_frames=4, width=32, height=24)[0]
    mapper = make_mapper(NEAR["rtg_slam"])
    run = FakeRun(mapper, steps=[None], warnings=RunWarnings(), resumable=False)
    watch = RangeWatch()
    inside_m = torch.where(frame.depth_m >= 2.0, frame.depth_m, 0.0)
    watch.look(run, dataclasses.replace(frame, depth_m=inside_m))
    watch.look(run, None)
    assert run.warnings == []


@pytest.mark.parametrize(("nearest_m", "is_said"), [(0.0, True), (0.09, False)])
def test_depth_that_is_mapped_but_not_drawn_is_said(nearest_m, is_said):
    """RTG-SLAM maps depth of any distance where no limit is set, and draws it from 0.2 m on."""
    frame = room(n_frames=4, width=32, height=24)[0]
    generator = torch.Generator().manual_seed(0)
    near_m = 0.15 - 0.05 * torch.rand(24, 32, generator=generator).square()
    mapper = make_mapper(rtg_slam("room", data__depth_min_m=nearest_m))
    run = FakeRun(mapper, steps=[None], warnings=RunWarnings(), resumable=False)
    watch = RangeWatch()
    watch.look(run, dataclasses.replace(frame, depth_m=near_m))
    watch.look(run, None)
    said = "100% of the measured depth is nearer than 0.2 m, where no Gaussians are drawn while "
    advice = "data.depth_min_m is 0; to draw them: --data.depth-min-m 0.091"
    assert list(run.warnings) == ([said + advice] if is_said else [])
