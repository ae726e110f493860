"""Chapters 7 and 8 under the backend ``mine``: pieces of RTG-SLAM, of ICP and of the pose graph by a learner's code."""

import pytest
import torch

from gsfusion_nb import backends, open_sequence
from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import rtg_slam
from gsfusion_nb.course import becomes, exercises, mine
from gsfusion_nb.course.mine import LearnerError
from gsfusion_nb.evaluation import psnr
from gsfusion_nb.gaussians.states import next_states
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import RTGSLAM
from gsfusion_nb.optim.fusion import fuse
from gsfusion_nb.render.disc import disc_hit
from gsfusion_nb.seeding.rules.rtg_slam import adding_masks
from gsfusion_nb.tracking import IcpSystem, point_to_plane, pose_graph_step, relative_pose_error
from gsfusion_nb.tracking.icp import next_pose
from gsfusion_nb.tracking.solve import Extent, solve_step
from gsfusion_nb.tracking.tracker import constant_velocity

F64 = torch.float64


@pytest.fixture(autouse=True)
def solutions_are_kept(monkeypatch):
    for kept in (backends.FUNCTIONS, becomes.KEPT):
        for name in list(kept):
            monkeypatch.delitem(kept, name)
    for name, exercise in exercises().items():
        if exercise.chapter in (7, 8):
            mine.keep(name, exercise._solution)
    mine.clear_counts()
    yield
    mine.forget()
    mine.clear_counts()


def both(piece, *args, **options):
    """What the reference gives, and what the learner's code gives."""
    expected = piece(*args, **options)
    with use_backend("mine"):
        return expected, piece(*args, **options)


def calls(name):
    return backends.CALLS[name].own, backends.CALLS[name].reference


def near(got, expected):
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-6)


def test_disc_depth(generator):
    r, p, n = torch.randn(3, 40, 3, generator=generator)
    r[:, 2], n = 1.0, n / n.norm(dim=1, keepdim=True)
    near(*both(disc_hit, r, p, n, 0.5))
    near(*both(disc_hit, r[:0], p[:0], n[:0], 0.5))
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
    confidence, errors, age = (torch.randint(0, int(2 * k) + 2, (60,), generator=generator) for k in limits)
    stable = torch.rand(60, generator=generator) < 0.5
    options = dict(zip(("stable_confidence", "error_count", "unstable_frames"), limits, strict=True))
    expected, got = both(next_states, stable, confidence, errors, age, **options)
    assert torch.equal(got, expected)
    assert set(expected.tolist()) == {0, 1, 2, 3}
    assert calls("next_states") == (1, 0)


def test_a_word_that_is_no_state_names_the_learners_line():
    mine.keep("next_state", lambda stable, eta, errors, age: "turns blue")
    one = torch.ones(1, dtype=torch.int32)
    options = {"stable_confidence": 100.0, "error_count": 10, "unstable_frames": 120}
    with use_backend("mine"), pytest.raises(LearnerError, match="returned 'turns blue', which is none of 'stays'") as e:
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
    system = IcpSystem(H=J.T @ J, b=J.T @ r, sum_squares_m2=1.0, sum_weights=30.0, n_inliers=30, n_overlap=30)
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
    i, j = torch.tensor([0, 1, 2, 3]), torch.tensor([1, 2, 3, 1])
    _, J_i, J_j = relative_pose_error(T[i], T[j], se3.inverse(T[i]) @ T[j])
    for got, expected in zip(*both(relative_pose_error, T[i], T[j], se3.inverse(T[i]) @ T[j]), strict=True):
        near(got, expected)
    graph = (0.05 * torch.randn(4, 6, generator=generator, dtype=F64), J_i, J_j)
    near(*both(pose_graph_step, T, i, j, *graph, torch.eye(6, dtype=F64).repeat(4, 1, 1)))
    assert calls("pose_graph_step") == (1, 0)


@pytest.mark.ci
def test_a_room_of_discs_by_the_learners_code_is_the_references():
    """Measured at 48 x 36 with 2 frames: equal counts, and equal PSNR to 0.001 dB."""
    config = rtg_slam("room", data__width=32, data__height=24, data__stop=8, seeding__options={"share": 0.4},
                      discs__min_cosine=0.5, window__every_frames=2, window__frames=2, window__iterations=3,
                      keyframes__iterations=1, states__stable_confidence=5.0)  # fmt: skip
    room = open_sequence("room", data=config.data, n_frames=48)
    scores, counts = [], []
    for backend in ("reference", "mine"):
        with use_backend(backend):
            mapper = RTGSLAM(config)
            counts.append([mapper.step(room.mapping[i]).counts for i in range(2)])
            views = [room.mapping[i] for i in range(2)]
            scores.append([psnr(mapper.render(view.camera, view.T_WC).rgb, view.rgb) for view in views])
    assert counts[0] == counts[1]
    assert counts[0][1]["stabilised"] > 0
    assert scores[0] == pytest.approx(scores[1], abs=0.1)
    for name in ("disc_hit", "adding_masks", "next_states", "fuse"):
        assert calls(name)[0] > 0, name
        assert calls(name)[1] == 0, name
