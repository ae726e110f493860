"""Chapters 7 and 8 as a student uses them: drag the sliders of discs and ICP, map live, answer exercises.

Screenshots go to $GSNB_SCREENSHOTS.
"""

import json
import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
QUICK = 'SMOKE = os.environ.get("GSNB_SMOKE", "0") == "1"'


def code_cells(name, until):
    """The student's code cells of a chapter in its quick version, up to the one that contains ``until``."""
    chosen = []
    for cell in json.loads((FOLDER / name).read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"]).replace(QUICK, "SMOKE = True")
        source = source.replace("live.run_sync(24)", "live.run_sync(2)")
        source = source.replace("LIVE_FRAMES = 7 if", "LIVE_FRAMES = 400 if")  # shall not finish under our hands
        if cell["cell_type"] == "code" and "BEGIN SOLUTION" not in source and "source_lines({" not in source:
            chosen.append(source)
            if until in source:
                return chosen
    raise AssertionError(f"no cell of {name} has {until!r}")


def screenshot(locator, name):
    locator.scroll_into_view_if_needed()
    png = locator.screenshot()
    if folder := os.environ.get("GSNB_SCREENSHOTS"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / f"{name}.png").write_bytes(png)
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)).astype(int)


def wait_for(condition, what, timeout_s=30):
    until = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < until, f"waited {timeout_s} s for {what}"
        time.sleep(0.1)


def drag(page, slider, steps):
    """Move a slider with the arrow keys."""
    handle = slider.locator(".noUi-handle").first
    handle.scroll_into_view_if_needed()
    handle.focus()
    for _ in range(abs(steps)):
        page.keyboard.press("ArrowRight" if steps > 0 else "ArrowLeft")


def changes(page, panel, slider, steps):
    """A slider is dragged; whether the picture's pixels changed."""
    image = page.locator(f".gsnb-{panel}-image").first
    before = image.get_attribute("src")
    drag(page, page.locator(f".gsnb-{panel}-{slider}").first, steps)
    wait_for(lambda: image.get_attribute("src") != before, f"a new picture of {panel}")


@pytest.fixture(scope="module")
def discs(lab):
    page = lab.open(code_cells("07_rtg_slam.ipynb", "live.splats("))
    yield page
    page.close()


@pytest.fixture(scope="module")
def tracking(lab):
    page = lab.open(code_cells("08_tracking.ipynb", "panel = icp_panel("))
    yield page
    page.close()


def test_discs_sliders_redraw_and_name_the_errors(lab, discs):
    changes(discs, "disc", "lean_deg", 12)
    wait_for(lambda: "in mid-air" in discs.locator(".gsnb-disc-text").first.inner_text(), "the table")
    assert screenshot(discs.locator(".gsnb-disc").first, "07_discs").std() > 20
    changes(discs, "adding", "colour_error", -5)
    screenshot(discs.locator(".gsnb-adding").first, "07_adding")
    assert lab.errors == []
    assert lab.requests == []


def test_rtg_slam_is_mapped_live_and_stops_when_asked(lab, discs):
    live = discs.locator(".gsnb-live").first
    status = live.locator(".gsnb-live-status")
    wait_for(lambda: "2 of" in status.inner_text(), "the first two frames")
    states = live.locator(".gsnb-live-states").first
    before = states.get_attribute("src")
    live.locator(".gsnb-live-start").first.click()
    wait_for(lambda: int(status.inner_text().split("·")[1].split(" of ")[0]) >= 16, "sixteen frames", 120)
    live.locator(".gsnb-live-pause").first.click()
    wait_for(lambda: "paused" in status.inner_text(), "the pause")
    assert states.get_attribute("src") != before
    screenshot(live, "07_live")
    splats = discs.locator(".gsnb-splat-root")
    wait_for(lambda: "Gaussians in view" in splats.locator(".gsnb-splat-status").inner_text(), "the splat viewer")
    assert "stable" in splats.locator(".gsnb-splat-legend").inner_text()
    screenshot(splats, "07_splats")
    live.locator(".gsnb-live-stop").first.click()
    wait_for(lambda: "stopped" in status.inner_text(), "the stop")
    assert lab.errors == []


def test_icp_sliders_step_through_an_alignment(lab, tracking):
    words = tracking.locator(".gsnb-icp-text").first
    assert "arrived" in words.inner_text()
    for _ in range(3):
        changes(tracking, "icp", "step", 1)
    screenshot(tracking.locator(".gsnb-icp").first, "08_icp_step")
    changes(tracking, "icp", "turn_deg", 12)
    wait_for(lambda: "lost" in words.inner_text(), "the start outside of the basin to be lost")
    assert screenshot(tracking.locator(".gsnb-icp").first, "08_icp_lost").std() > 20
    assert lab.errors == []
    assert lab.requests == []


def test_a_checker_turns_from_red_to_green(lab, tracking):
    setup = "from gsfusion_nb.teaching import check, exercises\ne = exercises()['gauss_newton']\n"
    assert "failed" in lab.run(tracking, setup + "print(check.gauss_newton(e.wrong[0].function).state)")
    assert "passed" in lab.run(tracking, setup + "print(check.gauss_newton(e.solution).state)")
