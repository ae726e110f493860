"""Chapters 7 and 8 as a student uses them: drag the sliders of discs and ICP, map live, answer
exercises."""

import re

import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

LONG_RUN = {"live.run_sync(24)": "live.run_sync(2)", "LIVE_FRAMES = 7 ": "LIVE_FRAMES = 400 "}
"""It shall not finish under our hands."""


def changes(lab, page, panel, slider, steps):
    """A slider is dragged; whether the picture's pixels changed."""
    image = page.locator(f".gsnb-{panel}-image img").first
    before = image.get_attribute("src")
    lab.move_slider(page.locator(f".gsnb-{panel}-{slider}").first, steps)
    lab.wait_for(lambda: image.get_attribute("src") != before, f"a new picture of {panel}")


@pytest.fixture(scope="module")
def discs(lab):
    cells = lab.chapter("07_rtg_slam.ipynb", "live.splats(", changes=LONG_RUN)
    page = lab.open(cells)
    yield page
    page.close()


@pytest.fixture(scope="module")
def tracking(lab):
    page = lab.open(lab.chapter("08_tracking.ipynb", "panel = icp_panel("))
    yield page
    page.close()


def test_discs_sliders_redraw_and_name_the_errors(lab, discs):
    changes(lab, discs, "disc", "lean_deg", 12)
    lab.wait_for(
        lambda: "in mid-air" in discs.locator(".gsnb-disc-text").first.inner_text(), "the table"
    )
    assert lab.screenshot(discs.locator(".gsnb-disc").first, "07_discs").std() > 20
    changes(lab, discs, "adding", "colour_error", -5)
    lab.screenshot(discs.locator(".gsnb-adding").first, "07_adding")
    assert lab.errors == []
    assert lab.requests == []


def test_rtg_slam_is_mapped_live_and_stops_when_asked(lab, discs):
    live = discs.locator(".gsnb-live").first
    status = live.locator(".gsnb-live-status")
    lab.wait_for(lambda: "2 of" in status.inner_text(), "the first two frames")
    states = live.locator(".gsnb-live-states img").first
    before = states.get_attribute("src")
    live.locator(".gsnb-live-start").first.click()
    lab.wait_for(
        lambda: int(re.findall(r"(\d+) of", status.inner_text())[0]) >= 16,
        "sixteen frames",
        120,
    )
    live.locator(".gsnb-live-pause").first.click()
    lab.wait_for(lambda: "paused" in status.inner_text(), "the pause")
    assert states.get_attribute("src") != before
    lab.screenshot(live, "07_live")
    splats = discs.locator(".gsnb-splat-root")
    lab.wait_for(
        lambda: "Gaussians in view" in splats.locator(".gsnb-splat-status").inner_text(),
        "the splat viewer",
    )
    assert "stable" in splats.locator(".gsnb-splat-legend").inner_text()
    lab.screenshot(splats, "07_splats")
    live.locator(".gsnb-live-stop").first.click()
    lab.wait_for(lambda: "stopped" in status.inner_text(), "the stop")
    assert lab.errors == []


def test_icp_sliders_step_through_an_alignment(lab, tracking):
    words = tracking.locator(".gsnb-icp-text").first
    assert "converged:" in words.inner_text()
    assert "not converged" not in words.inner_text()
    for _ in range(3):
        changes(lab, tracking, "icp", "step", 1)
    lab.screenshot(tracking.locator(".gsnb-icp").first, "08_icp_step")
    changes(lab, tracking, "icp", "turn_deg", 12)
    lab.wait_for(
        lambda: "not converged" in words.inner_text(), "the start outside the basin to fail"
    )
    assert lab.screenshot(tracking.locator(".gsnb-icp").first, "08_icp_lost").std() > 20
    assert lab.errors == []
    assert lab.requests == []


def test_a_checker_turns_from_red_to_green(lab, tracking):
    setup = "from gsfusion_nb.course import check, exercises\ne = exercises()['gauss_newton']\n"
    assert "failed" in lab.run(
        tracking, setup + "print(check.gauss_newton(e.wrong[0].function).state)"
    )
    right = "lambda T_WC, r, J: se3.exp(torch.linalg.solve(J.T @ J, -J.T @ r)) @ T_WC"
    setup += "import torch\nfrom gsfusion_nb.geometry import se3\n"
    assert "passed" in lab.run(tracking, setup + f"print(check.gauss_newton({right}).state)")
