"""The web book in a real browser, opened as a folder of files: every chapter, and everything that reacts.

The book is built for these tests, or taken from $GSNB_BOOK. axe-core looks for what keeps people out who do not see the
page or use no mouse; it comes from npm: ``npm install --prefix DIR axe-core``, then GSNB_NPM=DIR.
"""

import re
from pathlib import Path

import npm_programs
import pytest
from book.build import missing

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing()), reason=f"the extra 'book' is not installed: no {', '.join(missing())}"),
]

ROOT = Path(__file__).resolve().parents[2]
CHAPTERS = [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))]
PAGES = (
    "index", "notebooks/00_quickstart", "notebooks/03_quadtree_decomposition", "notebooks/04_splatting_forward",
    "notebooks/09_write_your_own_seeding_rule", "docs/teaching/quiz/chapter_00", "docs/equations", "docs/outputs",
)  # fmt: skip
GRAVE = ("serious", "critical")
_LEFT = "net::ERR_ABORTED"
"""The page was left while it was still loading a file."""


@pytest.fixture
def open_file(book_browser):
    """Opens a page of the book; the test fails if a page wrote an error or asked for something elsewhere."""
    wrong: list[str] = []
    pages = []

    def open_page(file: Path, **options):
        page = book_browser.new_page(**options)
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
def opened(open_file, book_site):
    return lambda name, **options: open_file(book_site / f"{name}.html", **options)


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


def test_the_pixel_microscope_blends_in_the_page(open_file, views_page):
    page = open_file(views_page / "views.html")
    view = live(page, "pixels")
    image, caption = view.locator("img"), view.locator(".gsnb-pixels-caption")
    page.wait_for_function("c => c.textContent.includes('Gaussians')", arg=caption.element_handle())
    assert "pixel (80, 60)" in caption.inner_text()
    image.focus()
    page.keyboard.press("ArrowRight")
    assert "pixel (81, 60)" in caption.inner_text()
    box = image.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    words = caption.inner_text()
    summed, seen = (
        [float(x) for x in re.findall(rf"{name} ([\d. ]+)", words)[0].split()] for name in ("=", r"\(8 bit\)")
    )
    assert len(summed) == len(seen) == 3
    assert max(abs(a - b) for a, b in zip(summed, seen, strict=True)) <= 0.003  # half of a step of 8 bits, and rounding
    rows = view.locator("tbody tr").count() - 1
    assert rows > 0
    assert f"{rows} Gaussian" in words
    assert view.locator(".gsnb-pixels-weight").count() == rows


def test_the_mix_of_a_pixel_is_computed_in_the_page(open_file, views_page):
    page = open_file(views_page / "views.html")
    view = live(page, "mix")
    caption = view.locator(".gsnb-pixels-caption")
    page.wait_for_function("c => c.textContent.includes('surface and')", arg=caption.element_handle())
    assert "pixel (80, 60): surface and" in caption.inner_text()
    mean, seen = (
        [float(x) for x in re.findall(rf"{name} ([\d. ]+)", caption.inner_text())[0].split()]
        for name in ("mean =", r"\(8 bit\)")
    )
    assert max(abs(a - b) for a, b in zip(mean, seen, strict=True)) <= 0.003
    bars = view.locator(".gsnb-pixels-weight").count()
    assert bars == view.locator("tbody tr").count() - 1  # the last line is the mean
    ends = view.locator(".gsnb-pixels-graph rect:not(.gsnb-pixels-weight)")
    assert ends.count() == 2 * bars
    assert ends.nth(bars - 1).get_attribute("fill") == ends.nth(2 * bars - 1).get_attribute("fill")


def test_the_gradient_microscope_goes_to_the_nearest_recorded_pixel(open_file, views_page):
    page = open_file(views_page / "views.html")
    view = live(page, "gradients")
    image = view.locator("img")
    page.wait_for_function("i => i.complete && i.naturalWidth > 0", arg=image.element_handle())
    assert "now (80, 60)" not in image.get_attribute("alt")
    box = image.bounding_box()
    image.click(position={"x": 5, "y": box["height"] - 5})  # the lower left corner of the first picture
    assert "pixel (0, 119)" in view.locator(".gsnb-recorded-words").inner_text()
    view.get_by_role("button", name="Back to the start").click()
    view.locator("select").select_option("1")
    assert "Gaussian" in view.locator(".gsnb-recorded-words").inner_text()


def test_a_recorded_trace_follows_clicks(open_file, views_page):
    page = open_file(views_page / "views.html")
    view = live(page, "trace")
    image, story = view.locator("img"), view.locator("[name=story]")
    page.wait_for_function("i => i.complete && i.naturalWidth > 0", arg=image.element_handle())
    assert story.locator("option:checked").inner_text() == "pixel (20, 15)"
    first = image.get_attribute("src")
    view.get_by_role("button", name="Next").click()
    assert image.get_attribute("src") != first
    assert "2 /" in view.locator("output").inner_text()
    view.locator("[name=kind]").select_option("Gaussian")
    image.click()
    assert story.locator("option:checked").inner_text().startswith("Gaussian")
    page.wait_for_function("i => i.complete && i.naturalWidth > 0", arg=image.element_handle())


def test_a_table_of_results_is_sorted_by_a_heading(open_file, tmp_path):
    (tmp_path / "book.js").write_text((ROOT / "tools/book/static/book.js").read_text())
    cells = "".join(
        f"<tr><th>{name}</th><td>{value}</td></tr>" for name, value in (("a", "9.5"), ("b", "1,200"), ("c", "30"))
    )
    table = f"<table class=gsnb-lab-stored><tr><th>rule</th><th>Gaussians</th></tr>{cells}</table>"
    (tmp_path / "t.html").write_text(f"<!doctype html>{table}<script defer src=book.js></script>")
    page = open_file(tmp_path / "t.html")
    names = lambda: page.locator("tr th:first-child").all_inner_texts()[1:]  # noqa: E731
    page.get_by_role("button", name="Gaussians").click()
    assert names() == ["b", "c", "a"]
    page.get_by_role("button", name="Gaussians").click()
    assert names() == ["a", "c", "b"]
    assert page.locator("th[aria-sort]").get_attribute("aria-sort") == "ascending"


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


def faults(page) -> list[str]:
    """What axe-core finds grave on a page: rule, element, what is wrong."""
    axe: Path = npm_programs.npm_folder("axe-core") / "axe-core" / "axe.min.js"
    page.add_script_tag(path=axe)
    found = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")
    grave = [violation for violation in found["violations"] if violation["impact"] in GRAVE]
    assert len(found["passes"]) > 10  # it looked
    return [f"{v['id']}: {node['html'][:120]} {node['failureSummary']}" for v in grave for node in v["nodes"][:3]]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_grave_on_the_pages(book_site, book_browser, scheme):
    npm_programs.npm_folder("axe-core")
    wrong = {}
    for name in PAGES:
        page = book_browser.new_page(color_scheme=scheme)
        page.goto(f"file://{book_site / name}.html")
        page.wait_for_load_state("load")
        for view in page.locator(".gsnb-view[data-src]").all()[:3]:
            view.scroll_into_view_if_needed()
        if found := faults(page):
            wrong[name] = found
        page.close()
    assert wrong == {}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_grave_in_the_recorded_views(views_page, book_browser, scheme):
    page = book_browser.new_page(color_scheme=scheme)
    page.goto(f"file://{views_page / 'views.html'}")
    views = page.locator(".gsnb-view").all()
    for view in views:
        view.scroll_into_view_if_needed()
        page.wait_for_function("v => v.dataset.state === 'live'", arg=view.element_handle())
    assert len(views) > 5
    assert faults(page) == []
