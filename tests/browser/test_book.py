"""The web book in a real browser, opened as a folder of files: every chapter, and everything that
reacts.

The book is built for these tests, or taken from $GSNB_BOOK. axe-core looks for what keeps people
out who do not see the page or use no mouse; it comes from npm:
``npm install --prefix DIR axe-core``, then GSNB_NPM=DIR.
"""

from pathlib import Path

import npm_programs
import pytest
from book.__main__ import missing

pytestmark = [
    pytest.mark.ci,
    pytest.mark.skipif(
        bool(missing()), reason=f"the extra 'book' is not installed: no {', '.join(missing())}"
    ),
]

ROOT = Path(__file__).resolve().parents[2]
CHAPTERS = [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))]
PAGES = (
    "index",
    "notebooks/00_quickstart",
    "notebooks/03_quadtree_decomposition",
    "docs/teaching/quiz/chapter_00",
    "docs/equations",
    "docs/outputs",
)
GRAVE = ("serious", "critical")
_LEFT = "net::ERR_ABORTED"
"""The page was left while it was still loading a file."""


@pytest.fixture
def open_file(book_browser):
    """Opens a page of the book; the test fails if a page wrote an error or asked for something
    elsewhere."""
    wrong: list[str] = []
    pages = []

    def open_page(file: Path, **options):
        page = book_browser.new_page(**options)
        pages.append(page)
        page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: wrong.append(str(e)))
        page.on(
            "request",
            lambda r: wrong.append(r.url) if r.url.startswith("http") else None,
        )
        page.on(
            "requestfailed", lambda r: r.failure == _LEFT or wrong.append(f"{r.url}: {r.failure}")
        )
        page.goto(f"file://{file}")
        return page

    yield open_page
    for page in pages:
        page.close()
    assert wrong == []


@pytest.fixture
def opened(open_file, book_site):
    return lambda name, **options: open_file(book_site / f"{name}.html", **options)


def test_a_table_of_results_is_sorted_by_a_heading(open_file, tmp_path):
    (tmp_path / "book.js").write_text((ROOT / "tools/book/static/book.js").read_text())
    cells = "".join(
        f"<tr><th>{name}</th><td>{value}</td></tr>"
        for name, value in (("a", "9.5"), ("b", "1,200"), ("c", "30"))
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


@pytest.mark.parametrize("name", ["index", "notebooks/00_quickstart"])
def test_the_map_turns_until_it_is_dragged(opened, name):
    page = opened(name)
    canvas = page.locator(".gsnb-moving-map .gsnb-splat-software")
    page.wait_for_function(
        "document.querySelector('.gsnb-splat-status')?.textContent.includes('Gaussians in view')"
    )
    look = lambda: canvas.evaluate("c => c.toDataURL()")  # noqa: E731
    before = look()
    page.wait_for_timeout(2000)
    assert look() != before
    box = page.locator(".gsnb-splat-scene").bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 150)
    page.mouse.down()
    page.mouse.up()
    page.wait_for_timeout(2000)
    at_rest = look()
    page.wait_for_timeout(1000)
    assert look() == at_rest
    page.mouse.down()
    page.mouse.move(box["x"] + 260, box["y"] + 160, steps=4)
    page.mouse.up()
    page.wait_for_timeout(2000)
    assert look() != at_rest


@pytest.mark.parametrize(
    ("chapter", "says"),
    [(1, "same surface"), (2, "After 1 frame D"), (3, "3,283 cells")],
)
def test_a_panel_computes_in_the_page(opened, chapter, says):
    text = opened(f"notebooks/{CHAPTERS[chapter]}").locator(".gsnb-live [role=status]")
    text.filter(has_text=says).wait_for()
    before = text.inner_text()
    text.page.get_by_role("slider").nth(1).press("ArrowRight")
    assert text.inner_text() != before


@pytest.mark.parametrize("chapter", CHAPTERS)
def test_a_chapter_opens_at_every_width(opened, chapter):
    page = opened(f"notebooks/{chapter}", viewport={"width": 390, "height": 800})
    page.wait_for_load_state("load")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), (
        "the page is wider than a phone"
    )
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
    assert page.locator("ul.search li a").first.get_attribute("href").startswith("notebooks/")
    assert page.locator("ul.search li").count() > 3


def faults(page, rules=None) -> list[str]:
    """What axe-core finds grave on a page, by all of its rules or some: rule, element, what is
    wrong."""
    axe: Path = npm_programs.npm_folder("axe-core") / "axe-core" / "axe.min.js"
    page.add_script_tag(path=axe)
    options = {"resultTypes": ["violations"]} | ({"runOnly": rules} if rules else {})
    found = page.evaluate("options => axe.run(document, options)", options)
    grave = [violation for violation in found["violations"] if violation["impact"] in GRAVE]
    assert len(found["passes"]) >= (len(rules) if rules else 10)  # it looked
    return [
        f"{v['id']}: {node['html'][:120]} {node['failureSummary']}"
        for v in grave
        for node in v["nodes"][:3]
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_grave_on_the_pages(book_site, book_browser, scheme):
    npm_programs.npm_folder("axe-core")
    wrong = {}
    for name in PAGES if scheme == "light" else PAGES[:3]:
        page = book_browser.new_page(color_scheme=scheme)
        page.goto(f"file://{book_site / name}.html")
        page.wait_for_load_state("load")
        if found := faults(page, ["color-contrast"] if scheme == "dark" else None):
            wrong[name] = found
        page.close()
    assert wrong == {}
