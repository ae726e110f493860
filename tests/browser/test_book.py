"""The web book in a real browser, opened as a folder of files: every chapter, and everything that
reacts.

The book is built for these tests, or taken from $GSNB_BOOK. axe-core looks for what keeps people
out who do not see the page or use no mouse; it comes from npm:
``npm install --prefix DIR axe-core``, then GSNB_NPM=DIR.
"""

import re
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
    "splatting",
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


def panel_of(page, name: str):
    """A panel, in sight and started."""
    panel = page.locator(f"#live-{name}")
    panel.scroll_into_view_if_needed()
    page.wait_for_function(
        "name => !document.querySelector(`#live-${name} [data-picture] img`)",
        arg=name,
    )
    return panel


def look(picture) -> str:
    """What a canvas shows."""
    return picture.evaluate("canvas => canvas.toDataURL()")


def drag(page, handle, dx: float, dy: float) -> None:
    """With the mouse, so many pixels."""
    handle.scroll_into_view_if_needed()
    box = handle.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + dx / 2, y + dy / 2)
    page.mouse.move(x + dx, y + dy)
    page.mouse.up()


@pytest.mark.parametrize(
    ("chapter", "name", "says"),
    [
        (1, "pixel", "same surface"),
        (2, "fusion", "After 1 frame D"),
        (3, "quadtree", "3,283"),
        (3, "seeds", "Gaussians"),
        (4, "gaussian", "It colours"),
        (4, "order", "in front"),
        (4, "stack", "of the light is left"),
        (5, "paint", "PSNR"),
        (6, "room", "when it was mapped"),
    ],
)
def test_a_panel_computes_in_the_page(opened, chapter, name, says):
    panel = panel_of(opened(f"notebooks/{CHAPTERS[chapter]}", reduced_motion="reduce"), name)
    text = panel.get_by_role("status")
    text.filter(has_text=says).wait_for()
    assert not re.search(r"[ (]-\d", text.inner_text()), "a hyphen is no minus"
    before = text.inner_text(), [look(picture) for picture in panel.locator("canvas").all()]
    if name == "paint":
        panel.get_by_role("button", name="One step").click()
    elif name == "stack":
        panel.get_by_role("button", name="Pixel").press("ArrowLeft")
    elif name == "order":
        panel.get_by_role("button", name="Swap").click()
    else:
        panel.get_by_role("slider").first.press("ArrowRight")
    now = text.inner_text(), [look(picture) for picture in panel.locator("canvas").all()]
    assert now[1] != before[1]


def test_one_gaussian_is_dragged_turned_and_stretched(opened):
    page = opened("splatting")
    panel = panel_of(page, "gaussian")
    text, picture = panel.get_by_role("status"), panel.locator("canvas")
    values = lambda: [panel.get_by_label(n).input_value() for n in ("turn", "long axis, m")]  # noqa: E731
    before, seen = values(), look(picture)
    drag(page, panel.get_by_role("button", name="End of its long axis"), -40, 60)
    turned = values()
    assert turned[0] != before[0]
    assert turned[1] != before[1]
    assert look(picture) != seen
    covariance = text.inner_text()
    drag(page, panel.get_by_role("button", name="Middle of the Gaussian"), 60, 30)
    assert values() == turned
    assert text.inner_text() != covariance  # the perspective is another one there
    panel.get_by_role("button", name="End of its other axis").press("ArrowDown")
    assert values() != turned


def test_the_order_of_two_gaussians_changes_the_picture(opened):
    panel = panel_of(opened("splatting"), "order")
    picture = panel.locator("canvas")
    front = lambda: panel.get_by_role("status").locator("b").inner_text().split()[0]  # noqa: E731
    assert front() == "orange"
    before = look(picture)
    panel.get_by_role("button", name="Swap").click()
    assert front() == "blue"
    assert look(picture) != before
    panel.get_by_role("button", name="Swap").click()
    assert look(picture) == before


def test_a_gaussian_that_is_pulled_shows_its_gradient(opened, tmp_path):
    page = opened("splatting", reduced_motion="reduce")
    panel = panel_of(page, "paint")
    text = panel.get_by_role("status")
    for _ in range(3):
        panel.get_by_role("button", name="One step").click()
    assert "Step 3" in text.inner_text()
    painting = panel.locator("[data-picture=painting] canvas")
    painting.click(position={"x": 150, "y": 90})
    said = text.inner_text()
    assert "dL/du" in said
    drag(page, panel.get_by_role("button", name="The chosen Gaussian"), 40, 20)
    pulled = text.inner_text()
    assert pulled.split("dL/du")[1] != said.split("dL/du")[1]
    assert "Step 3" in pulled  # pulling is no step
    # a photograph of the reader's; a file that is none says so and loses nothing
    file = panel.locator("input[type=file]")
    (tmp_path / "no.jpg").write_text("no picture")
    file.set_input_files(tmp_path / "no.jpg")
    text.filter(has_text="not a picture").wait_for()
    photo = panel.locator("[data-picture=photo] canvas")
    before = look(photo)
    file.set_input_files(ROOT / "docs/images/rtg_states.jpg")
    page.wait_for_function(
        "() => document.querySelector('#live-paint [role=status]').textContent.includes('Step')"
    )
    panel.get_by_role("button", name="Pause").click()
    assert look(photo) != before


def test_a_drawing_is_painted(opened):
    page = opened("splatting", reduced_motion="reduce")
    panel = panel_of(page, "paint")
    photo = panel.locator("[data-picture=photo] canvas")
    panel.get_by_role("button", name="Draw a picture").click()
    white = look(photo)
    drag(page, photo, 50, 20)
    drawn = look(photo)
    assert drawn != white
    panel.get_by_role("button", name="Paint my drawing").click()
    panel.get_by_role("button", name="Pause").click()
    assert look(photo) != white


def test_the_room_is_forgotten_and_mended(opened):
    panel = panel_of(opened("splatting"), "room")
    text, time = panel.get_by_role("status"), panel.get_by_label("time")
    db = lambda: float(text.inner_text().split("mapped frames: ")[1].split()[0])  # noqa: E731
    text.filter(has_text="mapped frames").wait_for()
    forgotten = db()
    for _ in range(3):
        time.press("ArrowRight")
    assert "passes" in text.inner_text()
    assert db() > forgotten + 1
    time.press("Home")
    assert "after 1 frames" in text.inner_text() or "after 1 frame" in text.inner_text()


def test_a_thumb_on_a_picture_scrolls_and_on_a_handle_drags(opened):
    page = opened("splatting", viewport={"width": 390, "height": 800}, has_touch=True)
    panel = panel_of(page, "gaussian")
    swipe = page.context.new_cdp_session(page)

    def touch(kind: str, *points: dict) -> None:
        swipe.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})
        page.wait_for_timeout(20)

    def thumb(x: float, y: float, dy: float) -> None:
        touch("touchStart", {"x": x, "y": y})
        for k in range(1, 11):
            touch("touchMove", {"x": x, "y": y + dy * k / 10})
        touch("touchEnd")
        page.wait_for_timeout(300)

    panel.locator("canvas").scroll_into_view_if_needed()
    box, before = panel.locator("canvas").bounding_box(), page.evaluate("scrollY")
    thumb(box["x"] + 15, box["y"] + box["height"] - 15, -200)
    assert page.evaluate("scrollY") > before + 100
    panel.locator("canvas").scroll_into_view_if_needed()
    handle = panel.get_by_role("button", name="Middle of the Gaussian")
    box, before = handle.bounding_box(), page.evaluate("scrollY")
    assert min(box["width"], box["height"]) >= 44
    thumb(box["x"] + 22, box["y"] + 22, -60)
    assert page.evaluate("scrollY") == before
    assert handle.bounding_box()["y"] < box["y"] - 30


def test_a_page_without_scripts_has_its_pictures(book_site, book_browser):
    page = book_browser.new_page(java_script_enabled=False, viewport={"width": 390, "height": 800})
    page.goto(f"file://{book_site}/splatting.html")
    posters = page.locator(".gsnb-live-stage img")
    assert posters.count() == 9
    posters.first.scroll_into_view_if_needed()
    assert posters.first.bounding_box()["height"] > 200
    assert page.locator(".gsnb-live [role=status]").first.inner_text()
    assert page.locator(".gsnb-live input:not([disabled])").count() == 0
    page.close()


_SHIFTS = """new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) if (!entry.hadRecentInput) window.shift += entry.value;
}).observe({ type: "layout-shift", buffered: true }); window.shift = 0;"""


@pytest.mark.parametrize("name", ["index", "splatting"])
@pytest.mark.parametrize("width", [390, 1280])
def test_a_page_does_not_move_when_its_map_and_panels_come(open_file, book_site, name, width):
    page = open_file(book_site / f"{name}.html", viewport={"width": width, "height": 800})
    page.evaluate(_SHIFTS)
    page.wait_for_timeout(1500)
    if name == "index":
        page.wait_for_selector(".gsnb-moving-map-live")
    for _ in range(12):
        page.mouse.wheel(0, 500)
        page.wait_for_timeout(150)
    page.wait_for_timeout(1000)
    assert page.evaluate("window.shift") < 0.1


def test_the_first_page_says_what_it_is_to_other_sites(opened):
    page = opened("index")
    assert "Gaussian splatting" in page.title()
    named = "meta[property='og:title'], meta[property='og:description'], meta[name=description]"
    assert page.locator(named).count() == 3
    for words in page.locator("meta[property='og:description'], meta[name=description]").all():
        assert "3D Gaussian splatting" in (words.get_attribute("content") or "")


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
    # at one moment, because a map takes the place of its poster
    texts = page.evaluate("[...document.querySelectorAll('article img')].map((i) => i.alt)")
    assert all(texts)


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
    chosen = form.locator("label", has=page.locator(f"input[value={wrong}]"))
    assert f"Not this one. {chosen.get_attribute('data-why')}" in form.inner_text()
    form.locator(f"input[value={right}]").check()
    assert "Right." in form.inner_text()
    assert "The checker says" in page.locator("form.gsnb-quiz").last.text_content()


def test_the_search_finds_a_word(opened):
    page = opened("search")
    address = page.url
    page.goto(f"{address}?q=quadtree")
    page.wait_for_selector("ul.search li a")
    assert page.locator("ul.search li a").first.get_attribute("href").startswith("notebooks/")
    assert page.locator("ul.search li").count() > 3
    # where it is explained is among the first, though chapter 10 comes before 2 in the alphabet
    page.goto(f"{address}?q=truncation")
    page.wait_for_selector("ul.search li a")
    first = [a.get_attribute("href") for a in page.locator("ul.search li > a").all()[:5]]
    assert any("02_tsdf_fusion" in href for href in first)


@pytest.mark.parametrize(
    ("words", "pages"),
    [
        ("install windows", {"docs/classroom.html", "docs/install.html"}),
        ("own recording", {"docs/own_data.html", "notebooks/11_a_real_recording.html"}),
        ("quadtree", {"notebooks/03_quadtree_decomposition.html"}),
        ("install", {"docs/install.html"}),
        # questions of the quiz come after the pages that explain
        ("psnr", {"notebooks/00_quickstart.html"}),
    ],
)
def test_the_search_finds_first_what_is_named_so(opened, words, pages):
    page = opened("search")
    page.goto(f"{page.url}?q={words.replace(' ', '+')}")
    page.wait_for_selector("ul.search li a")
    first = page.locator("ul.search li > a").all()[: len(pages)]
    assert {a.get_attribute("href").partition("?")[0] for a in first} == pages


def test_labels_in_a_wide_picture_are_text_on_a_phone(opened):
    page = opened("notebooks/08_tracking")
    caption = page.locator(".gsnb-wide figcaption", has_text="what the camera sees now").first
    assert not caption.is_visible()
    page.set_viewport_size({"width": 390, "height": 844})
    assert caption.is_visible()
    assert caption.evaluate("c => parseFloat(getComputedStyle(c).fontSize)") >= 12
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


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
    for name in PAGES if scheme == "light" else PAGES[:4]:
        page = book_browser.new_page(color_scheme=scheme)
        page.goto(f"file://{book_site / name}.html")
        page.wait_for_load_state("load")
        if found := faults(page, ["color-contrast"] if scheme == "dark" else None):
            wrong[name] = found
        page.close()
    assert wrong == {}
