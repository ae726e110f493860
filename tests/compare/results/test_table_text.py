"""The tables: what is bold, what is underlined, what is said under them, and that special characters are harmless."""

import re

import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.statistics import COLUMNS, group_runs
from gsfusion_nb.compare.tables import as_latex, as_markdown, failures, latex_file, places, scene_table, scenes_table

PSNR, DEPTH, STEPS = COLUMNS["psnr_held_out_db"], COLUMNS["depth_l1_held_out_m"], COLUMNS["n_steps"]


def test_best_and_second_share_a_place_within_noise():
    high, near, low = [25.0, 25.1, 24.9], [24.9, 25.2, 24.8], [23.0, 23.1, 22.9]
    assert places([near, high, low, [20.0, 20.1, 19.9]], PSNR) == [1, 1, 2, 0]
    assert places([[0.03, 0.0301], [0.01, 0.0101]], DEPTH) == [2, 1]
    assert places([high, near], PSNR) == [0, 0]
    assert places([[107.0, 108.0, 106.0], [107.0, 109.0, 105.0]], COLUMNS["peak_memory_mb"]) == [0, 0]
    assert places([[25.0], [20.0]], PSNR) == [0, 0]  # one seed: nobody knows
    assert places([[], high, low], PSNR) == [0, 1, 2]
    assert places([[1.0, 1.0], [2.0, 2.0]], STEPS) == [0, 0]


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
    assert "- ± within a scene: standard deviation over 3 seeds, which change only random draws" in lines
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
    runs = [made_run("a", seed=s, n_gaussians=1000.0, n_steps=100.0, budget=own) for s in range(2)]
    runs += [made_run("b", seed=s, n_gaussians=4000.0, budget=own) for s in range(2)]
    table = scene_table(group_runs(runs))
    assert table.notes[1] == (
        "not equal between the rules: 1,000 to 4,000 Gaussians (a factor of 4.0) and "
        "100 to 200 gradient steps (a factor of 2.0); quality also depends on these"
    )
    cells = dict(zip((c.metric for c in table.columns), table.rows[0].cells, strict=True))
    assert cells["psnr_held_out_db"].text == "24.00 ± 0.00"
    assert [row.cells[2].place for row in table.rows] == [1, 2]  # fewer Gaussians are better where they are free


def test_the_scenes_as_columns(made_run):
    lead = {"room": 1.0, "hall": 1.2, "kitchen": 0.9, "attic": 1.1}
    runs = [made_run(n, s, psnr=20 + d * (n == "a")) for s, d in lead.items() for n in ("b", "a")]
    runs += [made_run("near", s, psnr=21.0 + 0.3 * (-1) ** i) for i, s in enumerate(lead)] + [made_run("c", "hall")]
    table = scenes_table(runs, str(Budget()), tuned_on={"a": "room"})
    names = [c.name for c in table.columns]
    assert names == [*(f"{s}, dB" for s in lead), "Mean, dB", "Mean rank", "Reference minus rule, dB", "p"]
    assert [(row.label, row.cells[4].mean, row.cells[4].place) for row in table.rows] == [
        ("a", "21.05", 1), ("near", "21.00", 1), ("b", "20.00", 0), ("c", "–", 0)
    ]  # fmt: skip
    assert [row.cells[6].mean for row in table.rows[:3]] == ["–", "0.05 (-0.69 to 0.79)", "1.05 (0.84 to 1.26)"]
    assert "a was tuned on: room" in table.notes
    assert "no mean for c: no result on some scenes" in table.notes
    assert any(note.startswith("one seed") for note in table.notes)
    by_b = scenes_table(runs, str(Budget()), reference="b")
    assert next(row.cells[6].mean for row in by_b.rows) == "-1.05 (-1.26 to -0.84)"
    assert [row.label for row in by_b.rows] == [row.label for row in table.rows]
    assert as_latex(table).count(r"\\") == 5
