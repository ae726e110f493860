"""The bank of questions says what the checkers say."""

import re
import xml.etree.ElementTree as ET

import pytest
import quiz

from gsfusion_nb.course import check, exercises


@pytest.mark.ci
def test_most_wrong_answers_are_questions():
    questions = {q.name: q for q in quiz.bank()}
    assert len(questions) > 0.7 * sum(len(e.wrong) for e in exercises().values())
    for name, q in questions.items():
        assert len(set(q.options)) == 4, name
        assert not set(q.options) & set(quiz.NOT_OFFERED.get(name, ())), name
        compile(q.code, name, "exec")


@pytest.mark.parametrize("name", ["psnr", "running_average", "average_loop"])
def test_the_right_option_is_what_the_checker_says(name):
    exercise = exercises()[name]
    q = quiz.question(exercise, 1)
    assert q is not None
    verdict = getattr(check, name)(exercise.wrong[0].function)
    assert q.options[q.answer] == verdict.prop
    assert verdict.on in q.said
    assert not re.search(
        rf"\b{exercise._solution.__name__}\b|{exercise.wrong[0].function.__name__}", q.code
    )
    assert f"def {name}(" in q.code


def test_a_question_for_a_learning_platform_has_one_right_option():
    q = quiz.question(exercises()["psnr"], 1)
    assert q is not None
    answers = ET.fromstring(quiz.moodle_xml(0, [q])).findall("question[@type='multichoice']/answer")
    assert [a.get("fraction") for a in answers].count("100") == 1
    assert answers[q.answer].findtext("text") == q.options[q.answer]
    with pytest.raises(ValueError, match="passes"):
        quiz.judge_thoroughly(exercises()["psnr"], exercises()["psnr"]._solution)
