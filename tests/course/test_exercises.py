"""Every exercise of the course: its solution passes, its wrong answers fail and say why, an unwritten body is grey."""

import inspect

import pytest

from gsfusion_nb.course import exercises
from gsfusion_nb.course.attempt import Attempt
from gsfusion_nb.course.exercise import Exercise, Solution, source_of

ALL = exercises()
WRONG = [(e, w) for e in ALL.values() for w in e.wrong]


@pytest.mark.parametrize("name", ALL)
def test_the_solution_is_right_as_it_is_shown_and_cannot_be_handed_in(name):
    exercise = ALL[name]
    namespace = dict(inspect.unwrap(exercise._solution).__globals__)
    exec(compile(source_of(name, exercise._solution), "<shown>", "exec"), namespace)
    exercise.judge(Attempt(namespace[name]))
    for handed_in in (exercise._solution, lambda *args, **kwargs: exercise._solution(*args, **kwargs)):
        assert "it is your own code" in repr(exercise(handed_in))


@pytest.mark.parametrize(("exercise", "wrong"), WRONG, ids=[f"{e.name}-{w.function.__name__}" for e, w in WRONG])
def test_a_plausible_wrong_answer_fails_and_hears_why(exercise, wrong, monkeypatch):
    monkeypatch.setattr(Exercise, "_guard", lambda self: None)  # many call the solution
    verdict = exercise.verdict(wrong.function)
    assert verdict.state == "failed", repr(verdict)
    assert wrong.says in repr(verdict)
    assert verdict.on


@pytest.mark.parametrize("name", ALL)
def test_an_unwritten_body_is_neither_right_nor_wrong(name):
    def unwritten(*args, **kwargs): ...

    assert ALL[name](unwritten).state == "not written"
    stand_in = ALL[name].working(unwritten, plain=True)
    assert stand_in.__code__.co_code == inspect.unwrap(ALL[name]._solution).__code__.co_code
    with pytest.raises(OSError, match="could not get source"):
        inspect.getsource(stand_in)
    assert f"def {name}(" in repr(Solution(name, source_of(name, ALL[name]._solution)))


@pytest.mark.parametrize("name", ALL)
def test_a_crash_is_reported_as_the_students(name):
    def crash(*args, **kwargs):
        raise RuntimeError("index 7 is out of range")

    verdict = ALL[name](crash)
    assert (verdict.state, verdict.prop) == ("failed", "it runs")
    assert "index 7" in verdict.detail
