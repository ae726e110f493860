"""The bank of questions says what the checkers say."""

import re
import xml.etree.ElementTree as ET
from html import escape

import pytest
import quiz
from book.assemble import quiz_page

from gsfusion_nb.course import check, exercises
from gsfusion_nb.course.course import TITLES


@pytest.mark.ci
def test_most_wrong_answers_are_questions():
    questions = {q.name: q for q in quiz.bank() if q.code}
    assert len(questions) > 0.7 * sum(len(e.wrong) for e in exercises().values())
    for name, q in questions.items():
        assert len(set(q.options)) == 4, name
        assert not set(q.options) & set(quiz.NOT_OFFERED.get(name, ())), name
        assert all(len(reason) > 10 for reason in q.reasons), name
        compile(q.code, name, "exec")


def test_every_chapter_has_questions_about_concepts():
    questions = quiz.concepts()
    assert {q.chapter for q in questions} == set(TITLES)
    assert len({q.name for q in questions}) == len(questions) >= 30
    for q in questions:
        assert len(set(q.options)) == len(set(q.reasons)) == 4, q.name
        assert q.prompt.endswith("?"), q.name
        assert all(reason.endswith(".") for reason in q.reasons), q.name
    assert len({q.answer for q in questions}) == 4  # the right one is not always the first


def test_every_answer_has_its_reason_in_the_book_and_on_a_learning_platform():
    concept = quiz.concepts()[0]
    function = quiz.question(exercises()["psnr"], 1)
    assert function is not None
    page = quiz_page(0, [concept, function])
    xml = quiz.moodle_xml(0, [concept, function])
    given = [e.findtext("text") for e in ET.fromstring(xml).iter("feedback")]
    for q in (concept, function):
        for reason in q.reasons:
            assert escape(reason) in page
            assert f"<p>{escape(reason)}</p>" in given
    assert page.count("```python") == 1


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
