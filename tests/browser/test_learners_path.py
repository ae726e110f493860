"""A learner's path in JupyterLab, every exercise typed into its cell: the short path, and chapters
2 to 6.

The functions of chapters 2 to 5 reach chapter 6 through the course file, and map a room there. Of
three of them only imports, settings and exercises are opened; that all their cells run is tested
without a browser. The chapters run in ``make campaign`` only.
"""

import json
import os
import re
from pathlib import Path

import pytest
from quick_run import on_one_thread, quick

from gsfusion_nb.course import exercises
from gsfusion_nb.course.copies import learner_copy
from gsfusion_nb.course.short_path import short_path

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
CHAPTERS = (2, 3, 4, 5, 6)
ONLY_EXERCISES = (2, 4, 5)

CELL = """words => {
    const notebook = window.jupyterapp.shell.currentWidget.content;
    const sources = notebook.widgets.map(w => w.model.sharedModel.getSource());
    notebook.activeCellIndex = sources.findIndex(source => source.includes(words));
    notebook.activeCell.node.scrollIntoView();
    return notebook.activeCellIndex;
}"""
SOURCE = (
    "i => window.jupyterapp.shell.currentWidget.content.widgets[i].model.sharedModel.getSource()"
)


def chapter(number, solutions_in):
    """The solutions of a chapter by exercise, and its unsolved edition in its quick version."""
    import nbformat

    path = next(NOTEBOOKS.glob(f"{number:02}_*.ipynb"))
    notebook = json.loads(path.read_text(encoding="utf-8"))
    solutions = {name: source.rstrip() for name, source in solutions_in(notebook).items()}
    assert set(solutions) == {e.name for e in exercises().values() if e.chapter == number}
    edition = json.dumps(learner_copy(notebook))
    assert not any(json.dumps(source)[1:-1] in edition for source in solutions.values())
    opened = on_one_thread(quick(json.loads(edition)))
    if number in ONLY_EXERCISES:
        opened["cells"] = exercise_cells(opened["cells"], set(solutions))
    return solutions, nbformat.from_dict(opened)


def exercise_cells(cells, names):
    """The cells up to the settings, and those with an exercise or a check."""
    first = 1 + next(
        i for i, cell in enumerate(cells) if "parameters" in cell["metadata"].get("tags", [])
    )
    wanted = re.compile(rf"^(def ({'|'.join(names)})\(|check\.)", re.MULTILINE)
    codes = [cell for cell in cells[first:] if cell["cell_type"] == "code"]
    return cells[:first] + [cell for cell in codes if wanted.search("".join(cell["source"]))]


def type_into(page, name, solution):
    """Click into the cell of an exercise, select what is there, and type; what stands before the
    function stays."""
    index = page.evaluate(CELL, f"def {name}(")
    before = page.evaluate(SOURCE, index).partition(f"def {name}(")[0]
    source = solution if solution.startswith(before) else before + solution
    editor = page.locator(".jp-Notebook .jp-Cell").nth(index)
    editor.locator(".cm-content").first.click()
    page.keyboard.press("Control+a")
    page.keyboard.insert_text(source)
    assert page.evaluate(SOURCE, index) == source


def test_the_short_path_is_walked_by_typing(lab, solutions_in):
    import nbformat

    notebook = short_path(NOTEBOOKS)
    solutions = {name: source.rstrip() for name, source in solutions_in(notebook).items()}
    assert len(solutions) == 5
    typed(
        lab,
        solutions,
        nbformat.from_dict(on_one_thread(quick(learner_copy(notebook)))),
    ).close()
    assert lab.errors == []


def typed(lab, solutions, notebook):
    """The page of a notebook in which these solutions were typed, and all passed."""
    page = lab.open_notebook(
        notebook,
        before=lambda page: [type_into(page, *item) for item in solutions.items()],
        timeout_s=1200,
    )
    for name in solutions:
        verdict = page.locator(".gsnb-verdict.gsnb-passed", has_text=f"{name}: all checks pass")
        lab.wait_for(lambda verdict=verdict: verdict.count() > 0, f"the verdict on {name}")
    assert page.locator(".gsnb-verdict.gsnb-failed").count() == 0
    return page


@pytest.mark.skipif(
    "GSNB_CAMPAIGN" not in os.environ, reason="GSNB_CAMPAIGN is not set: make campaign sets it"
)
@pytest.mark.parametrize("number", CHAPTERS)
def test_every_exercise_is_solved_by_typing(lab, number, solutions_in):
    page = typed(lab, *chapter(number, solutions_in))
    if number == CHAPTERS[-1]:
        the_room_is_mapped_with_mine(lab, page)
    assert lab.errors == []
    page.close()


def the_room_is_mapped_with_mine(lab, page):
    """PSNR of both maps and the board, as the page shows them."""
    scores = dict(
        re.findall(
            r"(the library|your code) +\d+ Gaussians, ([\d.]+) dB",
            page.locator(".jp-Notebook").inner_text(),
        )
    )
    assert abs(float(scores["your code"]) - float(scores["the library"])) < 0.1, scores
    board = page.locator(
        ".jp-OutputArea-output", has_text="operations that have an exercise run your code"
    ).last
    text = board.inner_text()
    wanted = {
        e.becomes.operation
        for e in exercises().values()
        if e.becomes is not None and e.chapter in CHAPTERS
    }
    rows = {row.split()[0]: row for row in text.splitlines() if row.strip()}
    assert wanted <= set(rows), wanted - set(rows)
    for operation in wanted:
        assert "YOURS" in rows[operation], rows[operation]
        assert "reference" not in rows[operation], rows[operation]
    lab.screenshot(board, "06_board_mine")
