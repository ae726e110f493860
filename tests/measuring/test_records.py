"""A table is made from the records that commands wrote."""

import re

import pytest
from measuring.cells import cell, made
from measuring.recipes import ROOT, MeasuredError, read_recipes
from measuring.records import call_of, leaves, of_the_lab, records_of
from table_project import RECIPE, VALUES


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("about =", "abuot =", "abuot"),
        ("{@; psnr_db:.1f}", "{@; psnr:.1f}", "psnr_db"),
        ("{@; psnr_db:.1f}", "{c; psnr_db:.1f}", "'c'"),
        ("seed=1", "seed=5", "seed=5"),
        ('["one", "a"]', '["one", "a", "b", "c"]', "one"),
    ],
)
def test_a_wrong_recipe_is_named(project, old, new, names):
    (project / "docs/measured/recipes.toml").write_text(RECIPE.replace(old, new))
    with pytest.raises(MeasuredError, match=re.escape(names)):
        made(read_recipes(project)["walls"], VALUES)


def test_times_are_measured_and_not_taken_from_an_earlier_command(tmp_path):
    """A study keeps its results: measured again, a table of times had those of the hour before."""
    study, bench = "gsfusion-nb study rtg-rate kitchen --seeds 3", "gsfusion-nb bench raster"

    def call(command, measures_times):
        return call_of(
            command, tmp_path / "out", tmp_path / "bench.json", measures_times=measures_times
        )

    assert call(study, True)[-1] == "--no-cache"
    assert "--no-cache" not in call(study, False)
    assert call(bench, True)[-2:] == ["--json", str(tmp_path / "bench.json")]
    assert call("python docs/measured/x.py", True)[1] == str(ROOT / "docs/measured/x.py")
    with pytest.raises(MeasuredError, match="expected a command"):
        call("rm all", True)


def test_records_of_nested_tables():
    found = leaves({"disc": {"500": {"error": 1.0}}, "blended": {"500": {"error": 2.0}}})
    assert found == [{"label": "disc/500", "error": 1.0}, {"label": "blended/500", "error": 2.0}]


def test_a_label_that_is_a_number_is_found(tmp_path):
    (tmp_path / "runs.csv").write_text(
        "label,seed,metric.psnr_held_out_db\n0,0,23.5\n10,0,25.5\n10,1,26.5\n"
    )
    records = records_of("gsfusion-nb study table-vi room", tmp_path, tmp_path)
    assert (
        cell("{vi; 10; psnr_held_out_db}, {vi; 0; psnr_held_out_db}", {"vi": records})
        == "26.00 ± 0.71, 23.50"
    )


def test_a_table_of_the_lab_has_a_row_for_each_rule_with_means_over_scenes():
    def rule(name, psnr, test):
        scenes = {scene: {"psnr_db": {"mean": p}} for scene, p in zip("ab", psnr, strict=True)}
        return {"rule": name, "rank": 1.0, "scenes": scenes, "test": test}

    rows = [rule("uniform", (20.0, 22.0), None), rule("dense", (21.0, 21.0), {"p": 0.5})]
    records = of_the_lab({"budgets": [{"budget": "8,000", "rows": rows}]})
    cells = ["{@; psnr_db:.1f}", "{@; budget=8,000; scene=a; psnr_db:.1f}", "{@; p?:.2f}"]
    recipe = {"columns": ["rule", "PSNR", "a", "p"], "rows": "lab", "cells": cells}
    assert made(recipe, {"lab": records})["rows"] == [
        ["`uniform`", "21.0 ± 1.4", "20.0", ""],
        ["`dense`", "21.0 ± 0.0", "21.0", "0.50"],
    ]


def test_a_table_of_the_lab_keeps_its_marks_and_has_independent_scenes():
    row = {"rule": "tied", "rank": 1.0, "test": None, "scenes": {"a": {"psnr_db": {"mean": 20.0}}}}
    budget = {
        "budget": "8,000",
        "rows": [row, row | {"rule": "plain"}],
        "scenes": ["a", "b"],
        "units": [["a"], ["b"]],
    }
    rules = {"tied": {"published_training": "centres fixed"}, "plain": {"published_training": ""}}
    records = of_the_lab({"budgets": [budget], "rules": rules})
    recipe = {"columns": ["rule", "PSNR"], "rows": "lab", "cells": ["{@; psnr_db:.1f}"]}
    assert [row[0] for row in made(recipe, {"lab": records})["rows"]] == [
        "`tied` †",
        "`plain`",
    ]
    with pytest.raises(MeasuredError, match="scenes of 8,000 share frames"):
        of_the_lab({"budgets": [budget | {"units": [["a", "b"]]}]})


def test_a_difference_is_taken_scene_by_scene():
    def of(name, psnr):
        return [
            {"label": name, "scene": scene, "psnr_db": p}
            for scene, p in zip("abc", psnr, strict=False)
        ]

    values = {
        "lab": [
            {"label": "mcmc", "rank": 1.0},
            *of("mcmc", (22.0, 24.0)),
            *of("none", (21.0, 25.0, 30.0)),
        ]
    }
    assert cell("{lab; mcmc; less=none; psnr_db:.1f}", values) == "0.0 ± 1.4"
    assert cell("{lab; mcmc; scene=b; less=none; psnr_db:.1f}", values) == "-1.0"
