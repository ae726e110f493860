"""Chapters 4 and 5 as a student uses them: click pixels, drag sliders, watch the fit, answer an exercise.

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


def code_cells(name, until, without="\0"):
    """The student's code cells of a chapter in its quick version, up to the one that contains ``until``."""
    chosen = []
    for cell in json.loads((FOLDER / name).read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"]).replace(QUICK, "SMOKE = True")
        source = source.replace("STEPS = 40 if", "STEPS = 100_000 if")  # the fit shall not finish under our hands
        if cell["cell_type"] == "code" and "BEGIN SOLUTION" not in source and without not in source:
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


def click(page, image, x, y):
    """Click at a fraction of an element's width and height."""
    image.scroll_into_view_if_needed()
    box = image.bounding_box()
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])


@pytest.fixture(scope="module")
def forward(lab):
    page = lab.open(code_cells("04_splatting_forward.ipynb", "ball = sh_ball_panel()"))
    yield page
    page.close()


@pytest.fixture(scope="module")
def backward(lab):
    page = lab.open(code_cells("05_splatting_gradients.ipynb", "gradients = GradientMicroscope(", "watch.run_sync()\n"))
    yield page
    page.close()


def test_a_click_shows_the_stack_of_that_pixel(lab, forward):
    image, lens = forward.locator(".gsnb-microscope-image img"), forward.locator("img.gsnb-microscope-lens")
    before = screenshot(lens, "microscope_lens_before")
    assert before.std() > 10
    click(forward, image, 0.25 + 0.5 / 320, 0.75 + 0.5 / 240)
    wait_for(
        lambda: lab.run(forward, "print(microscope.stack.u, microscope.stack.v)") == "80 180", "the click to arrive"
    )
    caption = forward.locator(".gsnb-microscope").get_by_text("pixel (80, 180)")
    caption.wait_for(timeout=20_000)
    forward.keyboard.press("ArrowRight")
    wait_for(lambda: lab.run(forward, "print(microscope.stack.u)") == "81", "the arrow key to arrive")
    rows = int(lab.run(forward, "print(min(len(microscope.stack), 14))"))
    wait_for(lambda: forward.locator(".gsnb-microscope-table tr").count() >= rows + 2, "a line for each Gaussian")
    assert np.abs(screenshot(lens, "microscope_lens_after") - before).mean() > 2
    screenshot(forward.locator(".gsnb-microscope"), "microscope")


def test_dragging_follows_the_mouse(lab, forward):
    image = forward.locator(".gsnb-microscope-image img")
    image.scroll_into_view_if_needed()
    box = image.bounding_box()
    forward.mouse.move(box["x"] + 10, box["y"] + 10)
    forward.mouse.down()
    forward.mouse.move(box["x"] + box["width"] / 2 + 1, box["y"] + box["height"] / 2 + 1, steps=8)
    forward.mouse.up()
    wait_for(
        lambda: lab.run(forward, "print(microscope.stack.u, microscope.stack.v)") == "160 120", "the last position"
    )


def test_the_sliders_move_the_gaussian(forward):
    picture = forward.locator("img.gsnb-one-gaussian-image")
    before = screenshot(picture, "one_gaussian_before")
    handle = forward.locator(".gsnb-one-gaussian-z_m .noUi-handle")
    handle.scroll_into_view_if_needed()
    handle.focus()
    for _ in range(10):
        forward.keyboard.press("ArrowRight")
    wait_for(lambda: forward.locator(".gsnb-one-gaussian-z_m .widget-readout").inner_text() == "2.5", "the slider")
    wait_for(lambda: np.abs(screenshot(picture, "one_gaussian_after") - before).mean() > 1, "the ellipse to shrink")


def test_an_exercise_is_red_then_green(lab, forward):
    wrong = "lambda alpha, rgb: ((alpha * (1 - alpha).cumprod(0))[:, None] * rgb).sum(0)"
    verdict = lab.run(forward, f"print(check.composite_pixel(lambda a, c: (({wrong})(a, c), 0.5)))")
    assert "nothing stands in front of the first one" in verdict
    right = "lambda a, c: (check.composite_pixel.solution)(a, c)"
    assert "all checks pass" in lab.run(forward, f"print(check.composite_pixel({right}))")


def test_the_fit_starts_pauses_steps_and_stops(lab, backward):
    def steps():
        return int(lab.run(backward, "print(watch.player.n_steps)"))

    def press(name):
        button = backward.locator(f".gsnb-watch-{name}")
        button.scroll_into_view_if_needed()
        button.click()

    picture = backward.locator("img.gsnb-watch-image")
    before = screenshot(picture, "fit_before")
    press("start")
    wait_for(lambda: steps() > 25, "the fit to run")
    press("pause")
    wait_for(lambda: lab.run(backward, "print(watch.player.state)") == "paused", "the pause")
    stood = steps()
    time.sleep(0.5)
    assert steps() == stood
    press("step")
    wait_for(lambda: steps() == stood + 1, "one step")
    press("stop")
    wait_for(lambda: lab.run(backward, "print(watch.player.state)") == "stopped", "the stop")
    assert np.abs(screenshot(picture, "fit_after") - before).mean() > 1
    screenshot(backward.locator(".gsnb-watch"), "fit")


def test_the_gradient_microscope_follows_click_and_switch(lab, backward):
    image, arrows = backward.locator(".gsnb-gradient-image img"), backward.locator("img.gsnb-gradient-arrows")
    first = screenshot(arrows, "gradient_pixel_before")
    click(backward, image, 0.5 + 0.5 / 160, 0.25 + 0.5 / 120)
    wait_for(lambda: lab.run(backward, "print(gradients.of_pixel.stack.u)") == "80", "the click to arrive")
    wait_for(lambda: np.abs(screenshot(arrows, "gradient_pixel") - first).mean() > 2, "other arrows")
    second = screenshot(arrows, "gradient_pixel")
    backward.locator(".gsnb-gradient").get_by_role("button", name="Gaussian").click()
    backward.locator(".gsnb-gradient-table").get_by_text("sum over all pixels").wait_for(timeout=20_000)
    assert np.abs(screenshot(arrows, "gradient_gaussian") - second).mean() > 2
    screenshot(backward.locator(".gsnb-gradient"), "gradient_microscope")


def test_no_error_and_nothing_from_elsewhere(lab, forward, backward):
    assert lab.errors == []
    assert lab.requests == []
