"""The backend ``mine``: accepted functions run in the library, are counted, and are named when they
fail."""

import linecache

import pytest
import torch

from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.backends import use_backend
from gsfusion_nb.course import check, exercises, mine, progress
from gsfusion_nb.course.learner_backend import LearnerError
from gsfusion_nb.evaluation import psnr
from gsfusion_nb.geometry import se3
from gsfusion_nb.optim import adam_update, l1_vjp
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.seeding import quadtree
from gsfusion_nb.tsdf import tsdf_update
from gsfusion_nb.types import Camera, Frame, GaussianParams

pytestmark = pytest.mark.usefixtures("nothing_kept")


PICTURES = torch.full((2, 3, 3), 0.75), torch.full((2, 3, 3), 0.25)


def l1_gradient(rgb, target):
    return torch.sign(rgb - target) / rgb.numel()


def row(operation):
    return next(row for row in mine.board().rows if row.operation == operation)


def test_a_function_that_passes_is_kept_and_runs_in_the_library():
    calls = []

    def counted(rgb, target):
        calls.append(rgb.shape)
        return l1_gradient(rgb, target)

    assert check.l1_gradient(counted)
    assert {"l1_gradient": counted} == mine.KEPT
    calls.clear()
    assert torch.equal(l1_vjp(*PICTURES), l1_gradient(*PICTURES))
    assert not calls
    with use_backend("mine"):
        assert torch.equal(l1_vjp(*PICTURES), l1_gradient(*PICTURES))
    assert calls == [(2, 3, 3)]
    assert (row("l1_vjp").calls.own, row("l1_vjp").calls.reference) == (1, 0)


def test_a_function_that_fails_the_check_is_not_kept():
    assert not check.l1_gradient(lambda rgb, target: rgb)
    assert not mine.KEPT


def test_the_newest_accepted_function_counts_and_can_be_forgotten():
    mine.keep("l1_gradient", lambda rgb, target: torch.zeros_like(rgb))
    mine.keep("l1_gradient", l1_gradient)
    with use_backend("mine"):
        assert l1_vjp(*PICTURES).sum() == 1
        mine.forget("l1_gradient")
        assert l1_vjp(*PICTURES).sum() == 1
    assert (row("l1_vjp").calls.own, row("l1_vjp").calls.reference) == (1, 1)
    assert row("l1_vjp").whose == "reference"


def test_a_function_that_calls_the_library_gets_the_reference():
    mine.keep("l1_gradient", lambda rgb, target: l1_vjp(rgb, target))
    with use_backend("mine"):
        assert l1_vjp(*PICTURES).sum() == 1


def raises(rgb, target):
    missing = rgb - target
    return missing / nowhere  # noqa: F821


def wrong_shape(rgb, target):
    return (rgb - target).mean(-1)


def not_a_number(rgb, target):
    return (rgb - target) * torch.nan


def a_list(rgb, target):
    return ["up", "down"]


def whole_numbers(rgb, target):
    return torch.sign(rgb - target).long()


@pytest.mark.parametrize("broken", [raises, wrong_shape, not_a_number, a_list, whole_numbers])
def test_a_broken_function_is_named_with_its_line_and_what_went_in(broken):
    mine.keep("l1_gradient", broken)
    at = broken.__code__.co_firstlineno + 2 * (broken is raises)
    with (
        use_backend("mine"),
        pytest.raises(LearnerError, match=rf"your l1_gradient \(line {at}, `") as e,
    ):
        l1_vjp(*PICTURES)
    assert "rgb = [2, 3, 3] float32" in str(e.value)


def test_a_nested_list_of_the_right_shape_is_accepted():
    mine.keep("l1_gradient", lambda rgb, target: l1_gradient(rgb, target).tolist())
    with use_backend("mine"):
        assert torch.equal(l1_vjp(*PICTURES), l1_gradient(*PICTURES))


def test_inputs_of_the_library_are_safe_from_a_function_that_changes_its_own():
    mine.keep(
        "running_average",
        lambda D, W, d, cap: (D.zero_(), W.add_(1)),
    )
    D = torch.ones(3)
    W = torch.zeros(3)
    sdf_m = torch.tensor([0.01, -0.01, -1.0])
    with use_backend("mine"):
        new_D, new_W = tsdf_update(D, W, sdf_m, truncation_m=0.1, max_weight=100.0)
    assert (D.tolist(), W.tolist()) == ([1.0] * 3, [0.0] * 3)
    assert (new_D.tolist(), new_W.tolist()) == ([0.0, 0.0, 1.0], [1.0, 1.0, 0.0])


@pytest.mark.parametrize(
    "settings", [{"threshold": 0.001}, {"threshold": 0.1, "contrast": "std", "min_cell_px": 2}]
)
def test_a_quadtree_in_another_order_gives_the_librarys_cells(settings):
    rgb_u8 = torch.randint(
        0,
        256,
        (21, 30, 3),
        generator=torch.Generator().manual_seed(0),
        dtype=torch.uint8,
    )
    expected = quadtree.reference(rgb_u8, **settings)
    mine.keep("quadtree_leaves", lambda *given: check.quadtree_leaves._solution(*given)[::-1])
    with use_backend("mine"):
        got = quadtree(rgb_u8, **settings)
    assert row("quadtree").calls.own == 1
    for name, column in vars(expected).items():
        assert torch.equal(getattr(got, name), column)


@pytest.mark.parametrize(
    "leaves",
    [[(0, 0, 15, 10)], [(0, 0, 30, 21), (0, 0, 1, 1)], 7],
)
def test_leaves_that_do_not_tile_the_image_are_the_learners_error(leaves):
    mine.keep("quadtree_leaves", lambda *given: leaves)
    with use_backend("mine"), pytest.raises(LearnerError, match="your quadtree_leaves"):
        quadtree(torch.zeros(21, 30, 3, dtype=torch.uint8))


def test_the_board_shows_whose_code_ran():
    mine.keep("l1_gradient", l1_gradient)
    with use_backend("mine"):
        l1_vjp(*PICTURES)
        quadtree(torch.zeros(8, 8, 3, dtype=torch.uint8))
    board = mine.board()
    assert board.yours == ["l1_vjp"]
    text = repr(board)
    assert [line.split()[1] for line in text.splitlines()[1:3]] == ["YOURS", "reference"]
    assert "1 of " in text


def keep_all():
    """Every exercise's own solution in the place of a learner's function."""
    for name, exercise in exercises().items():
        mine.keep(name, exercise._solution)


def few_gaussians(n=9):
    g = torch.Generator().manual_seed(2)
    xyz = torch.randn(n, 3, generator=g) * torch.tensor([0.6, 0.4, 0.3]) + torch.tensor(
        [0.0, 0.0, 1.5]
    )
    xyz[-1, 2] = -1.0  # behind the camera
    xyz[-2, 0] = 4.0  # far outside the picture
    return GaussianParams(
        xyz_W=xyz,
        log_scale=0.4 * torch.randn(n, 3, generator=g) - 2.0,
        quat=torch.randn(n, 4, generator=g),
        opacity_logit=torch.randn(n, generator=g) + 1.0,
        sh=0.3 * torch.randn(n, 4, 3, generator=g),
    )


def test_a_picture_and_its_gradient_by_the_learners_code_are_the_references():
    params = few_gaussians()
    camera = Camera(
        width=5,
        height=4,
        fx=5.0,
        fy=4.0,
        cx=2.5,
        cy=2.0,
    )
    T_WC = se3.exp(torch.tensor([0.1, -0.1, 0.05, 0.1, -0.2, 0.3]))
    expected, saved = render_forward.reference(params, camera, T_WC)
    v_rgb = torch.randn(
        4,
        5,
        3,
        generator=torch.Generator().manual_seed(3),
    )
    v_expected = render_vjp.reference(saved, v_rgb)
    keep_all()
    with use_backend("mine"):
        got, saved = render_forward(params, camera, T_WC)
        v_got = render_vjp(saved, v_rgb)
    for name in ("rgb", "depth_m", "alpha"):
        torch.testing.assert_close(
            getattr(got, name), getattr(expected, name), rtol=1e-4, atol=1e-5
        )
    assert torch.equal(got.first_index, expected.first_index)
    for name, value in vars(v_expected).items():
        torch.testing.assert_close(getattr(v_got, name), value, rtol=1e-3, atol=1e-4)
    for name in (
        "project_gaussians",
        "splat_alpha",
        "blend",
        "tile_intersections",
        "sh_to_rgb",
        "blend_vjp",
        "splat_alpha_vjp",
        "project_gaussians_vjp",
    ):
        assert row(name).calls.own > 0, name
        assert row(name).calls.reference == 0, name


@pytest.mark.parametrize("steps", [None, 7, "rows"])
def test_adam_by_the_learners_code_is_the_references(steps):
    g = torch.Generator().manual_seed(5)
    param, gradient, m = (torch.randn(4, 2, 3, generator=g) for _ in range(3))
    v = torch.rand(4, 2, 3, generator=g)
    lr = torch.tensor([[0.1], [0.2]]).expand(-1, 3)
    t = torch.tensor([1, 3, 1, 8]) if steps == "rows" else steps
    options = {"lr": lr, "beta1": 0.9, "beta2": 0.999, "eps": 1e-15}
    expected, got = ([x.clone() for x in (param, m, v)] for _ in range(2))
    adam_update.reference(expected[0], gradient, *expected[1:], t, **options)
    keep_all()
    with use_backend("mine"):
        adam_update(got[0], gradient, *got[1:], t, **options)
    assert row("adam_update").calls.own == 1
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


def test_nan_at_one_pixel_is_found_among_many():
    params = few_gaussians()
    camera = Camera(
        width=5,
        height=4,
        fx=5.0,
        fy=4.0,
        cx=2.5,
        cy=2.0,
    )

    def composite_pixel(alpha, rgb):
        return rgb.sum(0) / (len(alpha) - 3), alpha.sum()

    mine.keep("composite_pixel", composite_pixel)
    with (
        use_backend("mine"),
        pytest.raises(LearnerError, match="NaN or infinite values for the colour") as e,
    ):
        render_forward(params, camera, torch.eye(4))
    assert "alpha = [" in str(e.value)


@pytest.mark.ci
def test_a_room_mapped_with_the_learners_code_is_as_good_as_the_references():
    """Measured: 0.0005 dB. Both differ in the order of sums, and the projection of yours runs in
    float64."""
    options = {
        "data__width": 32,
        "data__height": 24,
        "data__stop": 8,
        "tsdf__voxel_size_m": 0.08,
        "sh_degree": 1,
    }
    options |= {
        "tsdf__truncation_voxels": 2.0,
        "seeding__quadtree_contrast": "std",
        "keyframe_min_seeds": 20,
    }
    config = gsfusion("room", "paper_steps", **options)
    sequence = open_sequence("room", data=config.data, n_frames=16)
    scores = []
    meshes = []
    keep_all()
    for backend in ("reference", "mine"):
        with use_backend(backend):
            mapper = GSFusion(config)
            for i in range(2):
                mapper.step(sequence.mapping[i])
            views = [sequence.mapping[i] for i in range(2)]
            scores.append(
                [psnr(mapper.render(view.camera, view.T_WC).rgb, view.rgb) for view in views]
            )
            meshes.append(mapper.mesh())
    assert scores[0] == pytest.approx(scores[1], abs=0.1)
    torch.testing.assert_close(
        meshes[0].vertices_W,
        meshes[1].vertices_W,
        rtol=0,
        atol=1e-5,
    )
    parts = {"luma_variance", "cut"}  # inside yours they are called by yours
    later = {name for name, exercise in exercises().items() if exercise.chapter > 6}
    rows = [each for each in mine.board().rows if each.exercise and each.exercise not in later]
    for each in rows:
        # called after a frame that is no keyframe
        if each.operation not in parts | {"draw_keyframes"}:
            assert each.calls.own > 0, each.operation
            assert each.calls.reference == 0, each.operation


NOTEBOOK = """
import torch
from gsfusion_nb.course import check

SIGN = 1.0

def direction(x):
    return SIGN * torch.sign(x)

step = direction

def l1_gradient(rgb, target):
    return step(rgb - target) / rgb.numel()
"""


def test_an_accepted_function_is_there_in_the_next_chapter(monkeypatch):
    lines = NOTEBOOK.splitlines(keepends=True)
    monkeypatch.setitem(linecache.cache, "<cell>", (len(NOTEBOOK), None, lines, "<cell>"))
    namespace = {"__name__": "__main__"}
    exec(compile(NOTEBOOK, "<cell>", "exec"), namespace)
    assert check.l1_gradient(namespace["l1_gradient"])
    mine.forget()
    assert not mine.KEPT
    mine.load()
    assert list(mine.KEPT) == ["l1_gradient"]
    with use_backend("mine"):
        assert l1_vjp(*PICTURES).sum() == 1
    assert row("l1_vjp").whose == "yours"


def test_the_solutions_can_stand_in_and_the_board_says_so():
    mine.load(missing="solution")
    assert set(mine.KEPT) == set(exercises())
    assert row("blend").whose == "solution"
    assert "blend" not in mine.board().yours


def test_a_frame_in_which_the_learners_function_fails_is_taken_back():
    camera = Camera(
        width=16,
        height=12,
        fx=14.0,
        fy=14.0,
        cx=8.0,
        cy=6.0,
    )
    rgb = torch.rand(
        12,
        16,
        3,
        generator=torch.Generator().manual_seed(3),
    )
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=torch.full((12, 16), 2.0),
        camera=camera,
        T_WC=torch.eye(4),
    )
    config = gsfusion(
        "online",
        sh_degree=0,
        tsdf__voxel_size_m=0.2,
        seeding__quadtree_contrast="std",
        optim__keyframe_iterations=2,
        optim__frame_iterations=2,
    )
    mapper = GSFusion(config)
    calls = []

    def l1_gradient(rgb, target):
        calls.append(1)
        if len(calls) == 2:
            raise ValueError("the second step")
        return torch.sign(rgb - target) / rgb.numel()

    mine.keep("l1_gradient", l1_gradient)
    with use_backend("mine"):
        with pytest.raises(
            LearnerError, match=r"your l1_gradient .* raised ValueError: the second step"
        ):
            mapper.step(frame)
        assert (len(mapper.gaussians), len(mapper.keyframes), mapper.volume.n_blocks) == (0, 0, 0)
        assert mapper.step(frame).n_seeds == len(mapper.gaussians) > 0


def test_progress_written_by_hand_keeps_no_function(monkeypatch, tmp_path):
    monkeypatch.setenv("GSNB_COURSE_FILE", str(tmp_path / "course.json"))
    wrong = "def l1_gradient(rgb, target):\n    return rgb\n"
    progress.note("exercises", "l1_gradient", tries=1, passed=progress.now())
    progress.note(
        "functions", "l1_gradient", function="l1_gradient", source=wrong, kept=progress.now()
    )
    mine.load()
    assert "l1_gradient" not in mine.KEPT
    with use_backend("mine"):
        l1_vjp(torch.ones(2, 2, 3), torch.zeros(2, 2, 3))
