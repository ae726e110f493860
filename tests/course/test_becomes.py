"""What the function of every exercise becomes in the library: the solution in the
place of a piece gives what the piece gives."""

import pytest
import torch

from gsfusion_nb import backends, open_sequence
from gsfusion_nb.backends import registry, use_backend
from gsfusion_nb.config import rtg_slam
from gsfusion_nb.course import exercises, mine
from gsfusion_nb.course.learner_backend import LearnerError
from gsfusion_nb.evaluation import psnr
from gsfusion_nb.gaussians.history import fuse
from gsfusion_nb.gaussians.surfel_states import next_states
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import RTGSLAM
from gsfusion_nb.mapping.gsfusion import plan_frame
from gsfusion_nb.optim.keyframes import draw_keyframes
from gsfusion_nb.render.disc import disc_hit
from gsfusion_nb.render.over_base import (
    Base,
    blend_with_base,
    blend_with_base_vjp,
    not_behind,
    render_over_base,
    render_over_base_vjp,
)
from gsfusion_nb.seeding.quadtree import cell_gaussians, quadtree
from gsfusion_nb.seeding.rules.gsfusion import first_seen
from gsfusion_nb.seeding.rules.rtg_slam import adding_masks
from gsfusion_nb.tracking import IcpSystem, point_to_plane, pose_graph_step, relative_pose_error
from gsfusion_nb.tracking.camera_path import constant_velocity
from gsfusion_nb.tracking.icp import next_pose
from gsfusion_nb.tracking.icp_step import Extent, solve_step
from gsfusion_nb.tsdf.marching_cubes import zero_crossing
from gsfusion_nb.tsdf.morton import OFFSET, interleave
from gsfusion_nb.tsdf.voxels import block_of
from gsfusion_nb.types import Camera, GaussianParams

RUNS_AS = {
    "first_seen": "first_seen",
    "block_of": "block_of",
    "morton_code": "interleave",
    "running_average": "tsdf_update",
    "signed_distance": "signed_distance_m",
    "zero_crossing": "zero_crossing",
    "cell_to_gaussian": "cell_gaussians",
    "contrast": "luma_variance",
    "quadtree_leaves": "quadtree",
    "split_cell": "cut",
    "composite_pixel": "blend",
    "project_gaussian": "project_gaussians",
    "splat_alpha": "splat_alpha",
    "tiles_touched": "tile_intersections",
    "view_colour": "sh_to_rgb",
    "adam": "adam_update",
    "blend_vjp": "blend_vjp",
    "l1_gradient": "l1_vjp",
    "project_gaussian_vjp": "project_gaussians_vjp",
    "splat_alpha_vjp": "splat_alpha_vjp",
    "draw_keyframes": "draw_keyframes",
    "plan_frame": "plan_frame",
    "adding_masks": "adding_masks",
    "disc_hit": "disc_hit",
    "fuse": "fuse",
    "next_state": "next_states",
    "gauss_newton": "next_pose",
    "graph_step": "pose_graph_step",
    "point_to_plane": "point_to_plane",
    "predict": "constant_velocity",
    "relative_error": "relative_pose_error",
    "blend_over": "blend_with_base",
    "blend_over_vjp": "blend_with_base_vjp",
    "weights_over": "not_behind",
}
"""Exercise -> operation or piece of the library that its function becomes under the backend
``mine``."""


def test_what_becomes_of_the_exercises():
    assert {
        name: e.becomes.operation for name, e in exercises().items() if e.becomes is not None
    } == RUNS_AS
    assert set(RUNS_AS.values()) <= {*registry.OPERATIONS, *registry.PIECES}


@pytest.fixture(autouse=True)
def solutions_are_kept(nothing_kept):
    for name, exercise in exercises().items():
        mine.keep(name, exercise._solution)


def both(piece, *args, **options):
    """What the reference gives, and what the exercise's solution gives in its place."""
    expected = piece(*args, **options)
    with use_backend("mine"):
        return expected, piece(*args, **options)


def calls(name):
    return backends.CALLS[name].own, backends.CALLS[name].reference


def test_pieces_of_the_volume(generator):
    p0 = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    D0 = torch.rand(9, generator=generator) + 0.1
    expected, got = both(zero_crossing, p0, p0 + 1.0, D0, -D0.flip(0))
    torch.testing.assert_close(got, expected)
    ijk = torch.randint(-40, 40, (3, 5, 3), generator=generator)
    assert torch.equal(*both(block_of, ijk))
    coords = torch.randint(-OFFSET, OFFSET, (20, 3), generator=generator)
    assert torch.equal(*both(interleave, coords))


def test_the_gaussian_of_a_cell_and_whether_it_is_new(generator):
    camera = Camera(
        width=40,
        height=30,
        fx=20.0,
        fy=21.0,
        cx=20.0,
        cy=15.0,
    )
    cells = quadtree(
        torch.randint(0, 256, (30, 40, 3), generator=generator, dtype=torch.uint8),
        threshold=1e-3,
    )
    depth_m = 1 + torch.rand(30, 40, generator=generator)
    for expected, got in zip(
        *both(cell_gaussians, camera, cells, depth_m, torch.eye(4)), strict=True
    ):
        torch.testing.assert_close(got, expected)
    weight = torch.tensor([0.0, 1.0, 2.0])
    assert torch.equal(*both(first_seen, weight, 1.0))


def test_keyframes():
    expected, got = both(draw_keyframes, 5, 2, torch.Generator().manual_seed(1))
    assert len(expected) == len(got.unique()) == 2
    for n_seeds, n_keyframes in ((60, 3), (50, 1), (3, 7)):
        expected = plan_frame(n_seeds, n_keyframes, 5, 3, 2, 50)
        with use_backend("mine"):
            assert plan_frame(n_seeds, n_keyframes, 5, 3, 2, 50) == expected
    mine.keep("draw_keyframes", lambda n, count, generator: [0, 0])
    with (
        use_backend("mine"),
        pytest.raises(LearnerError, match=r"must return 2 different numbers; it returned \[0, 0\]"),
    ):
        draw_keyframes(5, 2, torch.Generator())


F64 = torch.float64


def near(got, expected):
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-6)


def test_disc_depth(generator):
    r, p, n = torch.randn(3, 40, 3, generator=generator)
    r[:, 2] = 1.0
    n = n / n.norm(dim=1, keepdim=True)
    near(*both(disc_hit, r, p, n, 0.5))
    near(
        *both(
            disc_hit,
            r[:0],
            p[:0],
            n[:0],
            0.5,
        )
    )
    assert calls("disc_hit") == (2, 0)
    near(*both(disc_hit, r, p, n, 0.2))
    assert calls("disc_hit") == (2, 1)


def test_adding_masks(generator):
    T, seen_m, depth_m = torch.rand(3, 6, 8, generator=generator)
    depth_m[0] = 0
    pictures = torch.rand(2, 6, 8, 3, generator=generator)
    arguments = (T, seen_m, depth_m, *pictures)
    for expected, got in zip(*both(adding_masks, *arguments, 0.5, 0.1, 0.1), strict=True):
        assert torch.equal(got, expected)
        assert expected.any()
    both(adding_masks, *arguments, 0.5, 0.2, 0.1)
    assert calls("adding_masks") == (1, 1)


@pytest.mark.parametrize("limits", [(100.0, 10, 120), (12.0, 3, 7)])
def test_states_with_other_limits_than_the_exercise(limits, generator):
    confidence, errors, age = (
        torch.randint(
            0,
            int(2 * k) + 2,
            (60,),
            generator=generator,
        )
        for k in limits
    )
    stable = torch.rand(60, generator=generator) < 0.5
    options = dict(
        zip(("stable_confidence", "error_count", "unstable_frames"), limits, strict=True)
    )
    expected, got = both(next_states, stable, confidence, errors, age, **options)
    assert torch.equal(got, expected)
    assert set(expected.tolist()) == {0, 1, 2, 3}
    assert calls("next_states") == (1, 0)


def test_a_word_that_is_no_state_names_the_learners_line():
    mine.keep("next_state", lambda stable, eta, errors, age: "turns blue")
    one = torch.ones(1, dtype=torch.int32)
    options = {"stable_confidence": 100.0, "error_count": 10, "unstable_frames": 120}
    with (
        use_backend("mine"),
        pytest.raises(LearnerError, match="returned 'turns blue', which is none of 'stays'") as e,
    ):
        next_states(one.bool(), one, one, one, **options)
    assert "stable = True; eta = 1;" in str(e.value)


def test_fusion_with_the_past(generator):
    before, after = torch.randn(2, 6, 4, generator=generator)
    eta = torch.tensor([0, 5, 10, 50, 7, 0], dtype=torch.int32)
    more = torch.tensor([20, 5, 40, 60, 7, 0], dtype=torch.int32)
    near(*both(fuse, before, after, eta, more, history_max_weight=1.0))
    both(fuse, before, after, eta, more, history_max_weight=0.5)
    assert calls("fuse") == (1, 1)


def test_residuals_and_a_step_of_icp(generator):
    p, q, n = torch.randn(3, 30, 3, generator=generator)
    for got, expected in zip(*both(point_to_plane, p, q, n), strict=True):
        near(got, expected)
    r, J = (x.double() for x in point_to_plane(p, q, n))
    system = IcpSystem(
        H=J.T @ J,
        b=J.T @ r,
        sum_squares_m2=1.0,
        sum_weights=30.0,
        n_inliers=30,
        n_overlap=30,
    )
    extent = Extent(centre=p.double().mean(0), spread_m=1.0)
    T = se3.exp(torch.randn(6, generator=generator, dtype=F64))
    step = solve_step(system, extent, damping=0.0, min_eigenvalue=1e-3)
    near(*both(next_pose, T, system, step))
    open_wall = solve_step(system, extent, damping=0.0, min_eigenvalue=0.9)
    near(*both(next_pose, T, system, open_wall))
    assert calls("next_pose") == (1, 1)


@pytest.mark.parametrize("ratio", [1.0, 2.0, 0.5])
def test_prediction_of_the_tracker(ratio, generator):
    T = se3.exp(0.2 * torch.randn(2, 6, generator=generator, dtype=F64))
    near(*both(constant_velocity, *T, ratio))
    assert calls("constant_velocity") == (1, 0)


def test_an_edge_and_a_step_of_the_pose_graph(generator):
    T = se3.exp(torch.randn(4, 6, generator=generator, dtype=F64))
    i = torch.tensor([0, 1, 2, 3])
    j = torch.tensor([1, 2, 3, 1])
    _, J_i, J_j = relative_pose_error(
        T[i],
        T[j],
        se3.inverse(T[i]) @ T[j],
    )
    for got, expected in zip(
        *both(relative_pose_error, T[i], T[j], se3.inverse(T[i]) @ T[j]),
        strict=True,
    ):
        near(got, expected)
    graph = (0.05 * torch.randn(4, 6, generator=generator, dtype=F64), J_i, J_j)
    near(
        *both(
            pose_graph_step,
            T,
            i,
            j,
            *graph,
            torch.eye(6, dtype=F64).repeat(4, 1, 1),
        )
    )
    assert calls("pose_graph_step") == (1, 0)


@pytest.mark.ci
def test_a_room_of_discs_by_the_learners_code_is_the_references():
    """Measured at 48 x 36 with 2 frames: equal counts, and equal PSNR to 0.001 dB."""
    config = rtg_slam(
        "room",
        data__width=32,
        data__height=24,
        data__stop=8,
        seeding__options={"share": 0.4},
        discs__min_cosine=0.5,
        window__every_frames=2,
        window__frames=2,
        window__iterations=3,
        keyframes__iterations=1,
        states__stable_confidence=15.0,
    )
    room = open_sequence("room", data=config.data, n_frames=48)
    scores = []
    counts = []
    for backend in ("reference", "mine"):
        with use_backend(backend):
            mapper = RTGSLAM(config)
            counts.append([mapper.step(room.mapping[i]).counts for i in range(2)])
            views = [room.mapping[i] for i in range(2)]
            scores.append(
                [psnr(mapper.render(view.camera, view.T_WC).rgb, view.rgb) for view in views]
            )
    assert counts[0] == counts[1]
    assert counts[0][1]["stabilised"] > 0
    assert scores[0] == pytest.approx(scores[1], abs=0.1)
    for name in ("disc_hit", "adding_masks", "next_states", "fuse"):
        assert calls(name)[0] > 0, name
        assert calls(name)[1] == 0, name


CAMERA = Camera(
    width=24,
    height=18,
    fx=20.0,
    fy=20.0,
    cx=12.0,
    cy=9.0,
)
EYE = torch.eye(4)


@pytest.fixture
def params(generator):
    n = 12
    xyz = torch.rand(n, 3, generator=generator) * torch.tensor([1.6, 1.2, 0.2]) + torch.tensor(
        [-0.8, -0.6, 1.9]
    )
    return GaussianParams(
        xyz_W=xyz,
        log_scale=torch.full((n, 3), -2.5),
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator),
        sh=torch.randn(n, 1, 3, generator=generator) * 0.3,
    )


def base(weight):
    size = (CAMERA.height, CAMERA.width)
    return Base(
        rgb=torch.full((*size, 3), 0.4),
        depth_m=torch.full(size, 2.0),
        weight=torch.full(size, weight),
    )


def seen(params, weight):
    output, saved = render_over_base(params, CAMERA, EYE, base(weight), behind_m=0.1)
    return output, render_over_base_vjp(saved, output.rgb - 0.5)


@pytest.mark.parametrize(("weight", "own"), [(1.0, True), (0.0, False)])
def test_pictures_and_gradients_are_made_by_the_learner(params, weight, own):
    """Where a hole has no weight, the exercise says nothing, and the reference draws."""
    with use_backend("reference"):
        expected, gradient = seen(params, weight)
    with use_backend("mine"):
        output, by_you = seen(params, weight)
    torch.testing.assert_close(output.rgb, expected.rgb, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(output.weight, expected.weight, rtol=1e-5, atol=1e-6)
    for name, value in vars(gradient).items():
        torch.testing.assert_close(getattr(by_you, name), value, rtol=1e-4, atol=1e-5)
    assert backends.CALLS["not_behind"].own > 0
    for operation in ("blend_with_base", "blend_with_base_vjp"):
        calls = backends.CALLS[operation]
        assert (calls.own > 0) == own, operation
        assert (calls.reference > 0) != own, operation


def test_no_gaussians_and_no_pixels():
    none = torch.zeros(0, 4)
    colours = torch.zeros(0, 3)
    depth_m = torch.full((4,), 2.0)
    C_s = torch.rand(4, 3, generator=torch.Generator().manual_seed(1))
    b = torch.ones(4)
    with use_backend("mine"):
        assert not_behind(none, b[:0], depth_m, 0.1).shape == (0, 4)
        assert not_behind(
            torch.zeros(2, 0),
            b[:2],
            depth_m[:0],
            0.1,
        ).shape == (2, 0)
        C, W = blend_with_base(none, colours, C_s, b)
        v_w, v_c = blend_with_base_vjp(none, colours, C, b, C_s)
        empty, _ = blend_with_base(
            none[:, :0],
            colours,
            C_s[:0],
            b[:0],
        )
    assert torch.equal(C, C_s)
    assert not W.any()
    assert (v_w.shape, v_c.shape, empty.shape) == ((0, 4), (0, 3), (0, 3))
