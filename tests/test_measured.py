"""Every number in a table of the docs comes from a file that a command wrote, and the files fit
their recipes."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import measured
import pytest

ROOT = Path(__file__).resolve().parents[1]
RECIPE = """\
[groups]
code = ["code.py", "room"]
[walls]
about = "Walls"
depends = ["code"]
columns = ["", "PSNR", "ATE, cm"]
rows = [["one", "a"], ["both", "b"]]
cells = ["{@; psnr_db:.1f}", "{@; ate_m*100:.2f}"]
texts = { best = "{b; seed=1; psnr_db:.2f} dB" }
[walls.runs]
a = "gsfusion-nb map wall"
b = ["gsfusion-nb map wall --seed 0", "gsfusion-nb map wall --seed 1"]
"""
VALUES = {
    "a": [{"psnr_db": 20.25, "ate_m": 0.01}],
    "b": [{"psnr_db": 20.0, "ate_m": 0.02, "seed": 0}, {"psnr_db": 22.0, "ate_m": 0.02, "seed": 1}],
}


@pytest.fixture
def project(tmp_path):
    """A repository with one recipe, its numbers of the first commit, and a page with stale
    places."""
    (tmp_path / "docs/measured").mkdir(parents=True)
    (tmp_path / "docs/measured/recipes.toml").write_text(RECIPE)
    (tmp_path / "code.py").write_text("1\n")
    (tmp_path / "README.md").write_text("Best: <!-- text: walls best -->?<!-- end -->.\n")
    (tmp_path / "docs/a.md").write_text(
        "<!-- table: walls --><!-- end -->\n<!-- commands: walls -->\n<!-- end -->\n"
    )
    commit(tmp_path)
    recipe = measured.read_recipes(tmp_path)["walls"]
    numbers = {
        "commands": recipe["commands"],
        **measured.made(recipe, VALUES),
        "date": "2026-01-01",
    }
    numbers |= {
        "commit": measured.git("rev-parse", "HEAD", root=tmp_path).strip(),
        "machine": {"cpu": "a computer"},
    }
    (tmp_path / "docs/measured/walls.json").write_text(json.dumps(numbers))
    return tmp_path


def commit(folder):
    for line in ("init -q", "add -A", "-c user.name=a -c user.email=a@b.c commit -q -m x"):
        subprocess.run(["git", *line.split()], cwd=folder, check=True)


def test_pages_are_filled_from_the_file(project):
    assert [p.name for p in measured.fill(project, write=True)] == ["README.md", "a.md"]
    page = (project / "docs/a.md").read_text()
    assert (
        "| one | 20.2 | 1.00 |\n| both | 21.0 ± 1.4 | 2.00 ± 0.00 |\n\nMeasured on 2026-01-01 with "
        "commit `" in page
    )
    assert "```\ngsfusion-nb map wall\n```\n" in page  # of one seed
    assert (
        "Best: <!-- text: walls best -->22.00 dB<!-- end -->."
        in (project / "README.md").read_text()
    )
    assert measured.fill(project, write=False) == []
    (project / "docs/a.md").write_text(page.replace("20.2", "20.3"))  # by hand
    assert [p.name for p in measured.fill(project, write=False)] == ["a.md"]


def test_a_table_is_old_when_what_it_depends_on_has_changed(project):
    def old():
        return measured.list_old(measured.read_recipes(project), project)

    assert old() == []
    (project / "other.py").write_text("1\n")
    commit(project)
    assert old() == []
    (project / "code.py").write_text("2\n")
    commit(project)
    assert old() == ["walls"]
    (project / "docs/measured/walls.json").unlink()
    assert old() == ["walls"]


@pytest.mark.parametrize(
    ("source", "is_old"),
    [
        ('"""About."""\n\nLIMIT = (  # of what\n    1\n)\n', False),
        ('"""About this."""\nLIMIT = 1\n"""Of what."""\n', False),
        ('"""About."""\nLIMIT = 2\n', True),
        ('"""About."""\nLIMIT = "1"\n', True),
        ('"""About."""\n', True),
        (None, True),
    ],
    ids=["layout", "docstrings", "value", "type", "statement less", "file gone"],
)
def test_of_a_python_file_its_statements_count(project, source, is_old):
    def old():
        measured.is_same_program.cache_clear()  # commits of one second have one name
        return measured.list_old(measured.read_recipes(project), project)

    path = project / "code.py"
    path.write_text('"""About."""\nLIMIT = 1\n')
    commit(project)
    with_commit(project, measured.git("rev-parse", "HEAD", root=project).strip())
    path.unlink()
    if source is not None:
        path.write_text(source)
    commit(project)
    assert old() == (["walls"] if is_old else [])


def test_of_other_files_every_byte_counts(project, capsys):
    (project / "docs/measured/recipes.toml").write_text(
        RECIPE.replace('depends = ["code"]', 'depends = ["code", "rooms/*.toml"]')
    )
    (project / "rooms").mkdir()
    (project / "rooms/a.toml").write_text("# a room\n")
    (project / "rooms/b.toml").write_text("# a room\n")
    commit(project)
    with_commit(project, measured.git("rev-parse", "HEAD", root=project).strip())
    (project / "rooms/a.toml").write_text("# a large room\n")
    (project / "rooms/b.toml").write_text("# a small room\n")
    commit(project)
    assert measured.list_old(measured.read_recipes(project), project) == ["walls"]
    assert "rooms/a.toml changed since 2026-01-01 (2 files in all)" in capsys.readouterr().out


def with_commit(project, commit):
    """The table of the project, as if it had been measured with this commit."""
    path = project / "docs/measured/walls.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"commit": commit}))


def of_another_branch(project):
    """A commit that is in the repository and not in the history of HEAD."""
    here = measured.git("rev-parse", "HEAD", root=project).strip()
    (project / "other.py").write_text("1\n")
    commit(project)
    there = measured.git("rev-parse", "HEAD", root=project).strip()
    subprocess.run(["git", "reset", "-q", "--hard", here], cwd=project, check=True)
    return there


@pytest.mark.parametrize("where", ["nowhere", "on another branch"])
def test_a_commit_that_is_not_in_the_history_makes_a_table_old_and_the_page_says_so(
    project, capsys, where
):
    """Before, git failed for it, and its empty answer was taken for no change since."""
    commit(project)
    there = (
        "a66beb8cb3ce08b6413ca0dbbe0ee3f4c4a3de24"
        if where == "nowhere"
        else of_another_branch(project)
    )
    with_commit(project, there)
    assert measured.list_old(measured.read_recipes(project), project) == ["walls"]
    assert (
        f"its commit is not in this repository: {there[:8]} of 2026-01-01"
        in capsys.readouterr().out
    )
    assert measured.note_commits(project) == ["walls"]
    assert measured.note_commits(project) == []
    measured.fill(project, write=True)
    page = (project / "docs/a.md").read_text()
    assert (
        "**These are not today's numbers.** They were measured on 2026-01-01 with commit "
        f"`{there[:8]}`" in page
    )
    assert 'make measured RENEW="walls"' in page
    with_commit(project, measured.git("rev-parse", "HEAD", root=project).strip())
    assert measured.note_commits(project) == ["walls"]
    measured.fill(project, write=True)
    assert "not today's" not in (project / "docs/a.md").read_text()


def test_without_the_whole_history_nothing_is_said_to_be_current(project, tmp_path_factory):
    recipes = measured.read_recipes(project)
    cut = tmp_path_factory.mktemp("cut") / "clone"
    (project / "other.py").write_text("1\n")
    commit(project)
    subprocess.run(
        ["git", "clone", "-q", "--depth", "1", project.as_uri(), str(cut)],
        check=True,
    )
    with pytest.raises(measured.MeasuredError, match="history of this checkout is cut"):
        measured.list_old(recipes, cut)
    shutil.rmtree(project / ".git")
    with pytest.raises(
        measured.MeasuredError,
        match="is not a git checkout, so which tables are old cannot be known",
    ):
        measured.list_old(recipes, project)


def test_a_failure_of_git_is_no_empty_answer(project):
    with pytest.raises(measured.MeasuredError, match=r"git log nothing\.\.HEAD failed"):
        measured.git("log", "nothing..HEAD", root=project)


def test_folders_of_the_machine_are_left_out(tmp_path):
    found = {
        "data": "/home/me/my data/redkitchen250",
        "files": ["C:\\data\\kitchen", "~/data/desk/"],
        "reason": "ValueError: /home/me/data/desk/rgb.txt is missing",
        "cells": [
            "28.1 / 0.9 / 3",
            "held out, 1 / 6",
            "frames/s",
            "docs/measured/track_only.py",
            "https://a.b/c/d",
        ],
        "psnr_db": 20.5,
    }
    measured.write_numbers(tmp_path / "walls.json", found)
    assert json.loads((tmp_path / "walls.json").read_text()) == found | {
        "data": "redkitchen250",
        "files": ["kitchen", "desk"],
        "reason": "ValueError: rgb.txt is missing",
    }


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
    with pytest.raises(measured.MeasuredError, match=re.escape(names)):
        measured.made(measured.read_recipes(project)["walls"], VALUES)


def test_times_are_measured_and_not_taken_from_an_earlier_command(tmp_path):
    """A study keeps its results: measured again, a table of times had those of the hour before."""
    study, bench = "gsfusion-nb study rtg-rate kitchen --seeds 3", "gsfusion-nb bench raster"

    def call(command, measures_times):
        return measured.call_of(
            command, tmp_path / "out", tmp_path / "bench.json", measures_times=measures_times
        )

    assert call(study, True)[-1] == "--no-cache"
    assert "--no-cache" not in call(study, False)
    assert call(bench, True)[-2:] == ["--json", str(tmp_path / "bench.json")]
    assert call("python docs/measured/x.py", True)[1] == str(measured.ROOT / "docs/measured/x.py")
    with pytest.raises(measured.MeasuredError, match="expected a command"):
        call("rm all", True)


def test_records_of_nested_tables():
    found = measured.leaves({"disc": {"500": {"error": 1.0}}, "blended": {"500": {"error": 2.0}}})
    assert found == [{"label": "disc/500", "error": 1.0}, {"label": "blended/500", "error": 2.0}]


def test_a_label_that_is_a_number_is_found(tmp_path):
    (tmp_path / "runs.csv").write_text(
        "label,seed,metric.psnr_held_out_db\n0,0,23.5\n10,0,25.5\n10,1,26.5\n"
    )
    records = measured.records_of("gsfusion-nb study table-vi room", tmp_path, tmp_path)
    assert (
        measured.cell("{vi; 10; psnr_held_out_db}, {vi; 0; psnr_held_out_db}", {"vi": records})
        == "26.00 ± 0.71, 23.50"
    )


def test_a_table_of_the_lab_has_a_row_for_each_rule_with_means_over_scenes():
    def rule(name, psnr, test):
        scenes = {scene: {"psnr_db": {"mean": p}} for scene, p in zip("ab", psnr, strict=True)}
        return {"rule": name, "rank": 1.0, "scenes": scenes, "test": test}

    rows = [rule("uniform", (20.0, 22.0), None), rule("dense", (21.0, 21.0), {"p": 0.5})]
    records = measured.of_the_lab({"budgets": [{"budget": "8,000", "rows": rows}]})
    cells = ["{@; psnr_db:.1f}", "{@; budget=8,000; scene=a; psnr_db:.1f}", "{@; p?:.2f}"]
    recipe = {"columns": ["rule", "PSNR", "a", "p"], "rows": "lab", "cells": cells}
    assert measured.made(recipe, {"lab": records})["rows"] == [
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
    records = measured.of_the_lab({"budgets": [budget], "rules": rules})
    recipe = {"columns": ["rule", "PSNR"], "rows": "lab", "cells": ["{@; psnr_db:.1f}"]}
    assert [row[0] for row in measured.made(recipe, {"lab": records})["rows"]] == [
        "`tied` †",
        "`plain`",
    ]
    with pytest.raises(measured.MeasuredError, match="scenes of 8,000 share frames"):
        measured.of_the_lab({"budgets": [budget | {"units": [["a", "b"]]}]})


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
    assert measured.cell("{lab; mcmc; less=none; psnr_db:.1f}", values) == "0.0 ± 1.4"
    assert measured.cell("{lab; mcmc; scene=b; less=none; psnr_db:.1f}", values) == "-1.0"


# ---- The pages of this project -------------------------------------------------------------------

RECIPES = measured.read_recipes()


def test_no_number_was_edited_by_hand():
    assert [p.name for p in measured.fill(write=False)] == []


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_depends_on_files_that_exist(name):
    for path in RECIPES[name]["depends"]:
        path = path.removeprefix(":(exclude)")
        assert any(ROOT.glob(path)), f"{name} depends on {path}, which does not exist"


@pytest.mark.parametrize(
    "name",
    sorted(p.stem for p in (ROOT / measured.MEASURED).glob("*.json")),
)
def test_a_file_of_numbers_has_a_recipe_and_whole_rows(name):
    assert name in RECIPES
    numbers = measured.read_numbers(name)
    assert {"commit", "date", "machine", "commands"} <= set(numbers)
    assert measured.without_folders(numbers) == numbers
    assert all(len(row) == len(numbers["columns"]) for row in numbers["rows"])


def test_each_table_that_was_measured_stands_on_a_page():
    text = "".join(page.read_text("utf-8") for page in measured.pages())
    names = [path.stem for path in (ROOT / measured.MEASURED).glob("*.json")]
    assert [name for name in names if f"<!-- table: {name} -->" not in text] == []


def test_each_file_of_numbers_says_whether_its_commit_is_in_the_history():
    try:
        measured.check_history()
    except measured.MeasuredError as error:
        pytest.skip(str(error))
    numbers = {
        path.stem: measured.read_numbers(path.stem)
        for path in (ROOT / measured.MEASURED).glob("*.json")
    }
    wrong = [
        n
        for n, of in numbers.items()
        if measured.is_in_history(of["commit"]) != of.get("commit_here", True)
    ]
    assert wrong == [], "run: python tools/measured.py --fill"


@pytest.mark.parametrize(
    ("quiet", "threads", "words"),
    [
        (True, 1, "`, with one thread."),
        (True, 2, "`, with 2 threads."),
        (False, 2, "`."),
    ],
)
def test_a_table_of_times_says_its_threads(quiet, threads, words):
    numbers = {"commit": "0123456789", "date": "2026-01-01", "machine": {"threads": threads}}
    assert measured.origin("walls", numbers | {"quiet": quiet}).endswith(words)


@pytest.fixture
def same_rooms(monkeypatch):
    """The project's code is what makes its maps; hashes of both sides by commit."""
    hashes = {"now": {"a": "1", "b": "2"}, "then": {"a": "1", "b": "2"}}
    monkeypatch.setattr(measured.same_maps, "ROOMS", ("code.py",))
    monkeypatch.setattr(measured.same_maps, "hashes_of_folder", lambda folder: hashes["now"])
    monkeypatch.setattr(measured.same_maps, "hashes_of_commit", lambda *_: hashes["then"])
    return hashes


def change_code(project, text):
    (project / "code.py").write_text(text)
    commit(project)


def test_a_table_whose_maps_are_the_same_is_not_old(project, same_rooms):
    recipes = measured.read_recipes(project)
    change_code(project, "2\n")
    assert measured.list_old(recipes, project) == ["walls"]
    assert measured.confirm(recipes, project) == {"walls": ""}
    assert measured.list_old(recipes, project) == []
    head = measured.git("rev-parse", "HEAD", root=project).strip()
    measured.fill(project, write=True)
    page = (project / "docs/a.md").read_text()
    assert f"Commit `{head[:8]}` makes the same maps." in page
    change_code(project, "3\n")  # what comes later is compared with the later commit
    assert measured.list_old(recipes, project) == ["walls"]


@pytest.mark.parametrize("now", [{"a": "1", "b": "3"}, {"a": "1"}])
def test_a_table_with_another_map_stays_old(project, same_rooms, now):
    recipes = measured.read_recipes(project)
    change_code(project, "2\n")
    same_rooms["now"] = now
    assert "1 maps are others" in measured.confirm(recipes, project)["walls"]
    assert measured.list_old(recipes, project) == ["walls"]


def test_maps_say_nothing_of_times_and_of_other_code(project, same_rooms, monkeypatch):
    recipes = measured.read_recipes(project)
    change_code(project, "2\n")
    recipes["walls"]["quiet"] = True
    assert measured.confirm(recipes, project)["walls"] == "its times must be measured"
    recipes["walls"]["quiet"] = False
    monkeypatch.setattr(measured.same_maps, "ROOMS", ("room/",))
    assert measured.confirm(recipes, project)["walls"] == "code.py changed, which makes no map"
    recipes["walls"]["columns"] = ["", "PSNR", "error"]
    assert measured.confirm(recipes, project)["walls"] == "the recipe has changed"


def test_uncommitted_code_is_not_confirmed(project, same_rooms):
    change_code(project, "2\n")
    (project / "code.py").write_text("3\n")
    with pytest.raises(measured.MeasuredError, match="commit first"):
        measured.confirm(measured.read_recipes(project), project)
