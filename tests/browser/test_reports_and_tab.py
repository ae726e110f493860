"""A run's report and its tab, in a real browser: the map is there, turns when it is dragged, and
nothing is loaded from elsewhere."""

import socket
from typing import Any

import pytest

from gsfusion_nb.config import replace
from gsfusion_nb.runs import run_mapping
from gsfusion_nb.viz import BrowserTab

pytestmark = pytest.mark.ci

ROOM: dict[str, Any] = {"n_frames": 120, "width": 80, "height": 60}
_LIVE = "document.querySelector('.gsnb-moving-map-live')"
_SHIFT = """
window.shift = 0;
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) window.shift += entry.value;
}).observe({ type: "layout-shift", buffered: true });
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The report of a small run."""
    from gsfusion_nb import gsfusion

    config = gsfusion("room", data__stop=6, optim__global_iterations=1, tsdf__voxel_size_m=0.05)
    folder = tmp_path_factory.mktemp("report") / "run"
    run_mapping("room", config, folder=folder, **ROOM)
    return (folder / "report.html").as_uri()


@pytest.mark.parametrize("width", [1280, 390])
def test_the_map_of_a_report_turns_when_it_is_dragged(book_browser, report, width):
    context = book_browser.new_context(
        viewport={"width": width, "height": 800}, has_touch=width < 500, reduced_motion="reduce"
    )
    page = context.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.add_init_script(_SHIFT)
    page.goto(report)
    page.wait_for_function(_LIVE)
    canvas = page.locator(".gsnb-splat-software")
    look = lambda: canvas.evaluate("c => c.toDataURL()")  # noqa: E731
    page.wait_for_timeout(1000)
    before = look()
    assert page.locator(".gsnb-moving-map-soon").count() == 0
    box = page.locator(".gsnb-splat-scene").bounding_box()
    photo = page.locator(".opening figure img").bounding_box()
    assert (photo["y"] == pytest.approx(box["y"], abs=1)) == (width > 500)
    assert box["y"] + box["height"] < 800, "the map is not above the fold"
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 180, box["y"] + 110, steps=4)
    page.mouse.up()
    page.wait_for_timeout(1000)
    assert look() != before
    turned = look()
    page.get_by_role("button", name="photo").click()
    page.wait_for_timeout(1000)
    assert look() != turned
    assert not page.locator(".gsnb-splat-row select").first.is_visible()
    page.get_by_role("button", name="more").click()
    assert page.locator(".gsnb-splat-row select").first.is_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("window.shift") < 0.1
    style = page.locator(".gsnb-splat-scene").evaluate("e => getComputedStyle(e).touchAction")
    assert style == "pan-y", "a thumb cannot scroll the page"
    assert errors == []
    context.close()


def test_without_javascript_nothing_is_empty(book_browser, report):
    context = book_browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(report)
    poster = page.locator(".gsnb-moving-map img")
    assert poster.is_visible()
    assert poster.bounding_box()["height"] > 200
    place = page.locator(".gsnb-moving-map")
    assert place.bounding_box()["height"] == pytest.approx(poster.bounding_box()["height"], abs=1)
    assert "With JavaScript the map can be turned" in page.locator("noscript").nth(1).inner_text()
    assert not page.get_by_text("Drag the map").is_visible()
    context.close()


def test_buttons_wait_under_a_poster_and_leave_where_no_map_comes(book_browser, report):
    heights = []
    for script in ("Response.prototype.arrayBuffer = () => new Promise(() => {})", ""):
        page = book_browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(script)
        page.goto(report)
        if not script:
            page.wait_for_function(_LIVE)
        place = page.locator(".gsnb-moving-map")
        assert place.get_by_text("inside").is_disabled() == bool(script)
        heights.append(place.bounding_box()["height"])
        page.close()
    assert heights[0] == pytest.approx(heights[1], abs=1)
    page = book_browser.new_page()
    page.add_init_script("delete window.DecompressionStream")
    page.goto(report)
    page.wait_for_function("!document.querySelector('.gsnb-moving-map-soon')")
    assert page.locator(".gsnb-moving-map > img").is_visible()
    page.close()


def test_the_tab_shows_the_map_and_loads_nothing_from_elsewhere(launch, config, tmp_path):
    pytest.importorskip("viser", reason="the extra watch is not installed")
    browser = launch(["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"])
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        port = trial.getsockname()[1]
    with BrowserTab(port=port) as tab:
        run_mapping(
            "room",
            replace(config, optim__global_iterations=1),
            folder=tmp_path / "run",
            evaluate=False,
            watch=tab,
            **ROOM,
        )
        page = browser.new_page()
        elsewhere = []
        own = ("data:", "blob:", f"http://127.0.0.1:{port}")
        page.on(
            "request",
            lambda request: (
                elsewhere.append(request.url) if not request.url.startswith(own) else None
            ),
        )
        page.goto(tab.url)
        page.get_by_text("finished:").wait_for(timeout=60_000)
        page.get_by_role("img").first.wait_for(timeout=60_000)
        assert page.locator("canvas").first.bounding_box()["width"] > 300
        assert elsewhere == []
    browser.close()
