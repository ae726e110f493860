"""Chapters 4 and 5 as a student uses them: click pixels, drag sliders, watch the fit, answer an exercise."""

import time

import numpy as np
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

LONG_FIT = {"STEPS = 40 if": "STEPS = 100_000 if"}
"""The fit shall not finish under our hands."""


def click(page, image, x, y):
    """Click at a fraction of an element's width and height."""
    image.scroll_into_view_if_needed()
    box = image.bounding_box()
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])


@pytest.fixture(scope="module")
def forward(lab):
    page = lab.open(lab.chapter("04_splatting_forward.ipynb", "ball = sh_ball_panel()"))
    yield page
    page.close()


@pytest.fixture(scope="module")
def backward(lab):
    end, at_the_end = "gradients = GradientMicroscope(", ("loop.run_sync()\n", "at_end")
    cells = lab.chapter("05_splatting_gradients.ipynb", end, without=at_the_end, changes=LONG_FIT)
    page = lab.open(cells)
    yield page
    page.close()


def test_a_click_shows_the_stack_of_that_pixel(lab, forward):
    image, lens = forward.locator(".gsnb-microscope-image img"), forward.locator(".gsnb-microscope-lens img")
    before = lab.screenshot(lens, "microscope_lens_before")
    assert before.std() > 10
    click(forward, image, 0.25 + 0.5 / 320, 0.75 + 0.5 / 240)
    lab.wait_for(
        lambda: lab.run(forward, "print(microscope.stack.u, microscope.stack.v)") == "80 180", "the click to arrive"
    )
    caption = forward.locator(".gsnb-microscope").get_by_text("pixel (80, 180)")
    caption.wait_for(timeout=20_000)
    forward.keyboard.press("ArrowRight")
    lab.wait_for(lambda: lab.run(forward, "print(microscope.stack.u)") == "81", "the arrow key to arrive")
    rows = int(lab.run(forward, "print(min(len(microscope.stack), 14))"))
    lab.wait_for(lambda: forward.locator(".gsnb-microscope-table tr").count() >= rows + 2, "a line for each Gaussian")
    assert np.abs(lab.screenshot(lens, "microscope_lens_after") - before).mean() > 2
    lab.screenshot(forward.locator(".gsnb-microscope"), "microscope")


def test_dragging_follows_the_mouse(lab, forward):
    image = forward.locator(".gsnb-microscope-image img")
    image.scroll_into_view_if_needed()
    box = image.bounding_box()
    forward.mouse.move(box["x"] + 10, box["y"] + 10)
    forward.mouse.down()
    forward.mouse.move(box["x"] + box["width"] / 2 + 1, box["y"] + box["height"] / 2 + 1, steps=8)
    forward.mouse.up()
    lab.wait_for(
        lambda: lab.run(forward, "print(microscope.stack.u, microscope.stack.v)") == "160 120", "the last position"
    )


def test_the_sliders_move_the_gaussian(lab, forward):
    picture = forward.locator(".gsnb-one-gaussian-image img")
    before = lab.screenshot(picture, "one_gaussian_before")
    lab.move_slider(forward.locator(".gsnb-one-gaussian-z_m"), 10)
    lab.wait_for(lambda: forward.locator(".gsnb-one-gaussian-z_m .widget-readout").inner_text() == "2.5", "the slider")
    lab.wait_for(
        lambda: np.abs(lab.screenshot(picture, "one_gaussian_after") - before).mean() > 1, "the ellipse to shrink"
    )


def test_an_exercise_is_red_then_green(lab, forward):
    wrong = "lambda alpha, rgb: ((alpha * (1 - alpha).cumprod(0))[:, None] * rgb).sum(0)"
    verdict = lab.run(forward, f"print(check.composite_pixel(lambda a, c: (({wrong})(a, c), 0.5)))")
    assert "nothing is in front of the first one" in verdict
    right = "lambda a, c: ((a * torch.cat([torch.ones(1), (1 - a).cumprod(0)])[:-1]) @ c, (1 - a).prod())"
    assert "all checks pass" in lab.run(forward, f"print(check.composite_pixel({right}))")


def test_the_fit_starts_pauses_steps_and_stops(lab, backward):
    def steps():
        return int(lab.run(backward, "print(loop.player.n_steps)"))

    def press(name):
        button = backward.locator(f".gsnb-live-loop-{name}")
        button.scroll_into_view_if_needed()
        button.click()

    picture = backward.locator(".gsnb-live-loop-image img")
    before = lab.screenshot(picture, "fit_before")
    press("start")
    lab.wait_for(lambda: steps() > 25, "the fit to run")
    press("pause")
    lab.wait_for(lambda: lab.run(backward, "print(loop.player.state)") == "paused", "the pause")
    stood = steps()
    time.sleep(0.5)
    assert steps() == stood
    press("step")
    lab.wait_for(lambda: steps() == stood + 1, "one step")
    press("stop")
    lab.wait_for(lambda: lab.run(backward, "print(loop.player.state)") == "stopped", "the stop")
    assert np.abs(lab.screenshot(picture, "fit_after") - before).mean() > 1
    lab.screenshot(backward.locator(".gsnb-live-loop"), "fit")


def test_the_gradient_microscope_follows_click_and_switch(lab, backward):
    image, arrows = backward.locator(".gsnb-gradient-image img"), backward.locator(".gsnb-gradient-arrows img")
    first = lab.screenshot(arrows, "gradient_pixel_before")
    click(backward, image, 0.5 + 0.5 / 160, 0.25 + 0.5 / 120)
    lab.wait_for(lambda: lab.run(backward, "print(gradients.of_pixel.stack.u)") == "80", "the click to arrive")
    lab.wait_for(lambda: np.abs(lab.screenshot(arrows, "gradient_pixel") - first).mean() > 2, "other arrows")
    second = lab.screenshot(arrows, "gradient_pixel")
    backward.locator(".gsnb-gradient").get_by_role("button", name="Gaussian").click()
    backward.locator(".gsnb-gradient-table").get_by_text("sum over all pixels").wait_for(timeout=20_000)
    assert np.abs(lab.screenshot(arrows, "gradient_gaussian") - second).mean() > 2
    lab.screenshot(backward.locator(".gsnb-gradient"), "gradient_microscope")


def test_no_error_and_nothing_from_elsewhere(lab, forward, backward):
    assert lab.errors == []
    assert lab.requests == []
