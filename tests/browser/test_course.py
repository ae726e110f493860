"""A chapter as a student uses it: run all of it, drag the threshold, answer an exercise wrongly and
then rightly."""

import json
from pathlib import Path

import numpy as np
import pytest
from quick_run import on_one_thread, quick

from gsfusion_nb.course.copies import without_solutions

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

NOTEBOOK = Path(__file__).resolve().parents[2] / "notebooks" / "03_quadtree_decomposition.ipynb"

WRONG = """
def split_cell(x0, y0, width, height):
    w, h = width // 2, height // 2
    return [(x0 + i * w, y0 + j * h, w, h) for i in (0, 1) for j in (0, 1)]
"""
RIGHT = """
def split_cell(x0, y0, width, height):
    w, h = width // 2, height // 2
    left, right = (x0, w), (x0 + w, width - w)
    top, bottom = (y0, h), (y0 + h, height - h)
    return [(x, y, cw, ch) for x, cw in (left, right) for y, ch in (top, bottom)]
"""


def students_copy():
    """The whole chapter as a student gets it, in its quick version."""
    import nbformat

    notebook = without_solutions(json.loads(NOTEBOOK.read_text(encoding="utf-8")))
    return nbformat.from_dict(on_one_thread(quick(notebook)))


@pytest.fixture(scope="module")
def page(lab):
    page = lab.open_notebook(students_copy())
    yield page
    page.close()


def count(page):
    return int(page.locator(".gsnb-quadtree-count").inner_text().replace(",", ""))


def test_the_chapter_runs_to_its_end_with_live_widgets(lab, page):
    assert "Error displaying widget" not in page.content()
    for picture in page.locator(".jp-OutputArea-output img").all():
        assert picture.evaluate("image => image.naturalWidth") > 0
    assert page.locator(".gsnb-quadtree-image img").count() == 1
    assert page.locator(".gsnb-verdict").count() >= 3  # one below each exercise
    assert lab.errors == []


def test_dragging_the_threshold_changes_picture_and_count(lab, page):
    picture = page.locator(".gsnb-quadtree-image img")
    handle = page.locator(".gsnb-quadtree-threshold .noUi-handle")
    picture.scroll_into_view_if_needed()
    before = lab.screenshot(picture, "quadtree_before")
    cells = count(page)
    assert before.std() > 20
    handle.scroll_into_view_if_needed()  # the controls may stand below the picture
    box = handle.bounding_box()
    x = box["x"] + box["width"] / 2
    y = box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(x + 5 * step, y)
    page.mouse.up()
    lab.wait_for(lambda: count(page) < cells / 2, "fewer cells at a larger threshold")
    lab.wait_for(
        lambda: np.abs(lab.screenshot(picture, "quadtree_after") - before).mean() > 1,
        "another picture",
    )
    assert lab.errors == []


def run_cell(page, containing, source=None):
    """Run the first cell that contains some words, with another source if given."""
    script = """([words, source]) => {
        const notebook = window.jupyterapp.shell.currentWidget.content;
        const sources = notebook.widgets.map(w => w.model.sharedModel.getSource());
        const index = sources.findIndex(source => source.includes(words));
        if (source !== null) notebook.widgets[index].model.sharedModel.setSource(source);
        notebook.activeCellIndex = index;
        notebook.deselectAll();
        return window.jupyterapp.commands.execute("notebook:run-cell");
    }"""
    page.evaluate(script, [containing, source])


def test_an_exercise_is_grey_then_red_then_green(lab, page):
    verdict = page.locator(".gsnb-verdict", has_text="split_cell")
    verdict.first.scroll_into_view_if_needed()
    assert "not written" in verdict.inner_text()
    for source, state, words in (
        (WRONG, "failed", "every pixel of the cell is in exactly one part"),
        (RIGHT, "passed", "all checks pass"),
    ):
        run_cell(page, "def split_cell", source)
        run_cell(page, "check.split_cell(split_cell)")
        shown = page.locator(f".gsnb-verdict.gsnb-{state}", has_text="split_cell")
        lab.wait_for(lambda shown=shown: shown.count() == 1, f"the verdict {state}")
        assert words in shown.inner_text()
        lab.screenshot(shown, f"verdict_{state}")
    assert lab.errors == []
    assert lab.requests == []
