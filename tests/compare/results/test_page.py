"""The lab's page: that it holds everything, loads nothing, and that texts from outside stay
texts."""

import json
import re
from html.parser import HTMLParser

import cv2
import pytest

from gsfusion_nb.compare.outputs import Results
from gsfusion_nb.compare.page import views_of


class Elements(HTMLParser):
    """All elements with their attributes, and the text of scripts."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.scripts = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        if self.found and self.found[-1][0] == "script":
            self.scripts.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.found if name == tag]


@pytest.fixture(scope="module")
def text(folder):
    return (folder / "page.html").read_text()


@pytest.fixture(scope="module")
def page(text):
    return Elements(text)


def test_it_loads_nothing(text, page):
    addresses = [
        a[name] for _, a in page.found for name in ("src", "href", "xlink:href") if name in a
    ]
    assert all(address.startswith(("data:", "#")) for address in addresses)
    assert not re.search(
        r"@import|url\((?!#)|fetch\(|XMLHttpRequest|import\(", re.sub(r'"data:[^"]*"', "", text)
    )


def test_tables_of_each_budget_and_scene_and_the_ranks(page):
    shown = [
        (a["data-budget"], a["data-scene"])
        for a in page.all("div")
        if a.get("class") == "one-table"
    ]
    equal = "4,000 Gaussians, equal steps"
    own = "own size, own steps"
    assert shown == [(b, s) for b in (equal, own) for s in ("", "room", "kitchen")]
    assert {a["data-label"] for a in page.all("tr") if "data-label" in a} == {
        "quadtree",
        "uniform",
        "every <pixel> & more",
    }


def test_everything_has_a_name_for_screen_readers(page):
    ids = [a["id"] for _, a in page.found if "id" in a]
    assert len(ids) == len(set(ids))
    labelled = {a.get("for") for a in page.all("label")}
    assert {a["id"] for a in page.all("select")} <= labelled
    assert all(a.get("scope") for a in page.all("th"))
    assert all(a.get("alt") for a in page.all("img") if a.get("src"))
    assert all(
        a.get("aria-label") and a.get("tabindex") == "0"
        for a in page.all("div")
        if a.get("role") == "region"
    )
    assert all(a["aria-labelledby"] in ids for a in page.all("section"))


def test_pictures_are_stored_once_and_named_by_view(page):
    data = json.loads(page.scripts[0])
    assert len({(s["label"], s["scene"], s["budget"]) for s in data["shots"]}) == 12
    # the truth of two views; three rules, everywhere the same
    assert len(data["pictures"]) == 2 + 3 * 2 * 2
    shot = next(s for s in data["shots"] if s["label"] == "uniform" and s["scene"] == "kitchen")
    assert [view["name"] for view in shot["views"]] == ["4", "9"]
    assert shot["seed"] == 0
    assert all(uri.startswith("data:image/jpeg;base64,") for uri in data["pictures"])


def test_texts_from_outside_stay_texts(text):
    assert "<pixel>" not in text
    assert "<no>" not in text
    assert "every &lt;pixel&gt; &amp; more" in text


def test_comparisons_and_failures_are_there(text, page):
    sentences = json.loads(page.scripts[0])["sentences"]
    assert [s[:3] for s in sentences[:2]] == [
        ["4,000 Gaussians, equal steps", "quadtree", "uniform"],
        ["4,000 Gaussians, equal steps", "quadtree", "every <pixel> & more"],
    ]
    assert "is better than" in sentences[0][3]
    assert "ValueError: &lt;no&gt; seeds" in text


def test_a_page_without_results_or_pictures(made_run, tmp_path):
    lost = made_run("a", pictures={"held_out 4": "gone.png", "truth 4": "gone-too.png"})
    for runs, words in (
        ([], "0 runs"),
        ([made_run("a", failed="no memory")], "1 run failed"),
        ([lost], "1 runs"),
    ):
        Results(runs=runs).write(tmp_path)
        text = (tmp_path / "page.html").read_text()
        assert words in text
        assert json.loads(Elements(text).scripts[0])["pictures"] == []


def test_the_error_is_that_of_the_pictures(made_results, tmp_path):
    result = made_results(tmp_path)[0]
    frame, view = next(views_of(result, tmp_path))
    assert frame == "4"
    assert view["error"].shape == view["truth"].shape == (48, 64, 3)
    (tmp_path / result.pictures["held_out 4"]).write_bytes(b"damaged")
    # of another size
    cv2.imwrite(str(tmp_path / result.pictures["held_out 9"]), view["render"][:20])
    assert list(views_of(result, tmp_path)) == []
