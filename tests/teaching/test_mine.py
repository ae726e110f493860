"""The backend ``mine``: accepted functions run in the library, are counted, and are named when they fail."""

import pytest
import torch

from gsfusion_nb import own_code
from gsfusion_nb.backends import BackendUnavailable, use_backend
from gsfusion_nb.optim import l1_vjp
from gsfusion_nb.seeding import quadtree
from gsfusion_nb.teaching import becomes, check, mine
from gsfusion_nb.teaching.mine import LearnerError
from gsfusion_nb.tsdf import tsdf_update

pytestmark = pytest.mark.usefixtures("nothing_kept")


@pytest.fixture
def nothing_kept(monkeypatch):
    for name in list(own_code.FUNCTIONS):
        monkeypatch.delitem(own_code.FUNCTIONS, name)
    for name in list(mine.kept()):
        monkeypatch.delitem(becomes.KEPT, name)
    mine.clear_counts()
    yield
    mine.forget()
    mine.clear_counts()


PICTURES = torch.full((2, 3, 3), 0.75), torch.full((2, 3, 3), 0.25)


def l1_gradient(rgb, target):
    return torch.sign(rgb - target) / rgb.numel()


def row(operation):
    return next(row for row in mine.board().rows if row.operation == operation)


def test_every_exercise_that_becomes_something_becomes_an_operation_that_exists():
    mine.check_becomes()


def test_a_function_that_passes_is_kept_and_runs_in_the_library():
    calls = []

    def counted(rgb, target):
        calls.append(rgb.shape)
        return l1_gradient(rgb, target)

    assert check.l1_gradient(counted)
    assert mine.kept() == {"l1_gradient": counted}
    calls.clear()
    assert torch.equal(l1_vjp(*PICTURES), l1_gradient(*PICTURES))
    assert not calls
    with use_backend("mine"):
        assert torch.equal(l1_vjp(*PICTURES), l1_gradient(*PICTURES))
    assert calls == [(2, 3, 3)]
    assert (row("l1_vjp").calls.own, row("l1_vjp").calls.reference) == (1, 0)


def test_a_function_that_fails_the_check_is_not_kept():
    assert not check.l1_gradient(lambda rgb, target: rgb)
    assert not mine.kept()


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
    return missing / nowhere


def wrong_shape(rgb, target):
    return (rgb - target).mean(-1)


def not_a_number(rgb, target):
    return (rgb - target) * torch.nan


def a_list(rgb, target):
    return ["up", "down"]


def whole_numbers(rgb, target):
    return torch.sign(rgb - target).long()


@pytest.mark.parametrize(
    ("broken", "line", "words"),
    [
        (raises, 2, "raised NameError: name 'nowhere' is not defined"),
        (wrong_shape, 0, "returned [2, 3] float32, 0.5 to 0.5 for the gradient; expected [2, 3, 3] float32"),
        (not_a_number, 0, "18 NaN or infinite values for the gradient [2, 3, 3], the first at [0, 0, 0]"),
        (a_list, 0, "returned a list of 2 for the gradient, which is not an array of numbers"),
        (whole_numbers, 0, "returned [2, 3, 3] int64, 1 to 1 for the gradient; expected [2, 3, 3] float32"),
    ],
)
def test_a_broken_function_is_named_with_its_line_and_what_went_in(broken, line, words):
    mine.keep("l1_gradient", broken)
    at = broken.__code__.co_firstlineno + line
    with use_backend("mine"), pytest.raises(LearnerError, match=rf"your l1_gradient \(line {at}, `") as e:
        l1_vjp(*PICTURES)
    assert words in str(e.value)
    assert "operation l1_vjp, with rgb = [2, 3, 3] float32, 0.75 to 0.75; target" in str(e.value)


def test_a_nested_list_of_the_right_shape_is_accepted():
    mine.keep("l1_gradient", lambda rgb, target: l1_gradient(rgb, target).tolist())
    with use_backend("mine"):
        assert torch.equal(l1_vjp(*PICTURES), l1_gradient(*PICTURES))


def test_inputs_of_the_library_are_safe_from_a_function_that_changes_its_own():
    mine.keep("running_average", lambda D, W, d, cap: (D.zero_(), W.add_(1)))
    D, W, sdf_m = torch.ones(3), torch.zeros(3), torch.tensor([0.01, -0.01, -1.0])
    with use_backend("mine"):
        new_D, new_W = tsdf_update(D, W, sdf_m, truncation_m=0.1, max_weight=100.0)
    assert (D.tolist(), W.tolist()) == ([1.0] * 3, [0.0] * 3)
    assert (new_D.tolist(), new_W.tolist()) == ([0.0, 0.0, 1.0], [1.0, 1.0, 0.0])


@pytest.mark.parametrize("settings", [{"threshold": 0.001}, {"threshold": 0.1, "contrast": "std", "min_cell_px": 2}])
def test_a_quadtree_in_another_order_gives_the_librarys_cells(settings):
    rgb_u8 = torch.randint(0, 256, (21, 30, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    expected = quadtree.reference(rgb_u8, **settings)
    mine.keep("quadtree_leaves", lambda *given: check.quadtree_leaves._solution(*given)[::-1])
    with use_backend("mine"):
        got = quadtree(rgb_u8, **settings)
    assert row("quadtree").calls.own == 1
    for name, column in vars(expected).items():
        assert torch.equal(getattr(got, name), column)


@pytest.mark.parametrize("leaves", [[(0, 0, 15, 10)], [(0, 0, 30, 21), (0, 0, 1, 1)], 7])
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
    text, page = repr(board), board._repr_html_()
    assert [line.split()[1] for line in text.splitlines()[1:3]] == ["YOURS", "reference"]
    assert "#1a7f37" in page
    assert "#6e7781" in page
    assert "1 of " in text


def test_without_the_course_the_backend_is_refused_in_a_sentence(monkeypatch):
    monkeypatch.delitem(__import__("sys").modules, "gsfusion_nb.teaching.mine")
    with pytest.raises(BackendUnavailable, match="functions that a learner wrote in a notebook"), use_backend("mine"):
        pass
