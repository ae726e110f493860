"""Chapter 12 as a student uses it: what is mixed in a pixel, the choice of voxel sizes, a live
map."""

import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]


@pytest.fixture(scope="module")
def chapter(lab):
    page = lab.open(lab.chapter("12_gps_slam.ipynb", "surface_panel(pictures"))
    yield page
    page.close()


def test_a_click_shows_what_is_mixed_there(lab, chapter):
    image = chapter.locator(".gsnb-microscope-image img")
    image.scroll_into_view_if_needed()
    before = image.get_attribute("src")
    box = image.bounding_box()
    zoom = box["width"] / image.evaluate("image => image.naturalWidth")
    chapter.mouse.click(
        box["x"] + zoom * 80.5 * 300 / 120,
        box["y"] + zoom * (26 + 60.5 * 300 / 120),
    )
    lab.wait_for(
        lambda: lab.run(chapter, "print(microscope.stack.u, microscope.stack.v)") == "80 60",
        "the click",
    )
    chapter.locator(".gsnb-microscope").get_by_text("pixel (80, 60)").wait_for(timeout=20_000)
    lab.wait_for(lambda: image.get_attribute("src") != before, "another picture")
    assert "mean" in chapter.locator(".gsnb-microscope-text").inner_text()
    lab.screenshot(chapter.locator(".gsnb-microscope"), "12_microscope")


def test_another_voxel_size_shows_other_pictures(lab, chapter):
    image = chapter.locator(".gsnb-surface-image img").first
    before = image.get_attribute("src")
    chapter.locator(".gsnb-surface-choice select").first.select_option(index=0)
    lab.wait_for(lambda: image.get_attribute("src") != before, "another picture")
    lab.screenshot(chapter.locator(".gsnb-surface").first, "12_voxels")


def test_surface_corrections_and_sum_are_shown_live(lab, chapter):
    live = chapter.locator(".gsnb-live").first
    for name in ("base", "residual", "render"):
        assert lab.screenshot(live.locator(f".gsnb-live-{name} img").first, f"12_{name}").std() > 1
    lab.screenshot(live, "12_live")
    assert lab.errors == []
    assert lab.requests == []
