"""The files of the lab: which are written, and what they say."""

import json
import math

import cv2
import numpy as np
import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.outputs import Results, Table
from gsfusion_nb.compare.page import costs_of, figure_of
from gsfusion_nb.compare.statistics import group_runs


def test_the_files(folder, written):
    assert all(path.parent == folder and path.stat().st_size > 1000 for path in written)
    papers = {"paper.tex", "paper.csv", "paper.md"}
    names = {"runs.csv", "table.md", "table.json", "pareto.pdf", "pareto.png", "page.html"} | papers
    assert {path.name for path in written} == names
    assert (folder / "pareto.pdf").read_bytes()[:5] == b"%PDF-"
    assert np.asarray(cv2.imread(str(folder / "pareto.png"))).shape == (1200, 1920, 3)


def test_the_tables_of_all_scenes_and_budgets(folder, made_results, tmp_path):
    titles = [table.title for table in Results(runs=made_results(tmp_path)).tables()]
    equal = "4,000 Gaussians, equal steps"
    own = "own size, own steps"
    assert titles == [
        f"{scene}, {budget}"
        for budget in (equal, own)
        for scene in ("All scenes", "room", "kitchen")
    ]
    text = (folder / "table.md").read_text()
    assert all(f"### {title}\n" in text for title in titles)
    assert "not equal between the rules: 1,510 to 9,010 Gaussians" in text
    # else an element, not seen
    assert "- uniform, kitchen, own size, own steps, seed 2: ValueError: \\<no> seeds" in text


def test_the_numbers_for_other_programs(made_run):
    runs = [
        made_run(n, s, psnr=20.123456 + d)
        for s, d in (("x", 0.0), ("y", 1.0), ("z", 0.5))
        for n in ("a", "b")
    ]
    runs += [made_run("c", "x", failed="no memory")]
    about = Table(text="seeds = 1", reference="b", tuned_on={"a": "x"})
    values = json.loads(json.dumps(Results(runs=runs, about=about).as_json(), allow_nan=False))
    assert (values["seeds"], values["tuned_on"], values["table"]) == ([0], {"a": "x"}, "seeds = 1")
    assert values["versions"] == [{"gsfusion_nb": "0.1.0", "torch": "2.6"}]
    assert values["rules"]["a"]["source"] == "def a(ctx): ..."
    (budget,) = values["budgets"]
    assert (budget["scenes"], budget["reference"]) == (["x", "y", "z"], "b")
    a = next(row for row in budget["rows"] if row["rule"] == "a")
    assert a["metrics"]["psnr_held_out_db"] == {
        "mean": pytest.approx(20.623456),
        "sd": pytest.approx(0.5),
        "n": 3,
    }
    assert a["scenes"]["y"]["psnr_held_out_db"] == {
        "mean": pytest.approx(21.123456),
        "sd": None,
        "n": 1,
    }
    assert (a["test"]["n"], a["test"]["verdict"]) == (3, "equal")
    assert (budget["tests"], budget["pairs"], budget["ranks"]) == ("reference", [], None)
    assert budget["rows"][2]["failed"] == {"x": "no memory"}


@pytest.mark.parametrize("tests", ["pairs", "nemenyi"])
def test_other_tests_are_in_all_files(made_run, tests):
    lead = {"a": 1.0, "b": 0.5, "c": 0.0}
    runs = [
        made_run(
            rule,
            f"scene {i}",
            psnr=20.0 + db + 0.1 * ((i * len(rule) + ord(rule)) % 3),
        )
        for i in range(8)
        for rule, db in lead.items()
    ]
    results = Results(runs=runs, about=Table(tests=tests))
    (budget,) = results.as_json()["budgets"]
    text = results._as_markdown()
    assert budget["tests"] == tests
    assert "a is better than c" in text
    if tests == "pairs":
        assert [(p["a"], p["b"], p["verdict"]) for p in budget["pairs"]] == [
            ("a", "b", "a"),
            ("a", "c", "a"),
            ("b", "c", "a"),
        ]
        assert {row["rule"]: row["test"] and row["test"]["verdict"] for row in budget["rows"]} == {
            "a": None,
            "b": "b",
            "c": "b",
        }
        assert (
            "Tests: every pair of rules, paired t tests, Holm's correction for all pairs." in text
        )
    else:
        assert budget["ranks"]["mean_ranks"] == {"a": 1.0, "b": 2.0, "c": 3.0}
        # chi^2 of 16 with 2 degrees of freedom
        assert budget["ranks"]["p"] == pytest.approx(math.exp(-8.0))
        assert {row["test"] for row in budget["rows"]} == {None}
        assert "Friedman's test of 3 rules on 8 scenes: p < 0.001, they are not all equal" in text


def test_what_is_plotted(made_run):
    """Gradient steps are a cost where they differ, the size where no budget fixes it."""
    runs = [made_run("a", n_steps=100.0), made_run("b")]
    assert [axes.get_xlabel() for axes in figure_of(runs).axes] == [
        "Gaussians (fewer is better)",
        "time per frame, ms (less is better)",
        "gradient steps (fewer is better)",
    ]
    assert [t.get_text() for t in figure_of(runs).axes[0].texts] == ["a", "b"]
    assert costs_of(group_runs(runs[1:])) == ["n_gaussians", "ms_per_frame"]
    assert costs_of(group_runs([made_run("a", budget=Budget(gaussians=4000))])) == ["ms_per_frame"]


def test_a_rule_at_several_budgets_is_named_once(made_run):
    runs = [
        made_run("a", budget=b, n_gaussians=n)
        for b, n in ((Budget(), 4e3), (Budget(steps="own"), 1e3))
    ]
    axes = figure_of([*runs, made_run("b", n_gaussians=1500.0)]).axes[0]
    assert [t.get_text() for t in axes.texts] == ["a", "b"]
    assert axes.get_xscale() == "log"


def test_nothing_yet(made_run):
    assert figure_of([]).axes[0].texts[0].get_text() == "no rule has finished yet"
    assert Results(runs=[]).tables() == []
    lost = Results(runs=[made_run("a", failed="no memory")])
    assert lost.tables()[0].notes == ("no run was completed",)
    assert "a did not run: no memory" in repr(lost)
