"""Live views without a kernel: which cells they need, and what is recorded of them."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsfusion_nb.book.views.all_chapters import put_views, record_all, view_html
from gsfusion_nb.book.views.needed import needed_cells
from gsfusion_nb.book.views.panels import record_panel
from gsfusion_nb.book.views.record import cells_to_run, record, run, wanted_views, write
from gsfusion_nb.book.views.scripts import front_ends
from gsfusion_nb.strict_json import read_object
from gsfusion_nb.viz import amdahl_panel

ROOT = Path(__file__).resolve().parents[2]


def code(name: str, source: str) -> dict:
    return {"cell_type": "code", "id": name, "source": source}


CELLS = [
    code("imports", "import math\nfrom os import path as p"),
    code("early", "x = 1"),
    code("unused", "y = 2\nraise RuntimeError"),
    code("late", "def f(a):\n    return a + x"),
    code("again", "x = x + math.floor(1.5)"),
    code("changes", "seen = []\nseen.append(x)"),
    code("view", "z = f(x)\n(z, seen)"),
    code("after", "x = 9"),
]


def test_a_view_needs_the_cells_that_bind_its_names():
    assert needed_cells(CELLS, "view") == ["imports", "early", "late", "again", "changes", "view"]
    assert needed_cells(CELLS, "late") == ["early", "late"]
    assert "unused" in needed_cells(CELLS, "view", also=["unused"])
    with pytest.raises(ValueError, match="no code cell gone"):
        needed_cells(CELLS, "gone")


def test_every_view_of_the_book_is_a_cell_whose_grids_are_small():
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        wanted = wanted_views(ROOT / "docs/book/views.toml", notebook.name[:2])
        ran = [cell for cell, _ in cells_to_run(read_object(notebook, "a notebook"), wanted)]
        assert set(wanted) <= set(ran), f"{notebook.name}: {set(wanted) - set(ran)}"


def test_cells_run_in_their_order_and_the_value_of_a_view_is_recorded():
    cells = [("a", "from gsfusion_nb.viz import amdahl_panel\ns = {'fuse': 1.0}"), ("b", "amdahl_panel(s)")]
    found = run(cells, {}, {"b": {"grids": [["fuse:3"]]}})
    assert [len(view.pictures) for view in found.values()] == [3]
    with pytest.raises(TypeError, match="no recorder for int; known: Panel, Stepper"):
        record(3)


def test_a_panel_has_a_picture_for_every_place_of_its_grid(recorded_views):
    panel = recorded_views["panel"]
    fuse, optimise = panel.data["controls"]
    assert len(fuse["words"]) == 5
    assert len(optimise["words"]) == 3
    assert fuse["words"][fuse["start"]] == "10.0"  # where the chapter has it is one of the positions
    assert len(panel.pictures) == len(panel.data["grids"][0]["captions"]) == 15
    pictures = {
        name: np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), 1)) for name, data in panel.pictures.items()
    }
    assert not np.array_equal(pictures["0_0_0.webp"], pictures["0_4_2.webp"])
    assert "times as fast" in panel.data["grids"][0]["alts"][0]
    with pytest.raises(ValueError, match="at most 150"):
        record_panel(amdahl_panel({"a": 1.0, "b": 1.0}), [["a:40", "b:40"]])


def test_viewers_carry_their_data(recorded_views):
    splat, mesh = recorded_views["splat"], recorded_views["mesh"]
    assert splat.data["head"]["n"] == 3
    assert len(base64.b64decode(splat.data["buffers"][0])) == 3 * splat.data["head"]["stride"]
    assert splat.data["traits"]["width"] == 160
    assert [len(base64.b64decode(text)) for text in mesh.data["buffers"]] == [36, 24, 9]


def test_the_files_of_a_view_are_where_its_page_looks(recorded_views, tmp_path):
    write({"cell": recorded_views["panel"]}, tmp_path / "views/03_x")
    listed = {"03_x.ipynb": json.loads((tmp_path / "views/03_x/views.json").read_text())}
    put_views(listed, tmp_path / "views", tmp_path / "site")
    html = view_html(listed, "notebooks/03_x.ipynb", "cell") or ""
    assert 'data-src="03_x_files/cell.view.js"' in html
    assert (tmp_path / "site/notebooks/03_x_files/cell.view.js").read_text().startswith('gsnbView("cell", {')
    assert (tmp_path / "site/notebooks/03_x_files/cell/0_0_0.webp").exists()
    assert view_html(listed, "notebooks/03_x.ipynb", "other") is None


def test_the_viewers_scripts_are_no_modules():
    for name, text in front_ends().items():
        assert "\nexport " not in text, name
        assert "\nimport " not in text, name


@pytest.mark.ci
def test_a_chapter_is_recorded_by_a_process_of_its_own_and_once(tmp_path):
    cells = [
        {
            **code("made", "from gsfusion_nb.viz import amdahl_panel\npanel = amdahl_panel({'fuse': 1.0})"),
            "outputs": [],
        },
        {**code("shown", "panel"), "outputs": []},
    ]
    notebook, views = tmp_path / "03_x.ipynb", tmp_path / "views.toml"
    notebook.write_text(json.dumps({"cells": cells}))
    views.write_text('[chapter_03.shown]\ngrids = [["fuse:3"]]\n')
    out = tmp_path / "new" / "views"
    listed = record_all([notebook], views, out)
    assert listed["03_x.ipynb"]["shown"]["kind"] == "panel"
    assert len(list((out / "03_x/shown").glob("*.webp"))) == 3
    mark = out / "03_x/shown.view.js"
    before = mark.stat().st_mtime_ns
    assert record_all([notebook], views, out) == listed
    assert mark.stat().st_mtime_ns == before
