"""The states of RTG-SLAM's Gaussians over a run: when they occur, whatever the schedule, and what
is said of them."""

import dataclasses
import html
import json
import re
from typing import Any

import pytest
import torch

from gsfusion_nb.cli.result import print_result
from gsfusion_nb.config import RtgSlamConfig, rtg_slam
from gsfusion_nb.data.room import room
from gsfusion_nb.gaussians import STABLE
from gsfusion_nb.mapping import RTGSLAM, StepReport
from gsfusion_nb.mapping.disc_states import (
    STATES,
    manage_states,
    n_stable,
    state_shares,
    why_never_stable,
)
from gsfusion_nb.runs import report, run_mapping
from gsfusion_nb.types import Camera, Frame, Seeds

SMALL: dict[str, Any] = {"width": 48, "height": 36}


@pytest.fixture(scope="module")
def walk() -> list[Frame]:
    """The first 24 frames of a walk, of 48 x 36."""
    scene = room(n_frames=480, **SMALL)
    return [scene[i] for i in range(24)]


def mapped(config: RtgSlamConfig, frames: list[Frame]) -> list[StepReport]:
    mapper = RTGSLAM(config)
    return [mapper.step(frame) for frame in frames]


def first_with(steps: list[StepReport], *names: str) -> int | None:
    """Index of the first frame after which a Gaussian has one of the states."""
    return next(
        (i for i, step in enumerate(steps) if any(step.counts[name] for name in names)),
        None,
    )


def step(n_gaussians: int, stabilised: int = 0, **counts: int) -> StepReport:
    """A report with these counts of states; the others are 0."""
    states = dict.fromkeys(STATES, 0) | counts | {"stabilised": stabilised}
    return StepReport(
        frame_index=0,
        n_seeds=0,
        n_gaussians=n_gaussians,
        is_keyframe=False,
        losses=(),
        counts=states,
    )


def test_shares_are_means_over_the_frames_that_have_gaussians():
    steps = [
        step(0),
        step(4, unstable_opaque=4),
        step(8, stable_opaque=3, stable_transparent=1, unstable_opaque=2, unstable_transparent=2),
    ]
    assert state_shares(steps) == {
        "share_stable": (0 + 4 / 8) / 2,
        "share_stable_transparent": (0 + 1 / 8) / 2,
        "share_unstable": (1 + 4 / 8) / 2,
        "share_unstable_transparent": (0 + 2 / 8) / 2,
        "share_transparent": (0 + 3 / 8) / 2,
        "share_stable_last": 4 / 8,
    }
    assert state_shares(steps[:1]) == {}


def test_a_run_without_stable_gaussians_says_what_is_missing():
    config = rtg_slam("room", states__stable_confidence=90.0, window__lr_xyz=3e-3)
    unstable = step(5, unstable_opaque=5)
    sentence = why_never_stable([unstable] * 7, config, most_steps=20)
    assert sentence.startswith("RTG-SLAM's stable state never occurred: in 7 frames")
    assert "above states.stable_confidence 90, the highest is 60;" in sentence
    released = step(5, stabilised=1, unstable_opaque=5)  # it was released in the same frame
    assert why_never_stable([unstable, released], config, most_steps=40) == ""
    edited = step(5, stable_opaque=1, unstable_opaque=4)  # a rule set the state
    assert why_never_stable([edited], config, most_steps=0) == ""
    assert why_never_stable([], config, most_steps=0) == ""


def test_stable_and_transparent_gaussians_occur_on_a_short_walk(walk):
    """Windows follow frames 0, 7, 15, 23; the third makes discs stable that were seen in nearly all
    of its steps."""
    steps = mapped(rtg_slam("room"), walk)
    assert first_with(steps, "stable_opaque") == 15
    assert all(n_stable(step) > 0.1 * step.n_gaussians for step in steps[15:])
    transparent = first_with(steps, "stable_transparent", "unstable_transparent")
    assert transparent is not None
    assert 15 < transparent < 20


@pytest.mark.parametrize(("iterations", "lr_xyz"), [(60, 1e-3), (10, 6e-3)])
def test_few_large_steps_are_as_many_small_ones(walk, iterations, lr_xyz):
    schedule = rtg_slam("room", window__iterations=iterations, window__lr_xyz=lr_xyz)
    assert first_with(mapped(schedule, walk[:17]), "stable_opaque") == 15


@pytest.mark.parametrize("fidelity", ["paper", "code"])
def test_the_published_schedule_keeps_its_count_of_steps(walk, fidelity):
    """100 steps to be exceeded: two windows of 50 are not enough."""
    config = rtg_slam("room", fidelity)
    assert config.window.confidence_per_step == 1.0
    assert first_with(mapped(config, walk[:13]), "stable_opaque") == 11


@pytest.mark.parametrize("preset", ["replica", "tum", "scannetpp", "azure"])
@pytest.mark.parametrize("fidelity", ["paper", "code"])
def test_a_published_step_has_confidence_1(preset, fidelity):
    assert rtg_slam(preset, fidelity).window.confidence_per_step == 1.0


@pytest.mark.parametrize(
    ("fidelity", "wall_m", "errors"),
    [
        ("code", 2.5, 1),  # the map is in front of the measurement
        ("code", 1.5, 0),
        ("code", 2.1, 0),  # within 0.2 m
        ("paper", 2.5, 1),
        ("paper", 1.5, 1),
    ],
)
def test_a_wrong_depth_counts_on_one_side_as_released_and_on_both_in_the_paper(
    fidelity, wall_m, errors
):
    """A stable grey disc 2 m away fills the view of a grey wall."""
    mapper = RTGSLAM(rtg_slam("room", fidelity))
    disc = Seeds.isotropic(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.full((1, 3), 0.5),
        torch.ones(1),
        opacity=0.99,
    )
    disc = dataclasses.replace(disc, scale_m=torch.tensor([[9.0, 9.0, 0.001]]))
    mapper.gaussians.append(disc)
    mapper.gaussians.state.fill_(STABLE)
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.full((24, 32, 3), 0.5),
        depth_m=torch.full((24, 32), wall_m),
        camera=Camera(width=32, height=24, fx=30.0, fy=30.0, cx=16.0, cy=12.0),
        T_WC=torch.eye(4),
    )
    manage_states(mapper, frame)
    assert mapper.gaussians.depth_errors.tolist() == [errors]
    assert mapper.gaussians.colour_errors.tolist() == [0]


def test_a_run_says_the_share_of_each_state_or_that_none_was_stable(tmp_path, capsys, monkeypatch):
    drawn = {}
    page_graph = report.page_graph

    def noted(title, x, series, **options):
        drawn[title] = series
        return page_graph(title, x, series, **options)

    monkeypatch.setattr(report, "page_graph", noted)
    few: dict[str, Any] = {
        "window__every_frames": 2,
        "window__iterations": 10,
        "keyframes__iterations": 2,
    }
    few |= {
        "data__stop": 7,
        "data__width": 0,
        "data__height": 0,
        "final__passes": 1,
        "mesh_voxel_m": 0.1,
    }
    for name, limit in (("alive", 40.0), ("dead", 1e6)):
        config = rtg_slam("room", **few, states__stable_confidence=limit)
        run = run_mapping("room", config, folder=tmp_path / name, n_frames=120, **SMALL)
        stored = json.loads((run.folder / "metrics.json").read_text())
        shares = {
            key: value for key, value in stored["metrics"].items() if key.startswith("share_")
        }
        assert shares == state_shares(run.run.steps)
        assert (shares["share_stable"] > 0.1) == (name == "alive")
        assert print_result(run) == 0
        text = capsys.readouterr().out
        page = html.unescape((run.folder / "report.html").read_text())
        assert f"Stable                       {100 * shares['share_stable']:.1f}" in text
        counts = {n.replace("_", " "): [s.counts[n] for s in run.run.steps] for n in STATES}
        assert drawn.pop("States of the Gaussians") == counts
        assert 'alt="Graph: States of the Gaussians"' in page
        for words, share in (("Stable", "stable"), ("Unstable", "unstable")):
            row = re.search(rf"<tr>\s*<t[hd][^>]*>{words}<.*?</tr>", page, re.DOTALL)
            assert row is not None
            assert f"{100 * shares[f'share_{share}']:.1f}" in row[0]
        for said in (text, page, " ".join(stored["warnings"])):
            assert (
                f"RTG-SLAM's stable state never occurred: in {len(run.run.steps)} frames" in said
            ) == (name == "dead")
