"""The table of a paper: rows of scenes, bold by the test, LaTeX that compiles, CSV, Markdown."""

import csv
import dataclasses
import io
import re
import shutil
import subprocess

import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.paper_table import as_csv, latex_text, paper_tables

SCENES = ("x", "y", "z", "w")
BUDGET = str(Budget())


def bold(tables):
    """(scene, method, column) of the cells that are bold."""
    return {
        (row.scene, row.label, column.metric)
        for table in tables
        for row in table.rows
        for column, cell in zip(table.columns, row.cells, strict=True)
        if cell.best
    }


def runs_of(made_runs, label, first, **more):
    """Four scenes, two seeds; ``first`` on the first scene, a little more on each next one."""
    return made_runs(
        label, {s: (first + i, first + i + 0.1 * i) for i, s in enumerate(SCENES)}, **more
    )


@pytest.mark.parametrize("tests", ["reference", "pairs"])
def test_the_best_is_bold_where_the_test_says_so(made_runs, tests):
    better = runs_of(made_runs, "better", 25.0, mesh_accuracy_m=0.01)
    plain = runs_of(made_runs, "plain", 24.0, mesh_accuracy_m=0.01)
    [table] = paper_tables([*plain, *better], reference="plain", tests=tests)
    marked = bold([table])
    assert ("mean", "better", "psnr_held_out_db") in marked
    assert not any(metric == "mesh_accuracy_m" for _, _, metric in marked)  # equal
    assert not any(label == "plain" for _, label, _ in marked)
    # the reference itself is bold if it is better than all others
    assert ("mean", "better", "psnr_held_out_db") in bold(
        paper_tables([*plain, *better], reference="better", tests=tests)
    )


def test_a_difference_within_noise_is_not_bold(made_runs):
    a = made_runs("a", {"x": (24.0,), "y": (25.0,), "z": (24.5,)})
    b = made_runs("b", {"x": (24.1,), "y": (24.8,), "z": (25.9,)})
    assert not bold(paper_tables([*a, *b], reference="a"))
    one_seed = made_runs("c", {"x": (30.0,)}) + made_runs("d", {"x": (20.0,)})
    assert not bold(paper_tables(one_seed, reference="d"))


def test_ranks_decide_where_they_are_tested(made_runs):
    scenes = [f"s{i}" for i in range(12)]
    high, middle, low = (
        made_runs(label, {s: (db + 0.1 * i,) for i, s in enumerate(scenes)})
        for label, db in (("high", 30.0), ("middle", 25.0), ("low", 20.0))
    )
    [table] = paper_tables([*high, *middle, *low], tests="nemenyi")
    assert ("mean", "high", "psnr_held_out_db") in bold([table])


def test_rows_are_scenes_and_their_mean(made_runs):
    runs = runs_of(made_runs, "a", 24.0, mesh_completion_m=0.02, peak_memory_mb=900.0)
    [table] = paper_tables(runs)
    assert [(row.scene, row.label) for row in table.rows] == [(s, "a") for s in (*SCENES, "mean")]
    assert table.headings[0] == "PSNR, dB ↑"
    assert "Completion, cm ↓" in table.headings
    assert "Memory, MB ↓" in table.headings
    first = table.rows[1].cells[0]
    assert first.text == "25.05 ± 0.07"
    assert table.rows[-1].cells[0].text == "25.58"
    on_gpu = [dataclasses.replace(r, spec=dataclasses.replace(r.spec, device="cuda")) for r in runs]
    assert "GPU memory, MB ↓" in paper_tables(on_gpu)[0].headings


def test_views_are_those_that_are_asked_for(made_runs):
    [table] = paper_tables(runs_of(made_runs, "a", 24.0), views="mapped")
    assert table.columns[0].metric == "psnr_mapped_db"
    assert table.rows[0].cells[0].value == 26.0


def test_without_held_out_views_the_mapped_ones_are_scored(made_runs):
    runs = runs_of(made_runs, "a", 24.0)
    for run in runs:
        run.metrics.pop("psnr_held_out_db")
    assert paper_tables(runs)[0].columns[0].metric == "psnr_mapped_db"


def test_names_of_others_are_text():
    assert latex_text("50% of a_b & {c} \\x\n~^#$") == (
        r"50\% of a\_b \& \{c\} \textbackslash{}x \textasciitilde{}\textasciicircum{}\#\$"
    )


def test_csv_holds_the_numbers_of_all_tables(made_runs):
    own = runs_of(made_runs, "a", 24.0)
    fixed = runs_of(made_runs, "=b", 23.0, budget=Budget(gaussians=4000))
    rows = list(csv.DictReader(io.StringIO(as_csv(paper_tables([*own, *fixed])))))
    assert len(rows) == 10
    assert float(rows[0]["PSNR, dB"]) == 24.0
    assert {row["method"] for row in rows} == {"a", "'=b"}
    assert len({row["table"] for row in rows}) == 2


def latex_of(made_results, tmp_path):
    tables = paper_tables(made_results(tmp_path / "pictures"))
    return [table.as_latex() for table in tables]


def test_latex_has_equal_rows_and_pairs_of_braces(made_results, tmp_path):
    for text in latex_of(made_results, tmp_path):
        code = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
        plain = re.sub(r"\\[{}&]", "", code)
        assert plain.count("{") == plain.count("}")
        rows = [line for line in plain.splitlines() if line.endswith(r"\\")]
        assert len({row.count("&") for row in rows}) == 1
        assert code.count(r"\begin") == code.count(r"\end") == 2
        assert r"every <pixel> \& more" in code
        assert code.count(r"\midrule") == 3  # heads, two scenes, means
        code.encode("ascii")


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(made_results, tmp_path):
    document = "\n".join(
        [
            r"\documentclass{article}\usepackage{booktabs}\begin{document}",
            *latex_of(made_results, tmp_path),
            r"\end{document}",
        ]
    )
    (tmp_path / "paper.tex").write_text(document)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]


def test_markdown_has_a_row_of_each(made_runs):
    [table] = paper_tables(
        [*runs_of(made_runs, "a|b", 25.0), *runs_of(made_runs, "c", 24.0)], reference="c"
    )
    text = table.as_markdown()
    assert r"| mean | a\|b | **26.5" in text
    assert "Bold: the best, and better by the test" in text
