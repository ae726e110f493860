"""Copies of the notebooks have no solution; a learner's shows what to expect, and nobody's work is
overwritten."""

import copy
import json
import re
from pathlib import Path

import pytest

from gsfusion_nb.cli.course import run
from gsfusion_nb.course.copies import copy_for_class, hand_out, learner_copy, without_solutions

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))
PICTURE = {
    "output_type": "display_data",
    "metadata": {},
    "data": {"image/png": "abc", "text/plain": "<Image>"},
}


def text(source):
    return {"cell_type": "markdown", "metadata": {}, "source": source}


def shown(text):
    return {
        "output_type": "execute_result",
        "metadata": {},
        "execution_count": 2,
        "data": {"text/plain": [text]},
    }


def code(source, *outputs):
    return {
        "cell_type": "code",
        "metadata": {},
        "source": source,
        "outputs": list(outputs),
        "execution_count": 2,
    }


def notebook(*cells):
    return {"cells": [text("# Title"), *cells], "nbformat": 4}


def write(folder, chapter):
    folder.mkdir(exist_ok=True)
    (folder / "01_x.ipynb").write_text(json.dumps(chapter))


SOLVED = "### BEGIN SOLUTION\ndef f(x):\n    return 2 * x\n### END SOLUTION"


def test_solutions_go_and_the_rest_stays():
    notebook = {
        "cells": [
            text("Double it."),
            code("def f(x):\n    ..."),
            code(SOLVED),
            code(
                [
                    "a = 1\n",
                    "    ### BEGIN SOLUTION\n",
                    "a = 2\n",
                    "    ### END SOLUTION\n",
                    "b = 3",
                ]
            ),
            text("Why?\n<!-- BEGIN SOLUTION -->\nBecause.\n<!-- END SOLUTION -->\nGo on."),
            code(""),
        ],
        "metadata": {"m": 1},
        "nbformat": 4,
    }
    before = copy.deepcopy(notebook)
    student = without_solutions(notebook)
    assert notebook == before
    sources = ["".join(cell["source"]) for cell in student["cells"]]
    assert sources == ["Double it.", "def f(x):\n    ...", "a = 1\nb = 3", "Why?\nGo on.", ""]
    assert all(
        c["outputs"] == [] and c["execution_count"] is None
        for c in student["cells"]
        if c["cell_type"] == "code"
    )
    assert {k: student[k] for k in ("metadata", "nbformat")} == {
        "metadata": {"m": 1},
        "nbformat": 4,
    }


@pytest.mark.parametrize("source", ["### BEGIN SOLUTION\nx = 1", "x = 1\n### END SOLUTION"])
def test_a_marker_without_its_partner_is_refused(source, tmp_path):
    write(tmp_path / "in", {"cells": [code(source)]})
    with pytest.raises(ValueError, match=r"01_x.ipynb: cell 0"):
        copy_for_class(tmp_path / "in", tmp_path / "out")


@pytest.mark.parametrize("copies", [copy_for_class, hand_out])
def test_refuses_to_overwrite_the_notebooks(copies, tmp_path):
    with pytest.raises(ValueError, match="no notebook"):
        copies(tmp_path, tmp_path / "out")
    write(tmp_path, {"cells": []})
    with pytest.raises(ValueError, match="would replace"):
        copies(tmp_path, tmp_path)


def test_the_command_copies_the_course_for_a_class(tmp_path):
    assert run([str(tmp_path / "student"), "--for-class"]) == 0
    links = 0
    for path in (tmp_path / "student").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
            assert (tmp_path / "student" / target).is_file(), (path.name, target)
            links += 1
    assert links >= 11
    for path in NOTEBOOKS:
        student = (tmp_path / "student" / path.name).read_text(encoding="utf-8")
        assert "SOLUTION" not in student
        assert json.loads(student)["cells"]


CHAPTER = notebook(
    code("def f(x):\n    ..."),
    code("### BEGIN SOLUTION\ndef f(x):\n    return 2 * x\n### END SOLUTION"),
    code("check.f(f)", shown("✓ f: all <checks> pass")),
    code("g = check.f.working(f)\ng(3)", shown("f: your code is used."), PICTURE),
)


def test_a_learner_sees_what_to_expect_and_no_answer():
    learner = learner_copy(CHAPTER)
    assert "stored" in "".join(learner["cells"][1]["source"])
    unwritten, checked, used = learner["cells"][2:]
    assert unwritten["source"] == ["def f(x):\n", "    ..."]
    data = checked["outputs"][0]["data"]
    assert data["text/plain"] == ["what you should see: ✓ f: all <checks> pass"]
    assert "&lt;checks>" in data["text/html"][0]
    assert used["outputs"] == [PICTURE]
    assert [cell["execution_count"] for cell in (unwritten, checked, used)] == [None] * 3


NOT_SHOWN = "Not shown before you run this cell: it answers a question."


def test_what_comes_of_a_prediction_is_not_in_the_copy():
    stream = {"output_type": "stream", "name": "stdout", "text": ["frame 1: 189 new"]}
    cells = [
        code('predict(\n    "x", "?")', shown("Predict: ?\n  not predicted yet")),
        code("2 + 2", shown("4"), stream, PICTURE),
        code("check.f(f)", shown("✓ f: all checks pass")),
        code("3"),
        code('came("x", 4)', shown("You made no prediction. It came: 4.")),
        code("1", shown("1")),
    ]
    copied = learner_copy(notebook(*cells))["cells"][2:]
    texts = [[o["data"]["text/plain"] for o in cell["outputs"]] for cell in copied]
    note = [NOT_SHOWN]
    assert texts == [
        [["Predict: ?\n  not predicted yet"]],
        [note],
        [["what you should see: ✓ f: all checks pass"]],
        [],
        [note],
        [["1"]],
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_no_output_is_folded(path):
    # JupyterLab shows the first line of one, markup and answers too
    learner = learner_copy(json.loads(path.read_text(encoding="utf-8")))
    for cell in learner["cells"]:
        assert not cell["metadata"].get("collapsed")
        assert not cell["metadata"].get("jupyter", {}).get("outputs_hidden")
    assert "gsnb-outcome" not in json.dumps(learner)


def test_what_answers_a_guess_is_not_in_the_copy():
    stream = {"output_type": "stream", "name": "stdout", "text": ["frame 1: 189 new"]}
    cells = [
        code("0", shown("0")),
        text("Once more.\n\n> **Guess.** What share is new?"),
        text("### Exercise"),
        code("def f(x):\n    ..."),
        code("check.f(f)", shown("✓ f: all checks pass")),
        code("1", stream),
        code("2", PICTURE),
        text("It is 6 %."),
        code("3", shown("3")),
        text("> **Guess** before you drag."),
        text("> **Guess** this, too."),
        code("4", shown("A panel")),
    ]
    copied = learner_copy(notebook(*cells))["cells"][2:]
    texts = [
        [output["data"]["text/plain"][0] for output in cell["outputs"]]
        for cell in copied
        if cell["cell_type"] == "code"
    ]
    verdict = "what you should see: ✓ f: all checks pass"
    assert texts == [["0"], [], [verdict], [NOT_SHOWN], [NOT_SHOWN], ["3"], [NOT_SHOWN]]


def text_of(output) -> str:
    """What an output says, without its pictures."""
    return "".join(output.get("text") or output.get("data", {}).get("text/plain", ""))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_no_output_stands_right_below_a_question(path):
    learner = learner_copy(json.loads(path.read_text(encoding="utf-8")))
    says_no_answer = ("Predict: ", "what you should see: ✓ ", NOT_SHOWN)
    is_below = False
    questions = 0
    for cell in learner["cells"]:
        if "> **Guess" in "".join(cell["source"]):
            is_below = True
            questions += 1
        elif is_below and cell.get("outputs"):
            for output in cell["outputs"]:
                assert text_of(output).startswith(says_no_answer), (cell["id"], text_of(output))
            is_below = False
    assert questions >= 2


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_chapter_keeps_what_answers_no_question_and_no_solution(path):
    stored = json.loads(path.read_text(encoding="utf-8"))
    learner = learner_copy(stored)
    text = json.dumps(learner, ensure_ascii=False)
    assert "SOLUTION" not in text
    assert not re.search(r'["<>]✓ \w+: all checks', text)
    pictures = {c["id"]: json.dumps(c.get("outputs")).count('"image/') for c in stored["cells"]}
    kept = 0
    for cell in learner["cells"]:
        copied = json.dumps(cell.get("outputs", []))
        if cell["cell_type"] == "code" and NOT_SHOWN not in copied:
            assert copied.count('"image/') == pictures[cell["id"]]
            kept += 1
    assert kept >= 10


def test_a_notebook_that_is_there_stays(tmp_path):
    source = tmp_path / "notebooks"
    target = tmp_path / "course"
    write(source, CHAPTER)
    assert hand_out(source, target) == [target / "01_x.ipynb"]
    (target / "01_x.ipynb").write_text("mine")
    assert hand_out(source, target) == []
    assert (target / "01_x.ipynb").read_text() == "mine"


def test_no_copy_shows_the_comments_of_tests():
    for path in NOTEBOOKS:
        whole = json.loads(path.read_text(encoding="utf-8"))
        for copied in (learner_copy(whole), without_solutions(whole)):
            texts = [
                "".join(cell["source"])
                for cell in copied["cells"]
                if cell["cell_type"] == "markdown"
            ]
            assert not any("<!--" in text for text in texts), path.name
