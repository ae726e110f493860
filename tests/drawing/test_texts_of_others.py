"""Names and messages of others stay text: in pages, notebooks, Markdown and graphs nothing of them
is markup."""

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

import gsfusion_nb
from gsfusion_nb.compare import RunResult, RunSpec
from gsfusion_nb.compare.outputs import Results
from gsfusion_nb.compare.run_all import ResultStore
from gsfusion_nb.config import DataConfig
from gsfusion_nb.drawing.page import html_table, page_picture
from gsfusion_nb.recordings.checkup import CheckupReport, Finding
from gsfusion_nb.runs import ReportData, ReportPanel, write_report
from gsfusion_nb.viz.player import error_html

PACKAGE = Path(gsfusion_nb.__file__).parent
EVIL = (
    "</script></title></pre>\"'><script>alert(1)</script><img src=x onerror=alert(2)> {{7*7}} "
    "$\\x{$ [a](javascript:b)"
)


class Elements(HTMLParser):
    """What a browser would make of a page: scripts, attributes that are programs, and where links
    lead."""

    def __init__(self, html: str):
        super().__init__()
        self.scripts = []
        self.handlers = []
        self.links = []
        self.text = []
        self._in_script = False
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        self._in_script = tag == "script"
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        self.links += [value for name, value in attrs if name in ("src", "href") and value]

    def handle_endtag(self, tag):
        self._in_script = False

    def handle_data(self, data):
        (self.scripts if self._in_script else self.text).append(data)


def check_nothing_runs(html: str, *, n_shown: int = 1) -> None:
    page = Elements(html)
    assert not any(
        "alert(1)" in script for script in page.scripts if not script.lstrip().startswith("{")
    )
    assert page.handlers == []
    assert all(link.startswith(("data:", "#")) for link in page.links)
    shown = " ".join(page.text)
    assert shown.count("<script>alert(1)</script>") >= n_shown, "a name is left out, or is markup"
    assert "49" not in re.findall(r"onerror=alert\(2\)> (\S+)", shown)


def picture():
    return torch.rand(6, 8, 3)


def test_the_report(tmp_path):
    view = ReportPanel(
        name=EVIL,
        held_out=True,
        rgb=picture(),
        render=picture(),
        depth_m=torch.ones(6, 8),
        render_depth_m=torch.ones(6, 8),
        psnr=20.0,
        ssim=0.5,
    )
    run = ReportData(
        title=EVIL,
        subtitle=EVIL,
        metrics={EVIL: 1.0},
        config={EVIL: {EVIL: EVIL}},
        views=[view],
        warnings=[EVIL],
        mesh_pictures={EVIL: picture()},
        environment={EVIL: EVIL},
        files={EVIL: EVIL},
    )
    check_nothing_runs(write_report(tmp_path / "report.html", run).read_text("utf-8"), n_shown=10)


def test_the_check_of_a_recording(tmp_path):
    findings = [
        Finding(EVIL, verdict, EVIL, repair)
        for verdict in ("ok", "wrong")
        for repair in (EVIL, f"--{EVIL}")
    ]
    report = CheckupReport(
        name=EVIL,
        findings=findings,
        data=DataConfig(),
        length=1,
        frames_read=1,
        together=EVIL,
        reader={"camera": EVIL},
        pictures={EVIL: np.zeros((6, 8, 3), np.uint8)},
    )
    check_nothing_runs(report.write(tmp_path / "check.html").read_text("utf-8"), n_shown=8)
    check_nothing_runs(report._repr_html_(), n_shown=4)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    def run(label, seed, **more):
        spec = RunSpec(rule="uniform", label=label, scene=EVIL, data="room", seed=seed)
        numbers = {
            "psnr_held_out_db": 20.0 + seed,
            "n_gaussians": 4e3,
            "n_steps": 2e2,
            "psnr_mapped_db": 21.0,
        }
        return RunResult(
            **{"spec": spec, "status": "done", "metrics": numbers, "notes": [EVIL], **more}
        )

    runs = [run(EVIL, 0), run("plain", 0), run(EVIL, 1), run("plain", 1)]
    runs += [run("fails", 0, status="failed", reason=EVIL, metrics={})]
    return Results(runs=runs, store=ResultStore(tmp_path_factory.mktemp("store")))


def test_the_page_of_a_comparison(results, tmp_path):
    """The graph, too: a name with two dollars was a formula, and a false one ended the page with an
    error."""
    results.write(tmp_path)
    check_nothing_runs((tmp_path / "page.html").read_text("utf-8"), n_shown=6)
    check_nothing_runs(results._repr_html_(), n_shown=3)
    markdown = (tmp_path / "table.md").read_text("utf-8")
    assert "alert(1)" in markdown
    assert not re.search(r"(?<!\\)<script|(?<!\\)\[a", markdown)
    assert not re.search(r"^[\"']?[=+@]", (tmp_path / "runs.csv").read_text("utf-8"), re.MULTILINE)


def test_errors_and_tables_of_notebooks():
    check_nothing_runs(error_html(ValueError(EVIL)), n_shown=2)
    check_nothing_runs(
        html_table([[EVIL, "x"]], heads=[EVIL], foot=EVIL, name=EVIL),
        n_shown=3,
    )
    assert page_picture(picture(), EVIL)["alt"] == EVIL


MARKUP_OF_OURS = {
    "stored.html": ['data["text/html"] | safe'],  # what a widget's own template made
    "prediction.html": ['" &nbsp;|&nbsp; " | safe'],
}


def test_what_templates_take_as_markup_is_made_here():
    found = {}
    for path in (PACKAGE / "drawing/templates").glob("*.html"):
        text = path.read_text("utf-8")
        assert "autoescape" not in text
        unescaped = [
            part
            for part in re.findall(r"\{\{(.*?)\}\}|\((\".*?\" \| safe)\)", text)
            if "safe" in "".join(part)
        ]
        if unescaped:
            found[path.name] = len(unescaped)
    assert found == {name: len(parts) for name, parts in MARKUP_OF_OURS.items()}


def test_scripts_of_pages_put_text_into_elements():
    """``innerHTML`` is for what is constant, or escaped by Python."""
    known = {
        "LAYOUT",
        "PANEL_HTML",
        'model.get("title")',
        'model.get("code")',
        'model.get("numbers")',
    }
    for path in PACKAGE.rglob("*.js"):
        text = path.read_text("utf-8")
        assert set(re.findall(r"innerHTML = (.*?);", text)) <= known, path.name
        assert not re.search(
            r"insertAdjacentHTML|document\.write|outerHTML|\beval\(|new Function", text
        ), path.name
