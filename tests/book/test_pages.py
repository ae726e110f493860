"""The pieces of the web book on small inputs: pages of chapters, quiz, settings, the link checker."""

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest
from book.assemble import with_answers
from book.build import broken_links
from book.chapters import Chapter
from book.pages import Places, in_the_book, places_of

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def places() -> Places:
    return places_of(ROOT)


def code(name: str, source: str, *outputs: dict) -> dict:
    return {"cell_type": "code", "id": name, "source": source, "outputs": list(outputs), "metadata": {}}


def shown(kind: str, value: str, **metadata) -> dict:
    return {"output_type": "execute_result", "data": {kind: value}, "metadata": {kind: metadata}}


@pytest.fixture
def chapter(places) -> Chapter:
    png = base64.b64encode(cv2.imencode(".png", np.zeros((4, 6, 3), np.uint8))[1].tobytes()).decode()
    text = (
        "# Title\n\n<!-- holds\nq: {n}\n-->\n\n$$a = b$$\n\n$$c = d \\tag{Eq. 7}$$\n\nSee [two](02_tsdf_fusion.ipynb)."
    )
    cells = [
        {"cell_type": "markdown", "id": "t", "source": text, "metadata": {}},
        code("ask", 'predict("n", "How many?", [1, 10], unit="px")'),
        code("run", "print(9)", {"output_type": "stream", "name": "stdout", "text": ["9 < 10\n", "\n", "end\n"]}),
        code("came", 'came("n", 9)', shown("text/html", "<div class='gsnb-outcome'><b>It came: 9.</b></div>")),
        code("spoils", "print(8)", {"output_type": "stream", "name": "stdout", "text": "8"}),
        {"cell_type": "markdown", "id": "t2", "source": "Next.", "metadata": {}},
        code("free", "print(7)", {"output_type": "stream", "name": "stdout", "text": "7"}),
        code("empty", 'def psnr(rendered, photo):\n    """In dB."""\n    ...'),
        code("solved", "### BEGIN SOLUTION\ndef psnr(a, b):\n    return 1\n\n\n### END SOLUTION"),
        code("picture", "show(x)", shown("image/png", png, alt='a "black" picture', width=12)),
    ]
    return Chapter({"cells": cells}, "notebooks/03_quadtree_decomposition.ipynb", places, bar="<p>bar</p>")


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
    assert list(chapter.files.contents) == [address]


def test_what_came_waits_for_the_prediction(chapter):
    page = chapter.markdown()
    assert page.count('data-prediction="n"') == 4  # the question, what came, the outputs before and after it
    assert '<input type="radio" name="n" value="10"> 10 px' in page
    assert page.index("See what came") < page.index("9 &lt; 10") < page.index("It came: 9.")


def test_a_file_that_is_named_leads_to_its_source_and_a_name_beside_it_to_its_line(places):
    row = "| 6 | `gsfusion_nb/tsdf/integrate.py` | `signed_distance_m` |"
    line = places.line_of("gsfusion_nb/tsdf/integrate.py", "signed_distance_m")
    page = in_the_book(row, "docs/equations.md", places)
    assert line > 0
    assert 'href="../source/gsfusion_nb/tsdf/integrate.py.html"' in page
    assert f'href="../source/gsfusion_nb/tsdf/integrate.py.html#L-{line}"' in page
    assert in_the_book("`no/such/file.py`\n\n```\n[a](b.py)\n```", "docs/x.md", places).count("<a ") == 0


def test_a_question_of_the_quiz_gets_its_answer():
    questions = (
        "# Quiz\n\n**psnr-1**\n\n```python\nx\n```\n\nWhich?\n\n- A. one\n- B. `two`\n\n**psnr-2**\n\nAnd?\n\n- A. a\n"
    )
    answers = "| `psnr-1` | B | two. Got 1 |\n| `psnr-2` | A | yes |\n"
    page = with_answers(questions, answers)
    assert page.count("<form") == 2
    assert 'data-right="B"' in page
    assert 'value="B"><span>B. <code>two</code></span>' in page
    assert "The checker says: two. Got 1" in page
    with pytest.raises(ValueError, match="no answer to psnr-2"):
        with_answers(questions, answers.splitlines()[0])


def test_the_link_checker_finds_what_is_wrong(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a/b.html").write_text('<p id="here"><a href="../index.html#top">up</a></p>')
    (tmp_path / "index.html").write_text(
        '<h1 id="top"><a href="a/b.html#here">right</a> <a href="https://example.org">elsewhere is allowed</a>'
        '<a href="a/b.html#gone">1</a><img src="no.png" alt=""><script src="https://cdn.example.org/x.js"></script>'
        '<a href="../outside.html">4</a></h1>'
    )
    (tmp_path / "s.css").write_text('@import "https://fonts.example.org/f.css";')
    assert broken_links(tmp_path) == [
        "index.html loads https://cdn.example.org/x.js from another server",
        "index.html leads to ../outside.html: no such file",
        "index.html leads to a/b.html#gone: the page has no such place",
        "index.html leads to no.png: no such file",
        "s.css loads https://fonts.example.org/f.css from another server",
    ]
