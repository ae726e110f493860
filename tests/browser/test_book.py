"""The web book in a real browser, opened as a folder of files: every chapter, and everything that reacts.

The book is built for these tests, or taken from $GSNB_BOOK.
"""

import json
import os
from pathlib import Path

import pytest

from gsfusion_nb.book.build import build, missing
from gsfusion_nb.book.settings import Settings
from gsfusion_nb.book.views.record import write
from gsfusion_nb.book.views.recorded import placeholder
from gsfusion_nb.book.views.scripts import front_ends, style_sheet

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing()), reason=f"the extra 'book' is not installed: no {', '.join(missing())}"),
]

ROOT = Path(__file__).resolve().parents[2]
CHAPTERS = [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    if ready := os.environ.get("GSNB_BOOK"):
        return Path(ready).resolve()
    out = tmp_path_factory.mktemp("book") / "site"
    assert build(ROOT, out, Settings(), views=()) == []
    return out


@pytest.fixture(scope="module")
def views_page(tmp_path_factory, recorded_views) -> Path:
    """A page with a view of each kind, as a chapter has them."""
    folder = tmp_path_factory.mktemp("views")
    scripts = {**front_ends(), "views.css": style_sheet(), "views.js": source("views.js")}
    for name, text in scripts.items():
        (folder / name).write_text(text)
    parts = []
    for name, view in recorded_views.items():
        write({name: view}, folder / "x" / name)
        listed = json.loads((folder / "x" / name / "views.json").read_text())
        parts.append(placeholder(listed[name], f"x/{name}", name))
    head = '<link rel="stylesheet" href="views.css"><script defer src="views.js"></script>'
    (folder / "views.html").write_text(f"<!doctype html><meta charset=utf-8>{head}{''.join(parts)}")
    return folder


@pytest.fixture(scope="module")
def browser(launch):
    browser = launch(["--no-sandbox", "--disable-gpu"])
    yield browser
    browser.close()


def source(name: str) -> str:
    return (ROOT / "gsfusion_nb/book/static" / name).read_text()


_LEFT = "net::ERR_ABORTED"
"""The page was left while it was still loading a file."""


@pytest.fixture
def open_file(browser):
    """Opens a page of the book; the test fails if a page wrote an error or asked for something elsewhere."""
    wrong: list[str] = []
    pages = []

    def open_page(file: Path, **options):
        page = browser.new_page(**options)
        pages.append(page)
        page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: wrong.append(str(e)))
        page.on("request", lambda r: wrong.append(r.url) if r.url.startswith("http") else None)
        page.on("requestfailed", lambda r: r.failure == _LEFT or wrong.append(f"{r.url}: {r.failure}"))
        page.goto(f"file://{file}")
        return page

    yield open_page
    for page in pages:
        page.close()
    assert wrong == []


@pytest.fixture
def opened(open_file, site):
    return lambda name, **options: open_file(site / f"{name}.html", **options)


def live(page, name):
    """A view that has opened, in the window."""
    view = page.locator(f".gsnb-view[data-name='{name}']")
    view.scroll_into_view_if_needed()
    page.wait_for_function("v => v.dataset.state === 'live'", arg=view.element_handle())
    return view


def test_a_recorded_panel_follows_its_sliders(open_file, views_page):
    page = open_file(views_page / "views.html")
    view = live(page, "panel")
    slider, image = view.get_by_label("fuse, times"), view.locator("img")
    before = image.get_attribute("src"), image.get_attribute("alt")
    slider.focus()
    page.keyboard.press("ArrowRight")
    assert image.get_attribute("src") != before[0]
    assert image.get_attribute("alt") != before[1]
    page.wait_for_function("i => i.complete && i.naturalWidth > 0", arg=image.element_handle())
    assert slider.get_attribute("aria-valuetext") == view.locator("output").first.inner_text()
    view.get_by_role("button", name="Back to the start").click()
    assert image.get_attribute("src") == before[0]


def test_a_recorded_stepper_goes_on_and_back(open_file, views_page):
    page = open_file(views_page / "views.html")
    view = live(page, "stepper")
    title = view.locator(".gsnb-stepper-title")
    first = title.inner_text()
    view.get_by_role("button", name="Next").click()
    assert title.inner_text() != first
    view.locator(".gsnb-stepper").focus()
    page.keyboard.press("ArrowLeft")
    assert title.inner_text() == first


@pytest.mark.parametrize("kind", ["splat", "mesh"])
def test_a_viewer_turns_without_a_kernel(open_file, views_page, kind):
    page = open_file(views_page / "views.html")
    view = live(page, kind)
    scene = view.locator(f".gsnb-{kind}-scene")
    canvas = "canvas.gsnb-splat-software" if kind == "splat" else "canvas"
    painted = "c => new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size > 8"
    page.wait_for_function(painted, arg=view.locator(canvas).element_handle())
    look = "c => c.toDataURL()"
    before = view.locator(canvas).evaluate(look)
    box = scene.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 40, box["y"] + box["height"] / 2, steps=4)
    page.mouse.up()
    page.wait_for_function(
        "([c, before]) => c.toDataURL() !== before", arg=[view.locator(canvas).element_handle(), before]
    )


def test_a_click_names_a_gaussian(open_file, views_page):
    page = open_file(views_page / "views.html")
    view = live(page, "splat")
    painted = "c => new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size > 8"
    page.wait_for_function(painted, arg=view.locator("canvas.gsnb-splat-software").element_handle())
    where = """c => {
        const { data } = c.getContext("2d").getImageData(0, 0, c.width, c.height);
        const red = data.reduce((at, value, i) => (i % 4 === 0 && value > data[at] ? i : at), 0) / 4;
        return [(red % c.width) / c.width, Math.floor(red / c.width) / c.height];
    }"""
    u, v = view.locator("canvas.gsnb-splat-software").evaluate(where)
    box = view.locator(".gsnb-splat-scene").bounding_box()
    page.mouse.click(box["x"] + u * box["width"], box["y"] + v * box["height"])
    page.wait_for_function(
        "r => r.textContent.includes('xyz_W [m]')", arg=view.locator(".gsnb-splat-record").element_handle()
    )
    assert "row" in view.locator(".gsnb-splat-record").inner_text()


@pytest.mark.parametrize("chapter", CHAPTERS)
def test_a_chapter_opens_at_every_width(opened, chapter):
    page = opened(f"notebooks/{chapter}", viewport={"width": 390, "height": 800})
    page.wait_for_load_state("load")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "the page is wider than a phone"
    formulas = page.locator("div.math, span.math").count()
    if formulas:
        page.wait_for_function("document.querySelectorAll('mjx-container').length > 0")
        assert page.locator("mjx-merror").count() == 0
    for picture in page.locator("article img").all():
        assert picture.get_attribute("alt")


def test_a_prediction_hides_what_came_until_it_is_made(opened):
    page = opened("notebooks/00_quickstart")
    form = page.locator("form[data-prediction=first_frame_seeds]")
    came = page.locator(".gsnb-came[data-prediction=first_frame_seeds]")
    assert not came.is_visible()
    form.get_by_role("button", name="See what came").click()
    assert "Choose an answer" in form.inner_text()
    form.get_by_label("3,000", exact=True).check()
    form.get_by_role("button", name="See what came").click()
    assert came.is_visible()
    assert "right" in form.get_by_role("status").inner_text()


def test_hints_and_solution_unfold(opened):
    page = opened("notebooks/00_quickstart")
    hint = page.locator("details.gsnb-hint").first
    assert not hint.locator("p").first.is_visible()
    hint.locator("summary").first.click()
    assert hint.locator("p").first.is_visible()
    solution = page.locator("details.gsnb-solution").first
    solution.locator("summary").click()
    assert "return [i for i" in solution.inner_text()


def test_the_quiz_answers(opened):
    page = opened("docs/teaching/quiz/chapter_00")
    form = page.locator("form.gsnb-quiz").first
    right = form.get_attribute("data-right")
    wrong = "A" if right != "A" else "B"
    form.locator(f"input[value={wrong}]").check()
    assert "Not this one" in form.inner_text()
    form.locator(f"input[value={right}]").check()
    assert "The checker says" in form.inner_text()


def test_the_search_finds_a_word(opened):
    page = opened("search")
    page.goto(page.url + "?q=quadtree")
    page.wait_for_selector("ul.search li a")
    assert page.locator("ul.search li").count() > 3
