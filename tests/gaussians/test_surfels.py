"""Rows of the compact map: values at birth, derived surfel parameters, rigid motion, saving."""

import copy
import dataclasses
import math

import pytest
import torch

from gsfusion_nb.config import StateConfig
from gsfusion_nb.gaussians import (
    OPAQUE,
    STABLE,
    TRANSPARENT,
    UNSTABLE,
    GaussianModel,
    SurfelModel,
    Transitions,
    change_states,
    count_errors,
    count_views,
    radius_of,
    state_counts,
)
from gsfusion_nb.gaussians.rigid_motion import move_map_
from gsfusion_nb.gaussians.surfel_states import (
    BECOMES_STABLE,
    BECOMES_UNSTABLE,
    DELETED,
    STAYS,
    next_states,
)
from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.geometry.spherical_harmonics import sh_basis
from gsfusion_nb.types import ALL_ROWS, Camera, Seeds

COUNTERS = ("state", "confidence", "colour_errors", "depth_errors")


def discs(n: int, generator: torch.Generator, opacity: float = OPAQUE) -> Seeds:
    def uniform(*size: int):
        return torch.rand(*size, generator=generator)

    return Seeds(
        xyz_W=uniform(n, 3),
        rgb=uniform(n, 3),
        scale_m=0.01 + 0.04 * uniform(n, 3),
        quat=torch.randn(n, 4, generator=generator),
        opacity=torch.full((n,), opacity),
        tag=torch.arange(n, dtype=torch.int32),
    )


def one_disc(
    scale_m: tuple[float, float, float],
    quat: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0),
) -> SurfelModel:
    model = SurfelModel(sh_degree=0)
    seeds = Seeds.isotropic(
        torch.zeros(1, 3),
        torch.full((1, 3), 0.5),
        torch.ones(1),
        opacity=OPAQUE,
    )
    model.append(
        Seeds(**vars(seeds) | {"scale_m": torch.tensor([scale_m]), "quat": torch.tensor([quat])})
    )
    return model


def test_normal_is_the_thinnest_axis_by_hand():
    half = math.sqrt(0.5)
    torch.testing.assert_close(
        one_disc((0.03, 0.02, 0.001)).normal_W,
        torch.tensor([[0.0, 0, 1]]),
    )
    torch.testing.assert_close(
        one_disc((0.001, 0.02, 0.03)).normal_W,
        torch.tensor([[1.0, 0, 0]]),
    )
    # a quarter turn about z: x goes to y
    turned = one_disc((0.001, 0.02, 0.03), (half, 0.0, 0.0, half))
    torch.testing.assert_close(turned.normal_W, torch.tensor([[0.0, 1, 0]]))


def test_radius_is_the_mean_of_the_two_largest_standard_deviations():
    sizes = [(0.01, 0.03, 0.05), (0.05, 0.01, 0.03), (0.03, 0.05, 0.01)]
    torch.testing.assert_close(radius_of(torch.tensor(sizes)), torch.full((3,), 0.04))
    torch.testing.assert_close(one_disc((0.02, 0.006, 0.001)).radius_m, torch.tensor([0.013]))


def test_rows_are_born_unstable_at_the_step_and_held_at_their_first_values(generator):
    model = SurfelModel(sh_degree=1)
    model.clock.advance(7)
    seeds = discs(5, generator)
    model.append(seeds, frame_index=12)
    assert model.clock.birth.tolist() == [7] * 5
    assert model.birth_frame.tolist() == [12] * 5
    assert not model.is_stable.any()
    for name in COUNTERS:
        assert getattr(model, name).tolist() == [0] * 5
    torch.testing.assert_close(model.anchor["xyz_W"], seeds.xyz_W)
    torch.testing.assert_close(model.anchor["log_scale"], seeds.scale_m.log())
    assert torch.equal(model.anchor["quat"], seeds.quat)
    for name in ("xyz_W", "log_scale", "quat"):
        getattr(model.params, name).add_(1.0)
    torch.testing.assert_close(model.anchor["xyz_W"], seeds.xyz_W)
    model.append(discs(0, generator))
    assert len(model) == 5


def motions(n: int, generator: torch.Generator) -> torch.Tensor:
    return se3.exp(torch.randn(n, 6, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("kind", [SurfelModel, GaussianModel])
def test_moving_rows_moves_points_and_axes(kind, generator):
    """Centres by R x + t, orientations by R R_q, the covariance by R S R^T: each from the matrices
    themselves."""
    model = kind(sh_degree=0)
    model.append(discs(30, generator))
    T = motions(30, generator).float()
    R = T[:, :3, :3]
    xyz = model.params.xyz_W.clone()
    before = quaternion.to_matrix(model.params.quat)
    move_map_(model, T.double())
    torch.testing.assert_close(
        model.params.xyz_W,
        torch.einsum("nij,nj->ni", R, xyz) + T[:, :3, 3],
        atol=1e-5,
        rtol=1e-5,
    )
    torch.testing.assert_close(
        quaternion.to_matrix(model.params.quat), R @ before, atol=1e-5, rtol=1e-5
    )
    if kind is SurfelModel:
        torch.testing.assert_close(model.anchor["xyz_W"], model.params.xyz_W)
        torch.testing.assert_close(
            model.anchor["quat"],
            model.params.quat,
            atol=1e-6,
            rtol=1e-5,
        )


def test_colours_and_moments_turn_with_their_rows(generator):
    """Two groups of rows turn by 40 degrees about two axes, the third stays: seen from directions
    that turn with them, colours are the same, and so is what a gradient says about a motion that
    turns with them."""
    model = GaussianModel(sh_degree=3)
    model.append(discs(30, generator))
    for moments in (model.params, model.moments.exp_avg):
        moments.sh.copy_(torch.randn(30, 16, 3, generator=generator))
    for name in ("xyz_W", "quat"):
        getattr(model.moments.exp_avg, name).copy_(
            torch.randn(30, 3 + (name == "quat"), generator=generator)
        )
        getattr(model.moments.exp_avg_sq, name).copy_(
            torch.rand(30, 3 + (name == "quat"), generator=generator)
        )
    T = torch.eye(4, dtype=torch.float64).repeat(30, 1, 1)
    T[:10] = se3.exp(torch.tensor([0, 0, 0, 0.7, 0, 0], dtype=torch.float64))
    T[10:20] = se3.exp(torch.tensor([1, 2, 3, 0, 0.4, 0.5], dtype=torch.float64))
    R = T[:, :3, :3].float()
    dirs = torch.nn.functional.normalize(torch.randn(30, 3, generator=generator), dim=1)
    before, old = (copy.deepcopy(vars(x)) for x in (model.moments.exp_avg, model.params))
    square = model.moments.exp_avg_sq.xyz_W.clone()
    move_map_(model, T)
    turned = (R @ dirs[:, :, None])[:, :, 0]
    for was, now in ((old["sh"], model.params.sh), (before["sh"], model.moments.exp_avg.sh)):
        seen = [(sh_basis(d, 3)[:, :, None] * sh).sum(1) for d, sh in ((dirs, was), (turned, now))]
        torch.testing.assert_close(*seen, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(
        model.moments.exp_avg.xyz_W,
        (R @ before["xyz_W"][:, :, None])[:, :, 0],
    )
    torch.testing.assert_close(
        model.moments.exp_avg.quat.norm(dim=1),
        before["quat"].norm(dim=1),
    )
    torch.testing.assert_close(model.moments.exp_avg_sq.xyz_W.sum(1), square.sum(1))
    assert torch.equal(model.params.sh[20:], old["sh"][20:])


def test_state_round_trip(generator):
    model = SurfelModel(sh_degree=2)
    model.append(discs(5000, generator), 2)
    model.clock.advance(17)
    for i, name in enumerate(COUNTERS):
        getattr(model, name).copy_(model.tag + i)
    model.state.copy_(model.tag % 2)
    model.params.xyz_W.add_(1.0)
    again = SurfelModel.from_state_dict(model.state_dict())
    assert isinstance(again, SurfelModel)
    assert (len(again), again.clock.count, again.sh_degree) == (5000, 17, 2)
    saved = model.state_dict()["rows"]
    restored = again.state_dict()["rows"]
    assert saved.keys() == restored.keys()
    for name, column in saved.items():
        assert torch.equal(restored[name], column), name
    model.confidence.zero_()
    assert again.confidence[7] == 8


CONFIG = StateConfig(
    stable_confidence=100.0,
    unstable_frames=50,
    error_count=10,
    colour_error=0.1,
    depth_error_m=0.1,
    max_radius_factor=10.0,
)


def surfels(
    n: int,
    *,
    stable: tuple[int, ...] = (),
    radius_m: float = 0.02,
    now: int = 0,
) -> SurfelModel:
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
    model.clock.advance(now)
    return model


def rows(model: SurfelModel) -> dict[str, torch.Tensor]:
    return model.columns.snapshot()


def assert_same(
    model: SurfelModel,
    before: dict[str, torch.Tensor],
    but: tuple[str, ...] = (),
) -> None:
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


@pytest.mark.parametrize(
    ("per_step", "stable"),
    [(1.0, [False, False, True]), (2.0, [False, True, True]), (0.0, [False, False, False])],
)
def test_confidence_is_the_number_of_steps_times_their_size(per_step, stable):
    model = surfels(3)
    model.confidence.copy_(torch.tensor([50, 51, 101]))
    change_states(model, CONFIG, per_step)
    assert model.is_stable.tolist() == stable


@pytest.mark.parametrize("counter", ["colour_errors", "depth_errors"])
def test_a_stable_row_in_error_more_than_ten_times_is_released(counter):
    model = surfels(4, stable=(0, 1, 2), now=1000)
    model.clock.birth.fill_(990)
    model.confidence.fill_(60)
    # the last is unstable: it has no errors to answer for
    getattr(model, counter).copy_(torch.tensor([9, 10, 11, 11]))
    before = rows(model)
    report = change_states(model, CONFIG)
    assert report == Transitions(stabilised=0, released=1, expired=0, oversized=0)
    assert model.state.tolist() == [STABLE, STABLE, UNSTABLE, UNSTABLE]
    assert model.confidence.tolist() == [60, 60, 0, 60]
    assert model.clock.birth.tolist() == [990, 990, 1000, 990]
    assert getattr(model, counter).tolist() == [9, 10, 0, 11]
    assert_same(model, before, ("state", "confidence", "birth_step", counter))


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


def test_oversized_rows_go_measured_against_those_of_their_own_state():
    """Means: (12 * 0.01 + 0.5) / 13 = 0.0477 of the stable, 0.1 of the unstable. A stable 0.5 m
    goes, 0.1 m stays."""
    model = surfels(16, stable=tuple(range(13)), radius_m=0.01)
    model.params.log_scale[12:13] = torch.tensor(0.5).log()
    model.params.log_scale[13:] = torch.tensor(0.1).log()
    report = change_states(model, CONFIG)
    assert report == Transitions(stabilised=0, released=0, expired=0, oversized=1)
    assert model.tag.tolist() == [*range(12), 13, 14, 15]


def images(
    colour, colour_index, depth, depth_index
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
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
            # row 0 wrong in 1 of 2 pixels, row 1 at the limit, row 4 unstable, no row,
            # row 0 again
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
    one_sided = StateConfig(on_error="delete", depth_error_m=0.1)
    # measured minus rendered: positive where the model stands in front of the measurement
    count_errors(
        model,
        *images([0.0, 0.0], [0, 1], [-0.5, 0.5], [0, 1]),
        one_sided,
    )
    assert model.depth_errors.tolist() == [0, 1]


@pytest.mark.parametrize("some", [False, True])
def test_a_view_is_counted_where_the_centre_is_in_the_image(some):
    """Camera of 40 x 20 pixels with f = 20: at z = 2 the image reaches from -2 to 2 and from -1 to
    1 metre, at z = -2 it would be the same. The camera stands at x = 5 and looks along its z
    axis."""
    camera = Camera(
        width=40,
        height=20,
        fx=20.0,
        fy=20.0,
        cx=20.0,
        cy=10.0,
    )
    T_WC = torch.eye(4)
    T_WC[0, 3] = 5.0
    inside = [
        (0.0, 0.0, 2.0),
        (-1.99, 0.0, 2.0),
        (1.99, 0.0, 2.0),
        (0.0, -0.99, 2.0),
        (0.0, 0.99, 2.0),
    ]
    outside = [
        (-2.01, 0.0, 2.0),
        (2.01, 0.0, 2.0),
        (0.0, -1.01, 2.0),
        (0.0, 1.01, 2.0),
        (0.0, 0.0, -2.0),
    ]
    border = [(-2.0, 0.0, 2.0), (2.0, 0.0, 2.0), (0.0, -1.0, 2.0), (0.0, 1.0, 2.0)]
    model = surfels(14)
    model.params.xyz_W.copy_(torch.tensor([*inside, *outside, *border]) + T_WC[:3, 3])
    model.frames_in_view.fill_(3)
    asked = torch.tensor([1, 6, 0]) if some else ALL_ROWS
    count_views(model, camera, T_WC, asked)
    seen = [0, 1] if some else range(5)
    assert model.frames_in_view.tolist() == [4 if row in seen else 3 for row in range(14)]


def test_discs_of_another_program_are_refused():
    with pytest.raises(
        ValueError,
        match=r"RTG-SLAM cannot begin with Gaussians of another program, .* use --system",
    ):
        surfels(1).extend(surfels(1).params)


def test_states_are_counted_by_state_and_kind():
    model = surfels(6, stable=(0, 1, 2, 3))
    model.params.opacity_logit[torch.tensor([1, 2, 3, 5])] = -2.0
    assert state_counts(model) == {
        "stable_opaque": 1,
        "stable_transparent": 3,
        "unstable_opaque": 1,
        "unstable_transparent": 1,
    }


def test_a_new_state_starts_its_counts_again():
    model = surfels(4, stable=(0, 1), now=9)
    for name in ("confidence", "colour_errors", "depth_errors", "frames_in_view"):
        getattr(model, name).fill_(7)
    change = torch.tensor([1, 2]), torch.tensor([UNSTABLE, STABLE], dtype=model.state.dtype)
    model.set_rows("state", *change)
    assert model.state.tolist() == [STABLE, UNSTABLE, STABLE, UNSTABLE]
    assert model.colour_errors.tolist() == model.depth_errors.tolist() == [7, 0, 0, 7]
    assert model.confidence.tolist() == model.frames_in_view.tolist() == [7, 0, 7, 7]
    assert model.clock.birth.tolist() == [0, 9, 0, 0]


@pytest.mark.parametrize(
    ("age", "left"),
    [("all", [0, 1]), ("in_view", [0, 2])],
)
def test_an_unstable_row_is_removed_when_it_is_older_than_the_limit(age, left):
    """The limit is 50 frames. Frames since it was added: 50, 50, 51; in view: 50, 51, 50."""
    model = surfels(3, now=60)
    model.clock.birth.copy_(torch.tensor([10, 10, 9]))
    model.frames_in_view.copy_(torch.tensor([50, 51, 50]))
    report = change_states(model, dataclasses.replace(CONFIG, age=age))
    assert model.tag.tolist() == left
    assert report == Transitions(stabilised=0, released=0, expired=1, oversized=0)


def test_what_happens_to_a_row_and_what_counts_first():
    """An old row that has been seen enough becomes stable; a stable one does not age."""
    stable = torch.tensor([False, False, False, False, True, True, True])
    happens = next_states(
        stable,
        confidence=torch.tensor([100, 101, 100, 101, 0, 0, 0]),
        errors=torch.tensor([99, 99, 99, 99, 10, 11, 0]),
        age=torch.tensor([50, 50, 51, 51, 99, 99, 99]),
        stable_confidence=100.0,
        error_count=10,
        unstable_frames=50,
    )
    assert happens.tolist() == [
        STAYS,
        BECOMES_STABLE,
        DELETED,
        BECOMES_STABLE,
        STAYS,
        BECOMES_UNSTABLE,
        STAYS,
    ]


def test_moments_turn_by_the_rotation_and_its_squares(generator):
    """A gradient of a quaternion turns as the quaternion does, from the left; mean squares by the
    squares."""
    model = GaussianModel(sh_degree=0)
    model.append(discs(7, generator))
    for moments in (model.moments.exp_avg, model.moments.exp_avg_sq):
        for column in (moments.xyz_W, moments.quat):
            column.copy_(torch.rand(column.shape, generator=generator))
    before = {
        name: copy.deepcopy(vars(getattr(model.moments, name)))
        for name in ("exp_avg", "exp_avg_sq")
    }
    T = motions(7, generator)
    move_map_(model, T)
    R = T[:, :3, :3].float()
    q = quaternion.from_matrix(R)
    L = torch.stack(
        [quaternion.multiply(q, e.expand(7, 4)) for e in torch.eye(4)],
        dim=2,
    )
    for i in range(7):
        mean, square = (
            {name: column[i] for name, column in vars(m).items()}
            for m in (model.moments.exp_avg, model.moments.exp_avg_sq)
        )
        torch.testing.assert_close(mean["xyz_W"], R[i] @ before["exp_avg"]["xyz_W"][i])
        turned = quaternion.multiply(
            q[i : i + 1],
            before["exp_avg"]["quat"][i : i + 1],
        )[0]
        torch.testing.assert_close(mean["quat"], turned)
        torch.testing.assert_close(
            square["xyz_W"],
            R[i] ** 2 @ before["exp_avg_sq"]["xyz_W"][i],
        )
        torch.testing.assert_close(
            square["quat"],
            L[i] ** 2 @ before["exp_avg_sq"]["quat"][i],
        )


def test_normal_is_the_smallest_eigenvector_of_the_covariance(generator):
    model = SurfelModel(sh_degree=0)
    model.append(discs(20, generator))
    R = quaternion.to_matrix(model.params.quat)
    covariance = R @ torch.diag_embed(model.scale_m**2) @ R.transpose(1, 2)
    smallest = torch.linalg.eigh(covariance.double()).eigenvectors[:, :, 0].float()
    torch.testing.assert_close(
        (smallest * model.normal_W).sum(1).abs(),
        torch.ones(20),
    )


def test_a_reused_row_remembers_nothing(generator):
    model = SurfelModel(sh_degree=0)
    model.append(discs(6, generator))
    for name in COUNTERS:
        getattr(model, name).fill_(9)
    model.keep(torch.arange(6) < 2)
    model.append(discs(4, generator))
    for name in COUNTERS:
        assert getattr(model, name).tolist() == [9, 9, 0, 0, 0, 0]


def test_transparent_and_opaque_by_the_opacity_at_birth(generator):
    model = SurfelModel(sh_degree=0)
    model.append(discs(2, generator, TRANSPARENT))
    model.append(discs(3, generator, OPAQUE))
    assert model.is_transparent.tolist() == [True, True, False, False, False]
    model.state[torch.tensor([0, 2, 3])] = STABLE
    assert state_counts(model) == {
        "stable_opaque": 2,
        "stable_transparent": 1,
        "unstable_opaque": 1,
        "unstable_transparent": 1,
    }
    assert (UNSTABLE, STABLE) == (0, 1)


def test_no_moments_are_kept(generator):
    model = SurfelModel(sh_degree=0)
    assert not any(name.startswith("exp_avg") for name in model.state_dict()["rows"])


def test_a_moved_anchor_stays_where_it_was_beside_its_row(generator):
    model = SurfelModel(sh_degree=0)
    model.append(discs(10, generator))
    model.params.xyz_W.add_(0.1)
    model.params.quat.add_(0.3)
    gap = quaternion.to_matrix(model.anchor["quat"]).transpose(1, 2) @ quaternion.to_matrix(
        model.params.quat
    )
    move_map_(model, motions(10, generator))
    moved = quaternion.to_matrix(model.anchor["quat"]).transpose(1, 2) @ quaternion.to_matrix(
        model.params.quat
    )
    torch.testing.assert_close(moved, gap, atol=1e-5, rtol=1e-5)
    apart = (model.params.xyz_W - model.anchor["xyz_W"]).norm(dim=1)
    torch.testing.assert_close(
        apart,
        torch.full((10,), 0.1 * math.sqrt(3)),
        atol=1e-5,
        rtol=1e-5,
    )


NOTHING = Transitions(stabilised=0, released=0, expired=0, oversized=0)


def test_a_row_that_becomes_stable_at_the_last_moment_stays():
    model = surfels(1, now=1000)
    model.confidence.fill_(101)
    assert change_states(model, CONFIG) == Transitions(
        stabilised=1, released=0, expired=0, oversized=0
    )
    assert len(model) == 1


def test_without_a_radius_limit_none_goes():
    model = surfels(30)
    model.params.log_scale[0] = 5.0
    assert change_states(model, StateConfig(max_radius_factor=None)) == NOTHING


def test_errors_add_up_over_frames():
    model = surfels(1, stable=(0,))
    for _ in range(11):
        assert model.is_stable.all()
        count_errors(
            model,
            *images([0.5], [0], [0.0], [-1]),
            CONFIG,
        )
        change_states(model, CONFIG)
    assert not model.is_stable.any()
