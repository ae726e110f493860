"""A bank of multiple-choice questions with a reason for each answer: about concepts and
predictions, and one for each wrong answer of which a checker also finds something true.

The first are in ``quiz_concepts.toml``. Each of the others shows a function and four statements, of
which the checker finds one broken: the first property that fails. The other three were tested on
the same function by the same checker, and hold. A property can hold on all inputs of the checker
and yet not be true of the function; those that a reader found are left out (``NOT_OFFERED``).

``python tools/quiz.py OUT`` writes for every chapter ``chapter_NN.xml``, which Moodle and other
learning platforms import. The web book has the same questions to read and answer.
"""

import argparse
import ast
import logging
import random
import re
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

from gsfusion_nb.course.attempt import Attempt, Failed, LocalSubject
from gsfusion_nb.course.exercise import Exercise, exercises, source_of
from gsfusion_nb.files import write_file

log = logging.getLogger(__name__)

PROMPT = "Which of these statements does the checker find broken?"
INTRODUCTION = (
    "First come questions about concepts and predictions. Each of the others shows a function that "
    "somebody might hand in; none of them is right. "
    "`correct_...` stands for a "
    "right function of that name; names that are not explained are those of the chapter."
)


class Judged(Attempt):
    """An attempt at which a statement that fails is noted, and the judge goes on."""

    def __init__(self, function: Callable[..., Any]):
        super().__init__(LocalSubject(function))
        self.broken: list[Failed] = []
        """Properties that failed, the first one first."""
        self.held: dict[str, list[str]] = {}
        """Properties that were tested, and the inputs on which they were."""

    def holds(self, condition: Any, prop: str, **more: Any) -> None:
        """Note the property, and whether it fails."""
        with self._noting(prop):
            super().holds(condition, prop, **more)

    def close(
        self,
        got: Any,
        answer: Any,
        prop: str,
        **more: Any,
    ) -> None:
        """Note the property, and whether it fails."""
        with self._noting(prop):
            super().close(got, answer, prop, **more)

    @contextmanager
    def _noting(self, prop: str) -> Iterator[None]:
        inputs = self.held.setdefault(prop, [])
        if self.words not in inputs:
            inputs.append(self.words)
        try:
            yield
        except Failed as e:
            self.broken.append(e)


def judge_thoroughly(exercise: Exercise, function: Callable[..., Any]) -> Judged:
    """Run the judge of an exercise on a function to its end, or to an error from which it cannot go
    on.

    Raises:
        ValueError: no property fails, so the function is no wrong answer.
    """
    judge = Judged(function)
    try:
        exercise.judge(judge)
    except Failed as e:
        judge.broken.append(e)
    except Exception:
        if not judge.broken:
            raise
    if not judge.broken:
        raise ValueError(f"{exercise.name}: {function.__name__} passes, so it is no wrong answer")
    return judge


NOT_OFFERED: dict[str, list[str]] = tomllib.loads(
    Path(__file__).with_name("quiz_not_offered.toml").read_text(encoding="utf-8")
)
"""Exercise and number of a wrong answer -> properties that hold on the inputs of the checker
only."""

_ALWAYS = "it can be called with the arguments that the exercise names"


@dataclass(frozen=True, kw_only=True)
class Question:
    """One question, and what to say after the answer."""

    name: str
    """Exercise and number of the wrong answer, counted from 1; or a name."""
    chapter: int
    title: str
    """What the exercise asks for; empty for a concept."""
    code: str
    """The function; empty for a concept."""
    prompt: str
    options: tuple[str, ...]
    answer: int
    """Position of the right option."""
    reasons: tuple[str, ...]
    """Why each option is right or wrong."""

    @property
    def said(self) -> str:
        """The reason of the right option. Of a function it is the checker's sentence: what fails,
        on which input, what came back and what was expected."""
        return self.reasons[self.answer]


def bank() -> list[Question]:
    """All questions, by chapter; those about concepts first."""
    questions = (
        question(e, number) for e in exercises().values() for number in range(1, len(e.wrong) + 1)
    )
    both = [*concepts(), *(q for q in questions if q is not None)]
    return sorted(both, key=lambda q: q.chapter)


def concepts() -> list[Question]:
    """The questions of ``quiz_concepts.toml``."""
    text = Path(__file__).with_name("quiz_concepts.toml").read_text(encoding="utf-8")
    return [
        _concept(int(key.removeprefix("chapter_")), entry)
        for key, entries in tomllib.loads(text).items()
        for entry in entries
    ]


def _concept(chapter: int, entry: dict[str, Any]) -> Question:
    order = list(range(len(entry["options"])))
    random.Random(entry["name"]).shuffle(order)
    options = [entry["options"][i] for i in order]
    return Question(
        name=entry["name"],
        chapter=chapter,
        title="",
        code="",
        prompt=entry["question"],
        options=tuple(text for text, _ in options),
        answer=order.index(0),
        reasons=tuple(reason for _, reason in options),
    )


def question(exercise: Exercise, number: int) -> Question | None:
    """The question about wrong answer ``number`` of an exercise; ``None`` if fewer than two others
    are left."""
    function = exercise.wrong[number - 1].function
    name = f"{exercise.name}-{number}"
    judge = judge_thoroughly(exercise, function)
    first = judge.broken[0]
    broken = {e.prop for e in judge.broken}
    properties = [
        prop
        for prop in dict.fromkeys(judge.held)
        if prop not in {*broken, *NOT_OFFERED.get(name, ())}
    ]
    random.Random(name).shuffle(properties)
    if len(properties) < 2:
        return None
    options = [first.prop, *[*properties, _ALWAYS][:3]]
    random.Random(name).shuffle(options)
    said = (
        f"not true is: {first.prop}. Input: {first.on}. "
        f"{first.detail[:1].upper()}{first.detail[1:]}"
    )
    reasons = {
        prop: f"This holds. Tested with: {'; '.join(judge.held[prop])}." for prop in judge.held
    }
    reasons |= {first.prop: said, _ALWAYS: "This holds: the checker called it."}
    return Question(
        name=name,
        chapter=exercise.chapter,
        title=exercise.title,
        code=snippet(exercise, function),
        prompt=PROMPT,
        options=tuple(options),
        answer=options.index(first.prop),
        reasons=tuple(reasons[option] for option in options),
    )


def snippet(exercise: Exercise, function: Callable[..., Any]) -> str:
    """Source code of a wrong answer without remarks; a call of the course's solution becomes
    ``correct_<exercise>``."""
    tree = ast.parse(source_of(exercise.name, function, exclude=exercise._solution))
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.FunctionDef)
            and ast.get_docstring(node) is not None
            and len(node.body) > 1
        ):
            del node.body[0]
    solution = exercise._solution.__name__
    return re.sub(rf"\b{re.escape(solution)}\b", f"correct_{exercise.name}", ast.unparse(tree))


def by_chapter(questions: Iterable[Question]) -> dict[int, list[Question]]:
    """Questions of each chapter, in their order."""
    return {chapter: list(own) for chapter, own in groupby(questions, key=lambda q: q.chapter)}


def moodle_xml(chapter: int, questions: list[Question]) -> str:
    """The questions of a chapter in Moodle's XML, with a reason for each answer."""
    quiz = ET.Element("quiz")
    category = ET.SubElement(quiz, "question", type="category")
    _text(ET.SubElement(category, "category"), f"$course$/gsfusion_nb/chapter {chapter:02}")
    for q in questions:
        question = ET.SubElement(quiz, "question", type="multichoice")
        _text(ET.SubElement(question, "name"), q.name)
        about = f"<p>{escape(q.title)}</p><pre>{escape(q.code)}</pre>" if q.code else ""
        question_html = f"{about}<p>{escape(q.prompt)}</p>"
        _text(ET.SubElement(question, "questiontext", format="html"), question_html)
        _text(ET.SubElement(question, "generalfeedback", format="html"), f"<p>{escape(q.said)}</p>")
        ET.SubElement(question, "single").text = "true"
        ET.SubElement(question, "shuffleanswers").text = "true"
        for i, option in enumerate(q.options):
            fraction = "100" if i == q.answer else "0"
            answer = ET.SubElement(question, "answer", fraction=fraction, format="html")
            _text(answer, escape(option))
            feedback = ET.SubElement(answer, "feedback", format="html")
            _text(feedback, f"<p>{escape(q.reasons[i])}</p>")
    ET.indent(quiz)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(quiz, encoding="unicode") + "\n"


def _text(parent: ET.Element, text: str) -> None:
    ET.SubElement(parent, "text").text = text


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Write the bank of quiz questions.")
    parser.add_argument("out", type=Path, help="folder for Moodle's XML")
    target = parser.parse_args(arguments).out
    questions = bank()
    for chapter, own in by_chapter(questions).items():
        write_file(target / f"chapter_{chapter:02}.xml", moodle_xml(chapter, own))
    log.info("%d questions in %s", len(questions), target)


if __name__ == "__main__":
    logging.basicConfig(format="%(message)s")  # other modules say only what goes wrong
    log.setLevel(logging.INFO)
    main()
