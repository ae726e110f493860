"""The web book in a real browser, opened as a folder of files: every chapter, and everything that reacts.

The book is built for these tests, or taken from $GSNB_BOOK.
"""

import os
import shutil
from pathlib import Path

import pytest

from gsfusion_nb.book.build import build, missing
from gsfusion_nb.book.settings import Settings

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
    assert build(ROOT, out, Settings()) == []
    return out


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no chromium here (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.fixture
def opened(browser, site):
    """Opens a page of the book; the test fails if a page wrote an error or asked for something elsewhere."""
    wrong: list[str] = []
    pages = []

    def open_page(name: str, **options):
        page = browser.new_page(**options)
        pages.append(page)
        page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: wrong.append(str(e)))
        page.on("request", lambda r: wrong.append(r.url) if r.url.startswith("http") else None)
        page.on("requestfailed", lambda r: wrong.append(f"{r.url}: {r.failure}"))
        page.goto(f"file://{site}/{name}.html")
        return page

    yield open_page
    for page in pages:
        page.close()
    assert wrong == []


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
