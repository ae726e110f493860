"""Each transition on a handful of rows; what is not named stays as it was."""

import dataclasses

import pytest
import torch

from gsfusion_nb.config import StateConfig
from gsfusion_nb.gaussians import STABLE, UNSTABLE, SurfelModel, Transitions, change_states, count_errors, count_views
from gsfusion_nb.types import Camera, Seeds

NOTHING = Transitions(stabilised=0, released=0, expired=0, oversized=0)
CONFIG = StateConfig(
    stable_confidence=100.0,
    unstable_frames=50,
    error_count=10,
    colour_error=0.1,
    depth_error_m=0.1,
    max_radius_factor=10.0,
)


def surfels(n: int, *, stable: tuple[int, ...] = (), radius_m: float = 0.02, now: int = 0) -> SurfelModel:
    """``n`` equal discs, numbered by their tag, born at step 0."""
    model = SurfelModel(sh_degree=0)
    model.append(
        Seeds.isotropic(
            torch.zeros(n, 3),
            torch.full((n, 3), 0.5),
            torch.full((n,), radius_m),
            opacity=0.99,
            tag=torch.arange(n, dtype=torch.int32),
        )
    )
    for i in stable:
        model.state[i] = STABLE
    model.step_count = now
    return model


def rows(model: SurfelModel) -> dict[str, torch.Tensor]:
    return model.state_dict()["rows"]


def assert_same(model: SurfelModel, before: dict[str, torch.Tensor], but: tuple[str, ...] = ()) -> None:
    for name, column in rows(model).items():
        if name not in but:
            assert torch.equal(column, before[name]), name


def test_a_row_becomes_stable_above_the_threshold_only():
    model = surfels(4, stable=(3,))
    model.confidence.copy_(torch.tensor([99, 100, 101, 5]))
    model.colour_errors.copy_(torch.tensor([1, 1, 1, 1]))
    model.depth_errors.copy_(torch.tensor([2, 2, 2, 2]))
    before = rows(model)
    report = change_states(model, CONFIG)
    assert model.is_stable.tolist() == [False, False, True, True]
    assert model.colour_errors.tolist() == [1, 1, 0, 1]  # errors count since it became stable
    assert model.depth_errors.tolist() == [2, 2, 0, 2]
    assert report == Transitions(stabilised=1, released=0, expired=0, oversized=0)
    assert_same(model, before, ("state", "colour_errors", "depth_errors"))


def test_nothing_to_do_changes_nothing():
    model = surfels(3, stable=(1,), now=50)
    before = rows(model)
    assert change_states(model, CONFIG) == NOTHING
    assert_same(model, before)
    empty = surfels(0)
    assert change_states(empty, CONFIG) == NOTHING
    assert len(empty) == 0


@pytest.mark.parametrize("counter", ["colour_errors", "depth_errors"])
def test_a_stable_row_in_error_more_than_ten_times_is_released(counter):
    model = surfels(4, stable=(0, 1, 2), now=1000)
    model.birth_step.fill_(990)
    model.confidence.fill_(60)
    getattr(model, counter).copy_(torch.tensor([9, 10, 11, 11]))  # the last is unstable: it has no errors to answer for
    before = rows(model)
    report = change_states(model, CONFIG)
    assert report == Transitions(stabilised=0, released=1, expired=0, oversized=0)
    assert model.state.tolist() == [STABLE, STABLE, UNSTABLE, UNSTABLE]
    assert model.confidence.tolist() == [60, 60, 0, 60]
    assert model.birth_step.tolist() == [990, 990, 1000, 990]
    assert getattr(model, counter).tolist() == [9, 10, 0, 11]
    assert_same(model, before, ("state", "confidence", "birth_step", counter))


def test_a_released_row_is_not_old_at_once_and_needs_all_its_confidence_again():
    model = surfels(1, stable=(0,), now=1000)
    model.colour_errors.fill_(11)
    model.confidence.fill_(500)
    change_states(model, CONFIG)
    assert (len(model), model.is_stable.tolist()) == (1, [False])
    assert change_states(model, CONFIG) == NOTHING
    model.step_count = 1050
    assert change_states(model, CONFIG) == NOTHING
    model.step_count = 1051
    assert change_states(model, CONFIG).expired == 1


def test_as_released_wrong_depth_is_deleted_and_wrong_colour_left_alone():
    config = StateConfig(on_error="delete", error_count=10, unstable_frames=50)
    model = surfels(4, stable=(0, 1, 2))
    model.colour_errors.copy_(torch.tensor([11, 0, 0, 0]))
    model.depth_errors.copy_(torch.tensor([0, 11, 0, 11]))
    before = rows(model)
    report = change_states(model, config)
    assert report == Transitions(stabilised=0, released=1, expired=0, oversized=0)
    assert model.tag.tolist() == [0, 2, 3]
    kept = torch.tensor([True, False, True, True])
    assert_same(model, {name: column[kept] for name, column in before.items()})


def test_unstable_rows_expire_by_the_clock_of_frames():
    model = surfels(5, stable=(4,), now=60)
    model.birth_step.copy_(torch.tensor([9, 10, 11, 60, 0]))
    report = change_states(model, CONFIG)
    assert model.tag.tolist() == [1, 2, 3, 4]  # 60 - 9 > 50; stable rows never expire
    assert report == Transitions(stabilised=0, released=0, expired=1, oversized=0)


def test_views_count_where_the_centre_is_in_the_picture():
    model = surfels(6)
    model.params.xyz_W.copy_(  # ahead, behind, at the left edge inside and outside, below, far ahead
        torch.tensor(
            [[0.0, 0, 1], [0, 0, -1], [-0.99, 0, 1], [-1.01, 0, 1], [0, 0.76, 1], [0, 0, 100]], dtype=torch.float32
        )
    )
    camera = Camera(width=8, height=6, fx=4.0, fy=4.0, cx=4.0, cy=3.0)
    count_views(model, camera, torch.eye(4))
    assert model.frames_in_view.tolist() == [1, 0, 1, 0, 0, 1]
    turned = torch.diag(torch.tensor([-1.0, 1, -1, 1]))  # by half a turn
    count_views(model, camera, turned)
    assert model.frames_in_view.tolist() == [1, 1, 1, 0, 0, 1]


def test_what_the_camera_left_quickly_does_not_expire_where_only_views_count():
    model = surfels(3, now=1000)
    model.frames_in_view.copy_(torch.tensor([49, 50, 51]))
    assert change_states(model, dataclasses.replace(CONFIG, age="in_view")).expired == 1
    assert model.tag.tolist() == [0, 1]
    assert change_states(model, CONFIG).expired == 2


def test_a_row_that_becomes_stable_at_the_last_moment_stays():
    model = surfels(1, now=1000)
    model.confidence.fill_(101)
    assert change_states(model, CONFIG) == Transitions(stabilised=1, released=0, expired=0, oversized=0)
    assert len(model) == 1


def test_oversized_rows_go_measured_against_those_of_their_own_state():
    """Means: (12 * 0.01 + 0.5) / 13 = 0.0477 of the stable, 0.1 of the unstable. A stable 0.5 m goes, 0.1 m stays."""
    model = surfels(16, stable=tuple(range(13)), radius_m=0.01)
    model.params.log_scale[12:13] = torch.tensor(0.5).log()
    model.params.log_scale[13:] = torch.tensor(0.1).log()
    report = change_states(model, CONFIG)
    assert report == Transitions(stabilised=0, released=0, expired=0, oversized=1)
    assert model.tag.tolist() == [*range(12), 13, 14, 15]


def test_without_a_radius_limit_none_goes():
    model = surfels(30)
    model.params.log_scale[0] = 5.0
    assert change_states(model, StateConfig(max_radius_factor=None)) == NOTHING


def test_a_row_is_counted_once_in_the_report():
    """Old and too large; in error and too large."""
    model = surfels(30, stable=tuple(range(15)), now=100)
    model.birth_step[16:] = 100
    model.params.log_scale[[0, 15]] = 2.0
    model.depth_errors[0] = 11
    report = change_states(model, StateConfig(on_error="delete", error_count=10, unstable_frames=50))
    assert report == Transitions(stabilised=0, released=1, expired=1, oversized=0)
    assert len(model) == 28


def images(colour, colour_index, depth, depth_index) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    return (
        torch.tensor([colour]),
        torch.tensor([colour_index], dtype=torch.int64),
        torch.tensor([depth]),
        torch.tensor([depth_index], dtype=torch.int64),
    )


def test_errors_are_the_worst_pixel_of_a_stable_row():
    model = surfels(5, stable=(0, 1, 2, 3))
    before = rows(model)
    count_errors(
        model,
        *images(
            #   row 0 wrong in 1 of 2 pixels, row 1 at the limit, row 4 unstable, no row, row 0 again
            [0.05, 0.11, 0.1, 0.9, 0.9, 0.3],
            [0, 0, 1, 4, -1, 0],
            [-0.11, 0.11, 0.1, -0.1, 0.5, 0.5],
            [0, 1, 2, 2, -1, 4],
        ),
        CONFIG,
    )
    assert model.colour_errors.tolist() == [1, 0, 0, 0, 0]  # once a frame, however many pixels
    assert model.depth_errors.tolist() == [1, 1, 0, 0, 0]
    assert_same(model, before, ("colour_errors", "depth_errors"))


def test_depth_errors_of_one_side():
    model = surfels(2, stable=(0, 1))
    one_sided = StateConfig(depth_error_sides="in_front", depth_error_m=0.1)
    # measured minus rendered: positive where the model stands in front of the measurement
    count_errors(model, *images([0.0, 0.0], [0, 1], [-0.5, 0.5], [0, 1]), one_sided)
    assert model.depth_errors.tolist() == [0, 1]


def test_errors_add_up_over_frames():
    model = surfels(1, stable=(0,))
    for _ in range(11):
        assert model.is_stable.all()
        count_errors(model, *images([0.5], [0], [0.0], [-1]), CONFIG)
        change_states(model, CONFIG)
    assert not model.is_stable.any()
