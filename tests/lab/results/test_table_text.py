"""The tables: what is bold, what is underlined, what is said under them, and that special characters are harmless."""

import math
import re

import pytest

from gsfusion_nb.lab import Budget
from gsfusion_nb.lab.columns import COLUMNS
from gsfusion_nb.lab.result_table import failures, places, rank_table, scene_table
from gsfusion_nb.lab.statistics import group_runs
from gsfusion_nb.lab.table_text import as_latex, as_markdown, latex_file

PSNR, DEPTH, STEPS = COLUMNS["psnr_held_out_db"], COLUMNS["depth_l1_held_out_m"], COLUMNS["n_steps"]


def test_best_and_second_with_ties_and_directions():
    assert places([24.0, 25.0, 23.0], PSNR) == [2, 1, 0]
    assert places([0.03, 0.01, 0.02], DEPTH) == [0, 1, 2]
    assert places([25.001, 25.004, 23.0], PSNR) == [1, 1, 0]
    assert places([25.0, 24.0, 24.0, math.nan], PSNR) == [1, 2, 2, 0]
    assert places([25.0, 25.0], PSNR) == [0, 0]
    assert places([1.0, 2.0], STEPS) == [0, 0]
    assert places([math.nan, 2.0], PSNR) == [0, 0]


@pytest.fixture(scope="module")
def equal(made_run):
    budget = Budget(gaussians=4000)
    runs = [made_run("a_b", seed=s, psnr=24.0 + 0.1 * s, budget=budget, n_gaussians=4000.0 + s) for s in range(3)]
    runs += [
        made_run("c|d", seed=s, psnr=25.0, budget=budget, n_gaussians=4100.0, notes=["the mesh was not scored"])
        for s in range(3)
    ]
    runs += [made_run("lost", seed=s, budget=budget, failed="ValueError: 100 % wrong") for s in range(3)]
    return runs


def test_markdown(equal):
    text = as_markdown(scene_table(group_runs(equal)))
    lines = text.splitlines()
    assert lines[0] == "### room, 4,000 Gaussians, equal steps"
    assert lines[2] == "| rule | PSNR held out, dB | PSNR mapped, dB | Gaussians | Gradient steps |"
    assert lines[4] == r"| c\|d | **25.00 ± 0.00** | **27.00 ± 0.00** | 4,100 ± 0 | 200 ± 0 |"
    assert lines[5] == r"| a\_b | <u>24.10 ± 0.10</u> | <u>26.10 ± 0.10</u> | 4,001 ± 1 | 200 ± 0 |"
    assert lines[6] == "| lost | – | – | – | – |"
    assert "- mean ± standard deviation over 3 seeds" in lines
    assert "- lost: 0 of 3 runs" in lines
    assert r"- c\|d: the mesh was not scored" in lines
    assert failures(equal)[0] == ("lost", "room", "4,000 Gaussians, equal steps", 0, "ValueError: 100 % wrong")


def test_latex(equal):
    text = as_latex(scene_table(group_runs(equal)), label="tab:x")
    assert r"a\_b & \underline{24.10} {\scriptsize$\pm$ 0.10}" in text
    assert r"c|d & \textbf{25.00} {\scriptsize$\pm$ 0.00}" in text
    assert r" & \multicolumn{2}{c}{PSNR [dB]} &  &  \\" in text
    assert r"\cmidrule(lr){2-3}" in text
    assert r"rule & held out & mapped & Gaussians & Gradient steps \\" in text
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert {line.count("&") for line in rows[1:]} == {4}
    assert text.count("{") == text.count("}")


def test_wide_tables_are_split_in_latex(equal):
    text = latex_file([scene_table(group_runs(equal))])
    assert re.findall(r"\\label{(.*)}", text) == ["tab:lab-1", "tab:lab-2"]
    assert r"4,000 Gaussians, equal steps: quality" in text
    assert r"\textbackslash{}\&\%\$\#\_\{\}" in as_latex(scene_table([], title="\\&%$#_{}"))


def test_at_own_budgets_the_table_says_what_differs(made_run):
    own = Budget(steps="own")
    runs = [made_run("a", n_gaussians=1000.0, n_steps=100.0, budget=own), made_run("b", n_gaussians=4000.0, budget=own)]
    table = scene_table(group_runs(runs))
    assert table.notes[0] == "one seed: no standard deviation"
    assert table.notes[1] == (
        "not equal between the rules: 1,000 to 4,000 Gaussians (a factor of 4.0) and "
        "100 to 200 gradient steps (a factor of 2.0); quality also depends on these"
    )
    cells = dict(zip((c.metric for c in table.columns), table.rows[0].cells, strict=True))
    assert cells["psnr_held_out_db"].text == "24.00"
    assert [row.cells[2].place for row in table.rows] == [1, 2]  # fewer Gaussians are better where they are free


def test_ranks_as_a_table(made_run):
    runs = [
        made_run(n, s, psnr=db)
        for n, s, db in (("a", "room", 25.0), ("b", "room", 24.0), ("a", "hall", 19.0), ("b", "hall", 18.0))
    ]
    table = rank_table(group_runs([*runs, made_run("c", "hall")]))
    assert [c.name for c in table.columns] == ["room, dB", "hall, dB", "Mean rank"]
    assert [(row.label, row.cells[-1].mean) for row in table.rows] == [("a", "1.50"), ("b", "2.50"), ("c", "–")]
    assert table.notes[-1] == "no mean rank for c: no result on some scenes"
