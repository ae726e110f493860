"""The bank of questions as files: Markdown to read, and what learning platforms import.

``python tools/quiz_files.py NOTEBOOKS PAGES IMPORTS`` writes the pages ``chapter_NN.md`` and
``answers.md`` into the folder PAGES, and for every chapter ``chapter_NN.xml`` (Moodle) and ``chapter_NN.text2qti.txt``
(the program text2qti turns it into QTI, which Canvas imports) into the folder IMPORTS.
"""

import argparse
import logging
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from html import escape
from itertools import groupby
from pathlib import Path

from quiz import Question, bank

from gsfusion_nb.course.course import TITLES
from gsfusion_nb.files import atomic_file

log = logging.getLogger(__name__)


def by_chapter(questions: Iterable[Question]) -> dict[int, list[Question]]:
    """Questions of each chapter, in their order."""
    return {chapter: list(own) for chapter, own in groupby(questions, key=lambda q: q.chapter)}


def chapter_page(chapter: int, questions: list[Question]) -> str:
    """The questions of a chapter in Markdown, without answers."""
    lines = [
        f"# Quiz, chapter {chapter}: {TITLES.get(chapter, '')}",
        "",
        f"{len(questions)} questions. Each shows a function that somebody might hand in; none of them is right. "
        "`correct_...` stands for a right function of that name; names that are not explained are those of the "
        "chapter. The answers: [answers](answers.md).",
    ]
    for exercise, own in groupby(questions, key=lambda q: q.exercise):
        group = list(own)
        lines += ["", f"## `{exercise}`", "", group[0].title]
        lines += ["", f"In the notebook: *{_markdown(group[0].task)}*"] if group[0].task else []
        for q in group:
            lines += ["", f"**{q.name}**", "", "```python", q.code, "```", "", _markdown(q.prompt, keep_bold=True), ""]
            lines += [f"- {'ABCD'[i]}. {_markdown(option)}" for i, option in enumerate(q.options)]
    return "\n".join(lines) + "\n"


def answers_page(questions: list[Question]) -> str:
    """The right options, with what the checker says, in Markdown."""
    lines = [
        "# Quiz: answers",
        "",
        "The letter, the property that the checker names first, the input, and what came back. `make quiz` writes this "
        "page and the questions from the course's exercises.",
    ]
    for chapter, own in by_chapter(questions).items():
        lines += ["", f"## Chapter {chapter}: {TITLES.get(chapter, '')}", "", "| question | | the checker says |"]
        lines += ["|---|---|---|"]
        for q in own:
            said = f"{q.prop}. Input: {q.on}. {q.detail[:1].upper()}{q.detail[1:]}"
            lines += [f"| `{q.name}` | {'ABCD'[q.answer]} | {_markdown(said).replace('|', chr(92) + '|')} |"]
    return "\n".join(lines) + "\n"


def moodle_xml(chapter: int, questions: list[Question]) -> str:
    """The questions of a chapter in Moodle's XML; every option's feedback is the checker's sentence."""
    quiz = ET.Element("quiz")
    category = ET.SubElement(quiz, "question", type="category")
    _text(ET.SubElement(category, "category"), f"$course$/gsfusion_nb/chapter {chapter:02}")
    for q in questions:
        question = ET.SubElement(quiz, "question", type="multichoice")
        _text(ET.SubElement(question, "name"), q.name)
        _text(ET.SubElement(question, "questiontext", format="html"), _html(q))
        _text(ET.SubElement(question, "generalfeedback", format="html"), f"<p>{escape(_feedback(q))}</p>")
        for tag, value in {"defaultgrade": "1", "penalty": "0.3333333", "hidden": "0", "single": "true",
                           "shuffleanswers": "true", "answernumbering": "abc"}.items():  # fmt: skip
            ET.SubElement(question, tag).text = value
        for i, option in enumerate(q.options):
            answer = ET.SubElement(question, "answer", fraction="100" if i == q.answer else "0", format="html")
            _text(answer, escape(option))
            _text(ET.SubElement(answer, "feedback", format="html"), "")
    ET.indent(quiz)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(quiz, encoding="unicode") + "\n"


def text2qti(chapter: int, questions: list[Question]) -> str:
    """The questions of a chapter as the program text2qti reads them."""
    parts = [f"Quiz title: gsfusion_nb, chapter {chapter}: {TITLES.get(chapter, '')}"]
    for number, q in enumerate(questions, start=1):
        body = [f"`{q.name}`: {q.title}", "", "```python", *q.code.splitlines(), "```", "", q.prompt]
        first, *rest = body
        start = f"{number}.  "
        lines = [start + first, *(" " * len(start) + line if line else "" for line in rest)]
        lines += [f"... {_qti(_feedback(q))}"]
        lines += [f"{'*' if i == q.answer else ''}{'abcd'[i]})  {_qti(option)}" for i, option in enumerate(q.options)]
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _feedback(q: Question) -> str:
    return f"What does not hold: {q.prop}. Input: {q.on}. {q.detail[:1].upper()}{q.detail[1:]}"


def _html(q: Question) -> str:
    task = f"<p><em>{escape(q.task)}</em></p>" if q.task else ""
    prompt = re.sub(r"\*\*(\w+)\*\*", r"<strong>\1</strong>", escape(q.prompt))
    return f"<p>{escape(q.title)}</p>{task}<pre>{escape(q.code)}</pre><p>{prompt}</p>"


def _text(parent: ET.Element, text: str) -> None:
    ET.SubElement(parent, "text").text = text


def _markdown(text: str, *, keep_bold: bool = False) -> str:
    """Text in which Markdown finds no emphasis and no HTML."""
    text = re.sub(r"([_<\\])", r"\\\1", text)
    return text if keep_bold else text.replace("*", r"\*")


def _qti(text: str) -> str:
    return re.sub(r"([\\`*_<$\[\]^~])", r"\\\1", text)


def pages(questions: list[Question]) -> dict[str, str]:
    """Markdown pages by file name."""
    files = {f"chapter_{n:02}.md": chapter_page(n, own) for n, own in by_chapter(questions).items()}
    return files | {"answers.md": answers_page(questions)}


def imports(questions: list[Question]) -> dict[str, str]:
    """Files for learning platforms by file name."""
    files = {}
    for n, own in by_chapter(questions).items():
        files |= {
            f"chapter_{n:02}.xml": moodle_xml(n, own),
            f"chapter_{n:02}.text2qti.txt": text2qti(n, own),
        }
    return files


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Write the bank of quiz questions.")
    parser.add_argument("notebooks", type=Path, help="folder of notebooks")
    parser.add_argument("out", type=Path, help="folder for Markdown pages, Moodle XML and text2qti")
    options = parser.parse_args(arguments)
    questions = bank(options.notebooks)
    files = pages(questions) | imports(questions)
    for name, text in files.items():
        with atomic_file(options.out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    log.info("%d questions in %d files in %s", len(questions), len(files), options.out)


if __name__ == "__main__":
    logging.basicConfig(format="%(message)s")  # other modules say only what goes wrong
    log.setLevel(logging.INFO)
    main()
