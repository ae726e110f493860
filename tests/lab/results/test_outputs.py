"""The files of the lab: which are written, what they say, and that LaTeX accepts the tables."""

import shutil
import subprocess

import cv2
import numpy as np
import pytest

from gsfusion_nb.lab import Budget
from gsfusion_nb.lab.best_rule import against_the_best, comparison_sentence
from gsfusion_nb.lab.outputs import all_tables
from gsfusion_nb.lab.scene_plots import costs_of, figure_of, scene_points
from gsfusion_nb.lab.statistics import group_runs

DOCUMENT = r"""\documentclass{article}
\usepackage{booktabs,graphicx}
\begin{document}
\input{table}
\end{document}
"""


def test_the_files(folder, written):
    assert all(path.parent == folder and path.stat().st_size > 1000 for path in written)
    assert {path.name for path in written} == {"table.md", "table.tex", "pareto.pdf", "pareto.png", "page.html"}
    assert (folder / "pareto.pdf").read_bytes()[:5] == b"%PDF-"
    assert np.asarray(cv2.imread(str(folder / "pareto.png"))).shape == (1200, 1920, 3)


def test_the_tables_of_all_scenes_and_budgets(folder, made_results, tmp_path):
    titles = [table.title for table in all_tables(made_results(tmp_path))]
    assert titles == [
        "room, 4,000 Gaussians, equal steps", "kitchen, 4,000 Gaussians, equal steps",
        "Ranks over scenes, 4,000 Gaussians, equal steps",
        "room, own size, own steps", "kitchen, own size, own steps", "Ranks over scenes, own size, own steps",
    ]  # fmt: skip
    text = (folder / "table.md").read_text()
    assert all(f"### {title}\n" in text for title in titles)
    assert "not equal between the rules: 1,510 to 9,010 Gaussians (a factor of 6.0)" in text
    assert "quadtree is better than uniform by" in text
    assert "corrected for 2 comparisons" in text
    assert "- uniform, kitchen, own size, own steps, seed 2: ValueError: <no> seeds" in text


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


def test_a_difference_that_many_comparisons_make_doubtful_is_called_so(made_run):
    runs = [made_run("best", seed=s, psnr=25 + s * 0.01) for s in range(3)]
    runs += [made_run("near", seed=s, psnr=24.5 + x) for s, x in enumerate((0.0, 0.2, 0.0))]
    runs += [made_run(f"far {i}", seed=s, psnr=20 + i + s * s) for i in range(4) for s in range(3)]
    found = {c.b: comparison_sentence(c, p, 5) for c, p in against_the_best(runs, str(Budget()))}
    assert "more than noise" in found["near"]
    assert "it may be noise after all" in found["near"]
    assert len(found) == 5


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no LaTeX here (Debian: texlive-latex-recommended)")
def test_latex_accepts_the_tables(folder):
    (folder / "paper.tex").write_text(DOCUMENT)
    done = subprocess.run(["pdflatex", "-halt-on-error", "paper"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-1500:]
    assert "Overfull" not in done.stdout
