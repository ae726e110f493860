"""Every exercise of the course: its solution passes, its wrong answers fail and say why, an
unwritten body is grey."""

import inspect

import pytest

from gsfusion_nb.course import exercises
from gsfusion_nb.course.attempt import Attempt, LocalSubject
from gsfusion_nb.course.exercise import source_of

ALL = exercises()
WRONG = [(e, w) for e in ALL.values() for w in e.wrong]


@pytest.mark.parametrize("name", ALL)
def test_the_solution_is_right_as_it_is_shown(name):
    exercise = ALL[name]
    namespace = dict(inspect.unwrap(exercise._solution).__globals__)
    exec(compile(source_of(name, exercise._solution), "<shown>", "exec"), namespace)
    exercise.judge(Attempt(LocalSubject(namespace[name])))


@pytest.mark.parametrize(
    ("exercise", "wrong"), WRONG, ids=[f"{e.name}-{w.function.__name__}" for e, w in WRONG]
)
def test_a_plausible_wrong_answer_fails_and_hears_why(exercise, wrong):
    verdict = exercise.verdict(wrong.function)
    assert verdict.state == "failed", repr(verdict)
    assert wrong.says in repr(verdict)
    assert verdict.on


@pytest.mark.parametrize("name", ALL)
def test_an_unwritten_body_is_neither_right_nor_wrong(name):
    def unwritten(*args, **kwargs): ...

    assert ALL[name](unwritten).state == "not written"
    assert ALL[name].working(unwritten) is ALL[name]._solution
    assert f"def {name}(" in source_of(name, ALL[name]._solution)


@pytest.mark.parametrize("name", ALL)
def test_a_crash_is_reported_as_the_students(name):
    def crash(*args, **kwargs):
        raise RuntimeError("index 7 is out of range")

    verdict = ALL[name](crash)
    assert (verdict.state, verdict.prop) == ("failed", "it runs")
    assert "index 7" in verdict.detail
