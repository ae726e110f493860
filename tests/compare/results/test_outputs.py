"""The files of the lab: which are written, what they say, and that LaTeX accepts the tables."""

import json
import shutil
import subprocess

import cv2
import numpy as np
import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.outputs import all_tables, write_outputs
from gsfusion_nb.compare.pareto import costs_of, figure_of, scene_points
from gsfusion_nb.compare.statistics import group_runs
from gsfusion_nb.compare.table_file import Table

DOCUMENT = r"""\documentclass{article}
\usepackage{booktabs,graphicx}
\begin{document}
\input{table}
\end{document}
"""


def test_the_files(folder, written):
    assert all(path.parent == folder and path.stat().st_size > 1000 for path in written)
    names = {
        "runs.csv",
        "provenance.json",
        "table.md",
        "table.tex",
        "table.json",
        "pareto.pdf",
        "pareto.png",
        "page.html",
    }
    assert {path.name for path in written} == names
    assert (folder / "pareto.pdf").read_bytes()[:5] == b"%PDF-"
    assert np.asarray(cv2.imread(str(folder / "pareto.png"))).shape == (1200, 1920, 3)


def test_the_tables_of_all_scenes_and_budgets(folder, made_results, tmp_path):
    titles = [table.title for table in all_tables(made_results(tmp_path))]
    equal, own = "4,000 Gaussians, equal steps", "own size, own steps"
    assert titles == [f"{scene}, {budget}" for budget in (equal, own) for scene in ("All scenes", "room", "kitchen")]
    text = (folder / "table.md").read_text()
    assert all(f"### {title}\n" in text for title in titles)
    assert "not equal between the rules: 1,510 to 9,010 Gaussians (a factor of 6.0)" in text
    assert "- uniform, kitchen, own size, own steps, seed 2: ValueError: <no> seeds" in text


def test_the_numbers_for_other_programs(made_run, tmp_path):
    runs = [made_run(n, s, psnr=20.123456 + d) for s, d in (("x", 0.0), ("y", 1.0), ("z", 0.5)) for n in ("a", "b")]
    runs += [made_run("c", "x", failed="no memory")]
    about = Table(text="seeds = 1", reference="b", tuned_on={"a": "x"}, skipped=("w: there is no folder w",))
    write_outputs(tmp_path, runs, about)
    values = json.loads((tmp_path / "table.json").read_text())
    assert (values["seeds"], values["tuned_on"], values["skipped"]) == ([0], {"a": "x"}, ["w: there is no folder w"])
    assert values["command"]
    assert values["versions"] == [{"gsfusion_nb": "0.1.0", "torch": "2.6"}]
    (budget,) = values["budgets"]
    assert (budget["scenes"], budget["reference"]) == (["x", "y", "z"], "b")
    a = next(row for row in budget["rows"] if row["rule"] == "a")
    assert a["metrics"]["psnr_held_out_db"] == {"mean": pytest.approx(20.623456), "sd": pytest.approx(0.5), "n": 3}
    assert a["scenes"]["y"]["psnr_held_out_db"] == {"mean": pytest.approx(21.123456), "sd": None, "n": 1}
    assert (a["test"]["n"], a["test"]["verdict"]) == (3, "equal")
    assert budget["rows"][2]["failed"] == {"x": "no memory"}
    assert "w: there is no folder w" in (tmp_path / "table.md").read_text()


def test_no_pareto_plot_where_the_budget_gives_every_rule_the_same_size(made_run, tmp_path):
    write_outputs(tmp_path, [made_run("a"), made_run("b")])
    assert (tmp_path / "pareto.png").is_file()
    equal = [made_run(n, budget=Budget(gaussians=4000), n_gaussians=x) for n, x in (("a", 3990.0), ("b", 4010.0))]
    written = write_outputs(tmp_path, equal)
    assert not (tmp_path / "pareto.png").exists()
    assert "pareto.pdf" not in {path.name for path in written}
    assert "Quality and cost" not in (tmp_path / "page.html").read_text()


def test_the_points_have_error_bars(made_results, tmp_path):
    groups = [g for g in group_runs(made_results(tmp_path)) if g.scene == "room"]
    points = scene_points(groups, "n_gaussians")
    assert list(points.names) == ["quadtree", "uniform", "every <pixel> & more"] * 2
    assert points.cost[3:].tolist() == [3010, 1510, 9010]
    assert np.asarray(points.cost_sd)[3:].tolist() == pytest.approx([10, 10, 10])
    assert (np.asarray(points.quality_sd) > 0).all()


def test_gradient_steps_are_a_cost_where_they_differ(made_run):
    runs = [made_run("a", n_steps=100.0), made_run("b")]
    assert [axes.get_xlabel() for axes in figure_of(runs).axes] == [
        "Gaussians (fewer is better)", "time per frame, ms (less is better)", "gradient steps (fewer is better)"
    ]  # fmt: skip
    assert costs_of(group_runs(runs[1:])) == ["n_gaussians", "ms_per_frame"]


def test_nothing_yet(made_run):
    assert len(figure_of([]).axes) == 1
    assert all_tables([]) == []
    lost = made_run("a", failed="no memory")
    assert figure_of([lost]).axes[0].texts[0].get_text() == "no rule has finished yet"
    assert all_tables([lost])[0].notes == ("no run was completed",)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no LaTeX here (Debian: texlive-latex-recommended)")
def test_latex_accepts_the_tables(folder):
    (folder / "paper.tex").write_text(DOCUMENT)
    done = subprocess.run(["pdflatex", "-halt-on-error", "paper"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-1500:]
    assert "Overfull" not in done.stdout
