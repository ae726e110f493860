"""Chapters 4 and 5 as a student uses them: click pixels, drag sliders, watch the fit, answer an
exercise."""

import time

import numpy as np
import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

LONG_FIT = {"STEPS = 40 ": "STEPS = 100_000 "}
"""The fit shall not finish under our hands."""


ZOOM = 300 / 240
"""Of the first picture of the pixel microscope, below a strip of 26 pixels."""


def place_of(image, u, v):
    """Where on the page a pixel of the first picture of a microscope is."""
    image.scroll_into_view_if_needed()
    box = image.bounding_box()
    scale = box["width"] / image.evaluate("image => image.naturalWidth")
    return box["x"] + scale * (u + 0.5) * ZOOM, box["y"] + scale * (26 + (v + 0.5) * ZOOM)


@pytest.fixture(scope="module")
def forward(lab):
    page = lab.open(lab.chapter("04_splatting_forward.ipynb", "ball = sh_ball_panel()"))
    yield page
    page.close()


@pytest.fixture(scope="module")
def backward(lab):
    end = "gradients = GradientMicroscope("
    at_the_end = ("loop.run_sync()\n", "at_end")
    cells = lab.chapter("05_splatting_gradients.ipynb", end, without=at_the_end, changes=LONG_FIT)
    page = lab.open(cells)
    yield page
    page.close()


def test_a_click_shows_the_stack_of_that_pixel(lab, forward):
    image = forward.locator(".gsnb-microscope-image img")
    before = lab.screenshot(image, "microscope_before")
    assert before.std() > 10
    forward.mouse.click(*place_of(image, 80, 180))
    lab.wait_for(
        lambda: lab.run(forward, "print(microscope.stack.u, microscope.stack.v)") == "80 180",
        "the click to arrive",
    )
    forward.locator(".gsnb-microscope").get_by_text("pixel (80, 180)").wait_for(timeout=20_000)
    lab.move_slider(forward.locator(".gsnb-microscope-u"), 1)
    lab.wait_for(
        lambda: lab.run(forward, "print(microscope.stack.u)") == "81", "the slider to arrive"
    )
    rows = int(lab.run(forward, "print(min(len(microscope.stack), 14))"))
    lab.wait_for(
        lambda: forward.locator(".gsnb-microscope-text tr").count() >= rows + 2,
        "a line for each Gaussian",
    )
    assert np.abs(lab.screenshot(image, "microscope_after") - before).mean() > 2
    lab.screenshot(forward.locator(".gsnb-microscope"), "microscope")


def test_dragging_follows_the_mouse(lab, forward):
    image = forward.locator(".gsnb-microscope-image img")
    forward.mouse.move(*place_of(image, 10, 10))
    forward.mouse.down()
    forward.mouse.move(*place_of(image, 160, 120), steps=8)
    forward.mouse.up()
    lab.wait_for(
        lambda: lab.run(forward, "print(microscope.stack.u, microscope.stack.v)") == "160 120",
        "the last position",
    )


def test_the_sliders_move_the_gaussian(lab, forward):
    picture = forward.locator(".gsnb-one-gaussian-image img")
    before = lab.screenshot(picture, "one_gaussian_before")
    lab.move_slider(forward.locator(".gsnb-one-gaussian-z_m"), 10)
    lab.wait_for(
        lambda: forward.locator(".gsnb-one-gaussian-z_m .widget-readout").inner_text() == "2.5",
        "the slider",
    )
    lab.wait_for(
        lambda: np.abs(lab.screenshot(picture, "one_gaussian_after") - before).mean() > 1,
        "the ellipse to shrink",
    )


def test_an_exercise_is_red_then_green(lab, forward):
    wrong = "lambda alpha, rgb: ((alpha * (1 - alpha).cumprod(0))[:, None] * rgb).sum(0)"
    verdict = lab.run(forward, f"print(check.composite_pixel(lambda a, c: (({wrong})(a, c), 0.5)))")
    assert "nothing is in front of the first one" in verdict
    right = (
        "lambda a, c: ((a * torch.cat([torch.ones(1), (1 - a).cumprod(0)])[:-1]) @ c, (1 - "
        "a).prod())"
    )
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


def test_the_gradient_microscope_follows_click_and_choice(lab, backward):
    image = backward.locator(".gsnb-gradient-image img")
    first = lab.screenshot(image, "gradient_pixel_before")
    scale = image.bounding_box()["width"] / image.evaluate("image => image.naturalWidth")
    image.click(position={"x": scale * 80.5 * 222 / 120, "y": scale * (26 + 30.5 * 222 / 120)})
    lab.wait_for(
        lambda: lab.run(backward, "print(gradients.of_pixel.stack.u)") == "80",
        "the click to arrive",
    )
    lab.wait_for(
        lambda: np.abs(lab.screenshot(image, "gradient_pixel") - first).mean() > 1,
        "other arrows",
    )
    second = lab.screenshot(image, "gradient_pixel")
    backward.locator(".gsnb-gradient-pick select").select_option("Gaussian")
    backward.locator(".gsnb-gradient-text").get_by_text("sum over all pixels").wait_for(
        timeout=20_000
    )
    assert np.abs(lab.screenshot(image, "gradient_gaussian") - second).mean() > 1
    lab.screenshot(backward.locator(".gsnb-gradient"), "gradient_microscope")


def test_no_error_and_nothing_from_elsewhere(lab, forward, backward):
    assert lab.errors == []
    assert lab.requests == []
