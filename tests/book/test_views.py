"""Live views without a kernel: which cells they need, and what is recorded of them."""

import base64
import json
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from book.record import (
    cells_to_run,
    kernel_views,
    record,
    record_all,
    run,
    wanted_views,
)
from book.recorded import needed_cells
from book.recorders import record_panel

from gsfusion_nb.files import read_object
from gsfusion_nb.types import Camera, GaussianParams
from gsfusion_nb.viz import MixMicroscope, PixelMicroscope, amdahl_panel

from ..conftest import over_a_surface

ROOT = Path(__file__).resolve().parents[2]


CAMERA = Camera(width=40, height=30, fx=30.0, fy=30.0, cx=20.0, cy=15.0)
PIXELS = [(0, 0), (20, 15), (13, 22), (39, 29)]


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
    with pytest.raises(TypeError, match="no recorder for int"):
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


def test_every_live_view_of_a_chapter_is_recorded_or_says_that_it_needs_a_kernel():
    views = ROOT / "docs/book/views.toml"
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        known = {*wanted_views(views, notebook.name[:2]), *kernel_views(views, notebook.name[:2])}
        for cell in read_object(notebook, "a notebook")["cells"]:
            for data in [output.get("data", {}) for output in cell.get("outputs", ())]:
                picture_only = "".join(data.get("text/plain", "")).startswith("<IPython.core.display.Image")
                if not picture_only and {"image/jpeg", "image/png"} & set(data):
                    assert cell["id"] in known, f"{notebook.name}, cell {cell['id']}: {data['text/plain']}"


def test_the_page_blends_a_pixel_as_the_renderer_does(node, tmp_path):
    microscope = PixelMicroscope(cloud(), CAMERA, torch.eye(4))
    found = in_node(node, tmp_path, record(microscope).data, "stackAt(splats, u, v)")
    for (u, v), page in zip(PIXELS, found, strict=True):
        stack = microscope.set(u=u, v=v).stack
        assert [one["row"] for one in page["stack"]] == stack.row.tolist()
        for name, values in (("weight", stack.weight), ("light", stack.transmittance), ("depth", stack.depth_m)):
            np.testing.assert_allclose([one[name] for one in page["stack"]], values, atol=1e-5)
        np.testing.assert_allclose(page["colour"], stack.colour, atol=1e-5)
        assert page["light"] == pytest.approx(stack.light_left, abs=1e-5)
    assert max(len(page["stack"]) for page in found) > 5


def test_the_page_mixes_a_pixel_as_gps_slam_does(node, tmp_path):
    microscope = MixMicroscope(over_a_surface(cloud()), CAMERA, torch.eye(4))
    data = record(microscope).data
    call = "mixAt(splats, { values: floats(data.below), width: data.width, behind: data.behind }, u, v)"
    found = in_node(node, tmp_path, data, call)
    mixes = [microscope.set(u=u, v=v).stack for u, v in PIXELS]
    for mix, page in zip(mixes, found, strict=True):
        assert [one["row"] for one in page["stack"]] == mix.row.tolist()
        np.testing.assert_allclose([one["weight"] for one in page["stack"]], mix.weight, atol=1e-5)
        np.testing.assert_allclose(page["colour"], mix.colour, atol=1e-5)
        assert page["hidden"] == mix.hidden
        assert page["surface"]["weight"] == pytest.approx(mix.base_weight)
    assert max(mix.hidden for mix in mixes) > 2
    assert max(len(mix) for mix in mixes) > 5
    assert {mix.base_weight for mix in mixes} > {1.0}
    order = in_node(node, tmp_path, data, "shuffled([0, 1, 2, 3, 4, 5, 6, 7], u + 1000 * v)")
    assert all(sorted(one) == list(range(8)) for one in order)
    assert len({tuple(one) for one in order}) == len(PIXELS)


def cloud() -> GaussianParams:
    """Sixty Gaussians in front of the camera."""
    generator = torch.Generator().manual_seed(3)
    n = 60
    rand = lambda *size: torch.rand(*size, generator=generator)  # noqa: E731
    return GaussianParams(
        xyz_W=torch.cat([rand(n, 2) - 0.5, 1 + rand(n, 1)], 1), log_scale=-3 + rand(n, 3), quat=rand(n, 4) - 0.5,
        opacity_logit=4 * rand(n) - 1, sh=rand(n, 4, 3),
    )  # fmt: skip


def in_node(node, folder: Path, data: dict, call: str) -> list:
    """The values of an expression of the page's scripts at every pixel, without a page."""
    script = (
        """
        const data = DATA, floats = (text) => new Float32Array(Uint8Array.from(Buffer.from(text, "base64")).buffer);
        const splats = splatsOf(floats(data.splats));
        console.log(JSON.stringify(PIXELS.map(([u, v]) => CALL)));
    """.replace("DATA", json.dumps(data))
        .replace("PIXELS", json.dumps(PIXELS))
        .replace("CALL", call)
    )
    scripts = [ROOT / "tools/book/static" / name for name in ("pixel_stack.js", "pixel_mix.js")]
    (folder / "run.mjs").write_text("".join(path.read_text() for path in scripts) + script)
    done = subprocess.run([node, folder / "run.mjs"], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_a_trace_tells_the_stories_of_pixels_gaussians_and_voxels(recorded_views):
    view = recorded_views["trace"]
    stories, follows = view.data["stories"], view.data["follows"]
    assert stories[0]["name"] == "pixel (20, 15)"
    assert set(follows) == {"pixel", "Gaussian", "voxel"}
    for kind, clicks in follows.items():
        assert clicks, kind
        for _u, _v, story in clicks:
            assert stories[story]["name"].startswith(kind)
    for story in stories:
        serials = [moment[0] for moment in story["moments"]]
        assert serials == sorted(serials)
        assert len(serials) <= story["count"]
    assert {moment[1] for story in stories for moment in story["moments"]} == set(view.pictures)


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
