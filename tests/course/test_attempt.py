"""The machinery: what a verdict says, hints on request, and what an attempt notices."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.course import check
from gsfusion_nb.course.attempt import Attempt, Failed, LocalSubject, NotWritten
from gsfusion_nb.course.exercise import Wrong, exercise, exercises
from gsfusion_nb.course.progress import read_section
from gsfusion_nb.geometry import backproject
from gsfusion_nb.tsdf.morton import encode


def double(x):
    return 2 * x


def doubled(x):
    return x + x


@pytest.fixture
def twice(monkeypatch):
    """An exercise that only this test knows."""
    from gsfusion_nb.course import exercise as module

    exercises()
    monkeypatch.setattr(module, "_EXERCISES", dict(module._EXERCISES))

    @exercise(
        chapter=1,
        difficulty=2,
        minutes=3,
        hints=("first", "second"),
        solution=double,
        wrong=(Wrong(abs, says="twice"),),
    )
    def twice(attempt):
        """Double a number."""
        attempt.on("the number 3")
        attempt.close(
            attempt(torch.tensor([3.0])), [6.0], "it is twice as large", why="Add it to itself"
        )

    return twice


def test_a_verdict_is_green_red_or_grey(twice):
    green = twice(doubled)
    assert green
    assert "gsnb-passed" in green._repr_html_()
    red = twice(abs)
    assert not red
    assert (red.state, red.prop, red.on) == ("failed", "it is twice as large", "the number 3")
    assert repr(red).splitlines() == [
        "✗ twice: not true yet: “it is twice as large”",
        "  input: the number 3",
        "  got 3 at [0], expected 6. Add it to itself",
        "  2 hints: check.twice.hint()",
    ]
    assert "gsnb-failed" in red._repr_html_()
    assert "gsnb-not-written" in twice(lambda x: None)._repr_html_()
    assert twice(3).prop == "it is a function"


def test_text_from_a_student_cannot_break_the_page(twice):
    def crash(x):
        raise ValueError("<script>")

    assert "<script>" not in twice(crash)._repr_html_()


def test_hints_come_one_at_a_time(twice):
    assert repr(twice.hint()) == "Hint 1 of 2: first"
    assert twice(abs).hints_left == 1
    assert [twice.hint(), twice.hint()] == ["Hint 2 of 2: second"] * 2
    assert twice.hint(1) == "Hint 1 of 2: first"
    assert "hint" not in repr(twice(abs))


def test_the_chapter_goes_on_and_says_with_whose_code(twice, capsys):
    def printed():
        return capsys.readouterr().out

    assert twice.working(abs)(2) == 4
    assert (
        "twice: the reference's is used: yours fails “it is twice as large” (on the number 3)"
        in printed()
    )
    assert twice.working(lambda x: None)(2) == 4
    assert printed() == "twice: the reference's is used: not yet yours.\n"

    def mine(x):
        return x + (x if len(str(x)) < 99 else 1 / 0)

    yours = twice.working(mine)
    assert printed() == "twice: your code is used.\n"
    assert (yours(2), twice.working(mine, plain=True)) == (4, mine)
    printed()
    assert [yours("x" * 99), yours(5)] == ["x" * 198, 10]
    said = printed()
    assert said.count("\n") == 1
    assert "the reference's is used: yours raised ZeroDivisionError in line" in said
    assert "`return x + (x if len(str(x)) < 99 else 1 / 0)`: division by zero" in said


def test_a_crash_names_the_line(twice):
    def crash(x):
        y = x
        return y.nothing

    assert ", `return y.nothing`: 'Tensor' object has no attribute" in twice(crash).detail


def test_the_solution_opens_after_a_try(twice, monkeypatch, tmp_path):
    monkeypatch.setenv("GSNB_COURSE_FILE", str(tmp_path / "course.json"))
    refused = (
        "The solution of twice opens after your first try: write the function and run "
        "check.twice(twice)."
    )
    assert repr(twice.solution()).startswith(refused)
    twice(lambda x: None)
    twice(abs)  # an example of a verdict: its name is not the exercise's
    assert repr(twice.solution()).startswith(refused)
    twice(lambda x: x)
    assert repr(twice.solution()) == "def twice(x):\n    return 2 * x"
    twice.tries = 0
    assert "def twice(x)" in repr(twice.solution())  # a later session
    twice(doubled)
    entry = read_section("exercises")["twice"]
    assert entry["tries"] == 2
    assert "passed" in entry


def test_check_knows_its_exercises(twice):
    assert check.twice is twice
    assert "twice" in dir(check)
    assert "Double a number. ★★☆☆☆ easy, about 3 minutes, 2 hints" in repr(check)
    with pytest.raises(AttributeError, match=r"no exercise 'thrice'; there are: .*project_points"):
        check.thrice  # noqa: B018


def test_an_exercise_must_be_complete():
    with pytest.raises(ValueError, match="needs a docstring"):

        @exercise(
            chapter=1,
            difficulty=1,
            minutes=1,
            hints=("h",),
            solution=double,
            wrong=(Wrong(abs, says="x"),),
        )
        def untitled(attempt): ...

    with pytest.raises(ValueError, match="difficulty must be one of"):

        @exercise(
            chapter=1,
            difficulty=9,
            minutes=1,
            hints=("h",),
            solution=double,
            wrong=(Wrong(abs, says="x"),),
        )
        def too_hard(attempt):
            """Hard."""

    with pytest.raises(ValueError, match=r"exists already in gsfusion_nb\.course\.frames"):

        @exercise(
            chapter=1,
            difficulty=1,
            minutes=1,
            hints=("h",),
            solution=double,
            wrong=(Wrong(abs, says="x"),),
        )
        def project_points(attempt):
            """Taken."""


def test_an_attempt_notices_what_the_student_does():
    x = torch.ones(3)

    def spoils(t):
        t += 1
        return t

    with pytest.raises(Failed, match="does not change its inputs"):
        Attempt(LocalSubject(spoils))(x)
    assert (x == 1).all()
    with pytest.raises(NotWritten):
        Attempt(LocalSubject(lambda t: ...))(x)

    def later(t):
        raise NotImplementedError

    with pytest.raises(NotWritten):
        Attempt(LocalSubject(later))(x)


@pytest.mark.parametrize(
    ("got", "expected", "says"),
    [
        (torch.zeros(2), torch.zeros(3), r"the shape is \[2\], expected \[3\]"),
        ([1.0, float("nan")], [1.0, 2.0], "NaN or infinite"),
        ([[1.0, 2.0], [3.0, 9.0]], [[1.0, 2.0], [3.0, 4.0]], r"got 9 at \[1, 1\], expected 4"),
        ("four", 4.0, "not an array of numbers"),
        (3.0, 4.0, "got 3, expected 4"),
    ],
)
def test_close_says_what_came(got, expected, says):
    with pytest.raises(Failed, match=says) as e:
        Attempt(LocalSubject(abs)).on("this").close(got, expected, "it is right")
    assert (e.value.prop, e.value.on) == ("it is right", "this")


def test_what_the_judge_cannot_use_is_told(twice):
    def awkward(attempt):
        """Double a number."""
        attempt.on("the number 3")(3) + 1

    verdict = dataclasses.replace(twice, judge=awkward)(lambda x: {"a": x})
    assert (verdict.state, verdict.on) == ("failed", "the number 3")
    assert (
        "it returned a dict, with which the checker could not go on (TypeError: unsupported operand"
        in repr(verdict)
    )


@pytest.mark.parametrize("name", exercises())
def test_no_answer_makes_a_checker_raise(name):
    solution = exercises()[name]._solution
    for spoil in (
        lambda v: {"a": 1},
        lambda v: "x",
        lambda v: [v, "x"],
        lambda v: object(),
        lambda v: (w for w in [v]),
    ):
        assert (
            exercises()[name](lambda *a, spoil=spoil, **k: spoil(solution(*a, **k))).state
            == "failed"
        )


def test_an_answer_of_the_library_gets_a_sentence_and_no_mark():
    def morton_code(x, y, z):
        code = encode(torch.tensor([[x, y, z], [0, 0, 0]]))
        return int(code[0] ^ code[1])

    def lift_pixels(camera, uv, depth_m):
        return backproject(camera, uv, depth_m).numpy()

    for name, function in (("morton_code", morton_code), ("lift_pixels", lift_pixels)):
        verdict = check.__getattr__(name)(function)
        assert verdict.prop == "it computes the answer itself"
        assert "a function of the library gave the answer in line" in verdict.detail
    assert "backproject(camera" in verdict.detail


def test_choosing_rows_of_a_value_of_the_library_is_no_borrowed_answer():

    def silhouette_rule(ctx, *, max_alpha=0.5):
        x, y = ctx.quadtree_cells().centre_uv.long().unbind(-1)
        return ctx.cells()[ctx.render().alpha[y, x][ctx.has_depth()[y, x]] < max_alpha]

    assert check.silhouette_rule(silhouette_rule).state == "passed"


SAYS = {
    ("adam", 1): "got 0.01 at [0, 0], expected a negative number",
    ("l1_gradient", 1): "got -0.083333 at [0, 0, 0], expected a positive number",
    ("splat_alpha_vjp", 1): "got 0.11031 at [0], expected a negative number",
    ("blend_over_vjp", 5): "got -0.25 at [0], expected a positive number",
    ("cell_to_gaussian", 4): "got 0.22361 m on the near wall and 0.22361 m on the far one",
    ("gauss_newton", 4): "have the lengths 1.0399, 1.0232, 1.0259; expected 1, 1, 1",
    ("predict", 2): "have the lengths 1.0857, 1, 1.0857; expected 1, 1, 1",
}


@pytest.mark.parametrize(("name", "number"), SAYS)
def test_a_verdict_names_what_was_returned_and_no_sign_or_ratio_of_it(name, number):
    exercise = exercises()[name]
    verdict = exercise.verdict_on(LocalSubject(exercise.wrong[number - 1].function))
    assert SAYS[name, number] in verdict.detail


def test_signs_by_hand():
    attempt = Attempt(LocalSubject(lambda: None)).on("an input")
    attempt.signs([2.0, -0.1, 0.0], [1.0, -1.0, 0.0], "they point there")
    for got, words in (
        ([2.0, 0.3, 0.0], r"got 0.3 at \[1\], expected a negative number: downhill"),
        ([2.0, -0.3, 0.5], r"got 0.5 at \[2\], expected 0"),
        ([math.nan, -0.3, 0.0], r"got nan at \[0\], expected a positive number"),
        ([2.0], r"the shape is \[1\], expected \[3\]"),
        ("a text", "not an array of numbers"),
    ):
        with pytest.raises(Failed, match=words):
            attempt.signs(got, [1.0, -1.0, 0.0], "they point there", why="downhill")


def test_a_rotation_by_hand():
    attempt = Attempt(LocalSubject(lambda: None)).on("an input")
    attempt.rigid([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], "it is rigid")
    for R in ([[1.0, 1, 0], [0, 1, 0], [0, 0, 1]], [[math.nan] * 3] * 3):
        with pytest.raises(Failed, match="right angles"):
            attempt.rigid(R, "it is rigid")
