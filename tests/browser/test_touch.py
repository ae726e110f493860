"""Pictures that are dragged: the picture follows, no queue builds up, and the sliders move
along."""

import json
import os
import statistics
from pathlib import Path

import numpy as np
import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

MOVES = 15

SCENES = """
import torch
torch.set_num_threads(1)
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.data.room import RoomSequence, render_room
from gsfusion_nb.tsdf import TsdfVolume
from gsfusion_nb.types import Camera, Frame
from gsfusion_nb.viz import one_gaussian_panel, point_panel, tsdf_fill_panel
room = RoomSequence(n_frames=60, width=320, height=240)
small = room.camera.resized(160, 120)
def look(T_WC):
    rgb, depth_m = render_room(small, T_WC)
    return Frame(index=0, timestamp_s=0.0, rgb=rgb, depth_m=depth_m, camera=small, T_WC=T_WC)
"""
FILL = """
volume = TsdfVolume(TsdfConfig(voxel_size_m=0.04, truncation_voxels=4.0))
fill = tsdf_fill_panel(volume, room.camera, look, start=(0.4, -0.4, 100.0)).press("measure")
fill
"""
ONE = (
    "one = one_gaussian_panel(Camera(width=80, height=60, fx=52.0, fy=52.0, cx=40.0, cy=30.0))\none"
)
POINTS = "points = point_panel(room[0])\npoints"

METER = """(image) => {
    const times = (window.gsnbTimes = { moved: 0, shown: [] });
    image.addEventListener("pointermove", () => { times.moved = performance.now(); }, true);
    image.addEventListener("load", () => requestAnimationFrame(() => {
        const moved = times.moved;
        times.shown.push([moved, performance.now()]);
    }));
}"""


@pytest.fixture(scope="module")
def page(lab):
    page = lab.open([SCENES, FILL, ONE, POINTS])
    page.set_viewport_size({"width": 1000, "height": 1000})
    page.evaluate("window.jupyterapp.shell.collapseLeft()")
    yield page
    page.close()


def drag(page, image, start, ends, wait_for_each):
    """Press at a fraction of a picture, move over others; milliseconds from each movement to its
    picture."""
    image.scroll_into_view_if_needed()
    box = image.bounding_box()

    def at(place):
        return box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"]

    image.evaluate(METER)
    page.mouse.move(*at(start))
    page.mouse.down()
    page.wait_for_timeout(300)
    page.evaluate("window.gsnbTimes.shown.length = 0")
    for i, end in enumerate(ends):
        page.mouse.move(*at(end))
        if wait_for_each:
            page.wait_for_function(
                f"window.gsnbTimes.shown.length > {i}", polling=20, timeout=20_000
            )
            page.wait_for_timeout(120)  # other messages of this redraw
            page.evaluate(f"window.gsnbTimes.shown.length = {i + 1}")
    if not wait_for_each:
        page.wait_for_timeout(1500)
    page.mouse.up()
    return page.evaluate("window.gsnbTimes")


def note(name, numbers):
    """Latencies go beside the screenshots."""
    if folder := os.environ.get("GSNB_SCREENSHOTS"):
        path = Path(folder) / "latency.json"
        known = json.loads(path.read_text()) if path.exists() else {}
        path.write_text(json.dumps({**known, name: numbers}, indent=1))


CASES = {
    "fill": ("the camera in the slice", (312 / 694 * 0.5, 0.5), "x_m"),
    "one-gaussian": ("the Gaussian", (0.5, 0.5), "x_m"),
    "points": ("the moved view", (0.75, 0.5), "turn_deg"),
}


@pytest.mark.parametrize(
    "name", [pytest.param("fill", marks=pytest.mark.slow), "one-gaussian", "points"]
)
def test_the_picture_follows_the_drag_without_a_queue(lab, page, name):
    what, start, control = CASES[name]
    image = page.locator(f".gsnb-{name}-image img").first
    handle = page.locator(f".gsnb-{name}-{control} .noUi-handle")
    if name == "fill":
        size = page.evaluate("(i) => [i.naturalWidth, i.naturalHeight]", image.element_handle())
        at = json.loads(
            lab.run(
                page,
                "import json; from gsfusion_nb.viz.panels.tsdf import camera_handles; "
                "print(json.dumps(camera_handles(0.4, -0.4, 100.0)['place']))",
            )
        )
        start = (at[0] / size[0], (at[1] + 26) / size[1])
    before = lab.screenshot(image, f"touch_{name}_before")
    value = handle.get_attribute("aria-valuenow")
    ends = [(start[0] + 0.006 * (i + 1), start[1]) for i in range(MOVES)]
    times = drag(page, image, start, ends, wait_for_each=True)
    each = [shown - moved for moved, shown in times["shown"]]
    assert np.abs(lab.screenshot(image, f"touch_{name}_after") - before).mean() > 0.3, what
    assert handle.get_attribute("aria-valuenow") != value
    flood = drag(
        page,
        image,
        ends[-1],
        [(ends[-1][0] - 0.0015 * i, start[1]) for i in range(1, 61)],
        False,
    )
    settled = flood["shown"][-1][1] - flood["moved"]
    note(
        name,
        {
            "median_ms": statistics.median(each),
            "max_ms": max(each),
            "settled_ms": settled,
            "pictures_of_60_moves": len(flood["shown"]),
        },
    )
    lab.screenshot(page.locator(f".gsnb-{name}").first, f"touch_{name}_panel")
    assert len(flood["shown"]) < 60
    assert settled < 5 * statistics.median(each) + 200  # two redraws, not sixty


def test_the_arrow_keys_drag_too(lab, page):
    image = page.locator(".gsnb-one-gaussian-image img")
    x_m = lab.value(page, "one.set(x_m=0.0, y_m=0.0).values['x_m']")
    at = image.bounding_box()
    page.mouse.click(
        at["x"] + at["width"] / 2,
        at["y"] + at["height"] / 2,
    )
    image.focus()
    for _ in range(3):
        page.keyboard.press("ArrowLeft")
    lab.wait_for(lambda: lab.value(page, "one.values['x_m']") != x_m, "the Gaussian to move")
    assert lab.errors == []
    assert lab.requests == []
