"""The pieces of the web book on small inputs: pages of chapters, quiz, reference."""

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from book.assemble import api_page, quiz_page, root_page
from book.chapters import Chapter
from book.page_text import Places, in_the_book, places_of
from book.pictures import picture_html
from quiz import question

from gsfusion_nb.course import exercises
from gsfusion_nb.drawing.curves import BETWEEN, PALETTE

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def places() -> Places:
    return places_of(ROOT)


def code(name: str, source: str, *outputs: dict) -> dict:
    return {
        "cell_type": "code",
        "id": name,
        "source": source,
        "outputs": list(outputs),
        "metadata": {},
    }


def shown(kind: str, value: str, **metadata) -> dict:
    return {"output_type": "execute_result", "data": {kind: value}, "metadata": {kind: metadata}}


@pytest.fixture
def chapter(places) -> Chapter:
    png = base64.b64encode(
        cv2.imencode(".png", np.zeros((4, 6, 3), np.uint8))[1].tobytes()
    ).decode()
    text = (
        "# Title\n\n<!-- holds\nq: {n}\n-->\n\n$$a = b$$\n\n$$c = d \\tag{Eq. 7}$$\n\nSee "
        "[two](02_tsdf_fusion.ipynb)."
    )
    cells = [
        {"cell_type": "markdown", "id": "t", "source": text, "metadata": {}},
        code("ask", 'predict("n", "How many?", [1, 10], unit="px")'),
        code(
            "run",
            "print(9)",
            {"output_type": "stream", "name": "stdout", "text": ["9 < 10\n", "\n", "end\n"]},
        ),
        code(
            "came",
            'came("n", 9)',
            shown("text/html", "<div class='gsnb-outcome'><b>It came: 9.</b></div>"),
        ),
        code("spoils", "print(8)", {"output_type": "stream", "name": "stdout", "text": "8"}),
        {"cell_type": "markdown", "id": "t2", "source": "Next.", "metadata": {}},
        code("free", "print(7)", {"output_type": "stream", "name": "stdout", "text": "7"}),
        code("empty", 'def psnr(rendered, photo):\n    """In dB."""\n    ...'),
        code("solved", "### BEGIN SOLUTION\ndef psnr(a, b):\n    return 1\n\n\n### END SOLUTION"),
        code("picture", "show(x)", shown("image/png", png, alt='a "black" picture', width=12)),
    ]
    return Chapter(
        {"cells": cells}, "notebooks/03_quadtree_decomposition.ipynb", places, bar="<p>bar</p>"
    )


def test_a_chapter_has_text_numbers_hints_solution_and_pictures(chapter):
    page = chapter.markdown()
    assert page.startswith("# Title\n")
    assert "holds" not in page
    assert r"a = b \tag{3.1}" in page
    assert r"c = d \tag{Eq. 7}" in page
    assert 'id="eq-3-2"' in page
    assert "[two](02_tsdf_fusion.md)" in page
    assert "9 &lt; 10\n\nend</pre>" in page
    assert "Hint 1 of" in page
    assert "<summary>Solution</summary>" in page
    assert "BEGIN SOLUTION" not in page
    address = "03_quadtree_decomposition_files/picture-0.png"
    assert f'src="{address}" width="12" height="8"' in page
    assert 'alt="a &quot;black&quot; picture"' in page
    assert list(chapter.files) == [address]


def test_a_wide_picture_has_its_words_below_it_and_can_be_enlarged():
    png = cv2.imencode(".png", np.zeros((4, 6, 3), np.uint8))[1].tobytes()
    wide = picture_html("a/b.png", png, {"alt": "left < right", "width": 600}, "png")
    assert '<a href="a/b.png"><img' in wide
    assert '<figcaption aria-hidden="true">left &lt; right</figcaption>' in wide
    narrow = picture_html("a/b.png", png, {"alt": "left < right", "width": 300}, "png")
    assert narrow.startswith("<img")
    assert "figcaption" not in narrow


def test_the_words_of_a_steppers_still_are_text(places):
    still = np.zeros((6, 8, 4), np.uint8)
    still[:3, :4] = (1, 2, 3, 255)
    still[3:, :4] = (7, 8, 9, 255)
    png = base64.b64encode(cv2.imencode(".png", still)[1].tobytes()).decode()
    steps = [
        {"title": "a < b", "place": "x.py:1", "code": "y = a & b", "numbers": [["p", "1"]]},
        {"title": "Next", "place": "x.py:2", "code": "return y", "numbers": []},
    ]
    output = shown("image/png", png, alt="both", width=900, steps=steps)
    output["data"]["text/plain"] = "A stepper: 2 steps"
    made = Chapter({"cells": [code("go", "s", output)]}, "notebooks/03_q.ipynb", places)
    page = made.markdown()
    assert list(made.files) == ["03_q_files/go-0-0.png", "03_q_files/go-0-1.png"]
    second = cv2.imdecode(
        np.frombuffer(made.files["03_q_files/go-0-1.png"], np.uint8), cv2.IMREAD_UNCHANGED
    )
    assert second is not None
    assert second.shape == (3, 4, 4)
    assert (second == (7, 8, 9, 255)).all()
    assert page.count('width="450" height="338"') == 2
    for text in ("<p>a &lt; b</p>", "<pre>y = a &amp; b</pre>", "<td>p</td><td>1</td>"):
        assert text in page


def contrast(colour: str, brightness: float, ground: str) -> float:
    """Contrast ratio of WCAG, of a colour that a page makes brighter."""

    def luminance(name: str, factor: float) -> float:
        values = [min(1.0, factor * int(name[i : i + 2], 16) / 255) for i in (1, 3, 5)]
        linear = [v / 12.92 if v <= 0.03928 else ((v + 0.055) / 1.055) ** 2.4 for v in values]
        return float(np.dot([0.2126, 0.7152, 0.0722], linear))

    low, high = sorted((luminance(colour, brightness), luminance(ground, 1.0)))
    return (high + 0.05) / (low + 0.05)


def test_graphs_are_seen_on_a_dark_page():
    css = (ROOT / "tools/book/static/book.css").read_text()
    light, *dark = [float(x) for x in re.findall(r"--gsnb-graph: ([\d.]+);", css)]
    assert light == 1
    assert len(dark) == 2  # chosen by the reader, and by the system
    for colour in (*PALETTE, BETWEEN):
        assert all(contrast(colour, factor, "#131416") >= 4 for factor in dark), colour


def test_what_came_waits_for_the_prediction(chapter):
    page = chapter.markdown()
    # the question, what came, the outputs before and after it
    assert page.count('data-prediction="n"') == 4
    assert '<input type="radio" name="n" value="10"> 10 px' in page
    assert page.index("See what came") < page.index("9 &lt; 10") < page.index("It came: 9.")


def test_links_to_files_lead_to_the_repository_if_there_is_one(places):
    text = "[the volume](../gsfusion_nb/tsdf/integrate.py)\n\n```\n[a](b.py)\n```"
    page = in_the_book(text, "docs/x.md", places_of(ROOT, "https://example.org/"))
    assert page == text.replace("../gsfusion_nb", "https://example.org/gsfusion_nb")
    assert in_the_book(text, "docs/x.md", places).startswith("the volume\n")


@pytest.mark.parametrize("path", ["docs/book/index.md", "docs/install.md"])
def test_a_page_says_where_the_repository_is_if_there_is_one(places, path):
    text = (ROOT / path).read_text(encoding="utf-8")
    page = in_the_book(text, path, places_of(ROOT, "https://example.org/name/blob/HEAD/"))
    assert "`git clone https://example.org/name`" in page
    assert "git clone" not in in_the_book(text, path, places)


def test_a_question_of_the_quiz_can_be_answered():
    asked = question(exercises()["psnr"], 1)
    assert asked is not None
    page = quiz_page(0, [asked])
    assert f'data-right="{"ABCD"[asked.answer]}"' in page
    assert page.count("<label") == 4


def test_the_reference_lists_the_public_names_of_a_room():
    page = api_page("tsdf", ROOT / "gsfusion_nb")
    assert "autofunction:: gsfusion_nb.tsdf.tsdf_update" in page
    assert "autofunction:: gsfusion_nb.backends.use_backend" in api_page(
        "backends", ROOT / "gsfusion_nb"
    )


def test_the_pages_at_the_root_lead_from_there(places):
    text = (ROOT / "docs/book/index.md").read_text(encoding="utf-8")
    page = root_page(text, "docs/book/index.md", places)
    assert "(notebooks/00_quickstart.md)" in page
    assert "(splatting.md)" in page
    assert 'src="_static/moving_map.webp"' in page
    one_page = "[one page](book/splatting.md)"
    assert in_the_book(one_page, "docs/index.md", places) == "[one page](../splatting.md)"


def test_the_list_of_pages_names_them_all_by_what_they_are():
    text = (ROOT / "docs/book/index.md").read_text(encoding="utf-8")
    listed = text.rpartition("```{toctree}")[0]  # the last list is out of sight
    names = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index", "api"}
    assert [name for name in sorted(names) if f"docs/{name}\n" not in listed] == []
    assert "\nWhat is in the package <README>\n" in listed


def test_the_page_of_splatting_has_its_panels(places):
    text = (ROOT / "docs/book/splatting.md").read_text(encoding="utf-8")
    page = root_page(text, "docs/book/splatting.md", places)
    names = re.findall(r'data-live="(\w+)"', page)
    assert names == ["gaussian", "order", "stack", "paint", "seeds", "room"]
    # the first poster at once, the others when they are near
    assert page.count('fetchpriority="high"') == 1
    assert page.index('fetchpriority="high"') < page.index('loading="lazy"')
    assert "(notebooks/04_splatting_forward.md)" in page
    assert "(docs/install.md)" in page
