"""The bank of questions says what the checkers say."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest
import quiz
import quiz_files
from quiz import ALSO_TRUE, NOT_OFFERED, NUMBERED, snippet

from gsfusion_nb.course import check, exercises
from gsfusion_nb.course.attempt import close, holds

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def questions():
    every = exercises()
    return [quiz.question(every[name], 1, "task") for name in ("psnr", "running_average", "slope", "average_loop")]


@pytest.mark.ci
def test_every_wrong_answer_is_a_question():
    """Statements that hold on the checker's inputs only are no options; of those that fit everything there is one."""
    questions = quiz.bank(ROOT / "notebooks")
    every = exercises()
    assert sorted(q.name for q in questions) == sorted(
        f"{name}-{number}" for name, exercise in every.items() for number in range(1, len(exercise.wrong) + 1)
    )
    pages = quiz_files.pages(questions)
    assert all(f"**{q.name}**\n\n```python\n{q.code}\n```\n" in pages[f"chapter_{q.chapter:02}.md"] for q in questions)
    options = {q.name: q.options for q in questions}
    judges = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "gsfusion_nb/course").glob("*.py"))
    assert set(NOT_OFFERED) | set(ALSO_TRUE) | NUMBERED <= set(options)
    for name, statements in NOT_OFFERED.items():
        assert not set(statements) & set(options[name]), name
        assert all(statement.split(" ", 1)[1] in judges for statement in statements), (
            f"{name}: no judge says this any more"
        )
    for name, found in options.items():
        assert len(set(found)) == 4, name
        assert sum(option in quiz._ALWAYS for option in found) <= 1, (
            f"{name}: the right option is the only one of its kind"
        )


def test_a_number_is_asked_for_where_it_can_be_found():
    q = quiz.question(exercises()["halve_intrinsics"], 1, "")
    assert q.prompt.endswith("What does this function return for cy?")
    assert q.options[q.answer] == "119.75"
    assert "119.5" in q.options, "what a right function returns is the most tempting of the other options"


def test_the_right_option_is_what_the_checker_says(questions):
    for q in questions:
        verdict = check.__getattr__(q.exercise)(exercises()[q.exercise].wrong[0].function)
        assert (q.prop, q.on, q.detail) == (verdict.prop, verdict.on, verdict.detail)
        assert len(set(q.options)) == len(q.options) == 4
        right = q.options[q.answer]
        assert right == q.prop or f"got {right}" in q.detail


def test_a_judge_goes_on_after_the_first_failure():
    def judge(attempt):
        value = attempt.on("1")(1)
        close(value, 2, "it adds one", on="1")
        holds(value > 0, "it is positive", on="1", detail="no")
        close(attempt.on("5")(5), 5, "it keeps five", on="5")
        holds(value > 7, "it is large", on="1", detail="no")
        holds(attempt.on("7")(7) > 0, "it is positive", on="7", detail="only the sign is asked for")

    before = judge.__globals__["close"]
    exercise = replace(exercises()["psnr"], judge=judge, _solution=lambda x: {1: 2, 5: 5, 7: 70}[x])
    found = quiz.judge_thoroughly(exercise, lambda x: x)
    assert [e.prop for e in found.broken] == ["it adds one", "it is large"]
    assert (found.held, found.right_on) == (["it is positive", "it keeps five"], ["5"])
    assert judge.__globals__["close"] is before
    with pytest.raises(ValueError, match="passes"):
        quiz.judge_thoroughly(exercises()["psnr"], exercises()["psnr"]._solution)


def test_the_code_does_not_give_the_answer_away():
    every = exercises()
    for exercise in every.values():
        for wrong in exercise.wrong:
            code = snippet(exercise, wrong.function)
            assert wrong.function.__name__ not in code
            own_name = rf"\b{exercise._solution.__name__}\b"
            assert not re.search(own_name, code) or exercise._solution.__name__ == exercise.name
            assert f"def {exercise.name}(" in code
            compile(code, exercise.name, "exec")


def test_files_for_platforms_have_one_right_option(questions):
    q = questions[0]
    tree = ET.fromstring(quiz_files.moodle_xml(0, [q]))
    answers = tree.findall("question[@type='multichoice']/answer")
    assert [a.get("fraction") for a in answers].count("100") == 1
    assert answers[q.answer].findtext("text") == q.options[q.answer]
    assert q.prop in tree.findtext(".//generalfeedback/text")
    assert sum(line.startswith("*") for line in quiz_files.text2qti(0, [q]).splitlines()) == 1
