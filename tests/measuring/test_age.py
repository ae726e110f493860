"""Which tables are older than what they depend on."""

import shutil
import subprocess

import pytest
import same_maps
from measuring.age import confirm, list_old, note_commits
from measuring.history import git, is_same_program
from measuring.pages import fill
from measuring.recipes import MeasuredError, read_recipes
from table_project import RECIPE, change_code, commit, of_another_branch, with_commit


def test_a_table_is_old_when_what_it_depends_on_has_changed(project):
    def old():
        return list_old(read_recipes(project), project)

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
        is_same_program.cache_clear()  # commits of one second have one name
        return list_old(read_recipes(project), project)

    path = project / "code.py"
    path.write_text('"""About."""\nLIMIT = 1\n')
    commit(project)
    with_commit(project, git("rev-parse", "HEAD", root=project).strip())
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
    with_commit(project, git("rev-parse", "HEAD", root=project).strip())
    (project / "rooms/a.toml").write_text("# a large room\n")
    (project / "rooms/b.toml").write_text("# a small room\n")
    commit(project)
    assert list_old(read_recipes(project), project) == ["walls"]
    assert "rooms/a.toml changed since 2026-01-01 (2 files in all)" in capsys.readouterr().out


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
    assert list_old(read_recipes(project), project) == ["walls"]
    assert (
        f"its commit is not in this repository: {there[:8]} of 2026-01-01"
        in capsys.readouterr().out
    )
    assert note_commits(project) == ["walls"]
    assert note_commits(project) == []
    fill(project, write=True)
    page = (project / "docs/a.md").read_text()
    assert (
        "**These are not today's numbers.** They were measured on 2026-01-01 with commit "
        f"`{there[:8]}`" in page
    )
    assert 'make measured RENEW="walls"' in page
    with_commit(project, git("rev-parse", "HEAD", root=project).strip())
    assert note_commits(project) == ["walls"]
    fill(project, write=True)
    assert "not today's" not in (project / "docs/a.md").read_text()


def test_without_the_whole_history_nothing_is_said_to_be_current(project, tmp_path_factory):
    recipes = read_recipes(project)
    cut = tmp_path_factory.mktemp("cut") / "clone"
    (project / "other.py").write_text("1\n")
    commit(project)
    subprocess.run(
        ["git", "clone", "-q", "--depth", "1", project.as_uri(), str(cut)],
        check=True,
    )
    with pytest.raises(MeasuredError, match="history of this checkout is cut"):
        list_old(recipes, cut)
    shutil.rmtree(project / ".git")
    with pytest.raises(
        MeasuredError,
        match="is not a git checkout, so which tables are old cannot be known",
    ):
        list_old(recipes, project)


def test_a_failure_of_git_is_no_empty_answer(project):
    with pytest.raises(MeasuredError, match=r"git log nothing\.\.HEAD failed"):
        git("log", "nothing..HEAD", root=project)


def test_a_table_whose_maps_are_the_same_is_not_old(project, same_rooms):
    recipes = read_recipes(project)
    change_code(project, "2\n")
    assert list_old(recipes, project) == ["walls"]
    assert confirm(recipes, project) == {"walls": ""}
    assert list_old(recipes, project) == []
    head = git("rev-parse", "HEAD", root=project).strip()
    fill(project, write=True)
    page = (project / "docs/a.md").read_text()
    assert f"Commit `{head[:8]}` makes the same maps." in page
    change_code(project, "3\n")  # what comes later is compared with the later commit
    assert list_old(recipes, project) == ["walls"]


@pytest.mark.parametrize("now", [{"a": "1", "b": "3"}, {"a": "1"}])
def test_a_table_with_another_map_stays_old(project, same_rooms, now):
    recipes = read_recipes(project)
    change_code(project, "2\n")
    same_rooms["now"] = now
    assert "1 maps are others" in confirm(recipes, project)["walls"]
    assert list_old(recipes, project) == ["walls"]


def test_numbers_of_some_maps_need_only_these_to_be_the_same(project, same_rooms):
    recipes = read_recipes(project)
    change_code(project, "2\n")
    same_rooms["now"] = {"a": "1", "b": "3"}
    recipes["walls"]["maps"] = ["b"]
    assert "1 maps are others" in confirm(recipes, project)["walls"]
    recipes["walls"]["maps"] = ["a", "c"]
    with pytest.raises(MeasuredError, match="walls: no map begins with 'c'"):
        confirm(recipes, project)
    recipes["walls"]["maps"] = ["a"]
    assert confirm(recipes, project) == {"walls": ""}
    assert list_old(recipes, project) == []


def test_maps_say_nothing_of_times_and_of_other_code(project, same_rooms, monkeypatch):
    recipes = read_recipes(project)
    change_code(project, "2\n")
    recipes["walls"]["quiet"] = True
    assert confirm(recipes, project)["walls"] == "its times must be measured"
    recipes["walls"]["quiet"] = False
    monkeypatch.setattr(same_maps, "ROOMS", ("room/",))
    assert confirm(recipes, project)["walls"] == "code.py changed, which makes no map"
    recipes["walls"]["columns"] = ["", "PSNR", "error"]
    assert confirm(recipes, project)["walls"] == "the recipe has changed"


def test_uncommitted_code_is_not_confirmed(project, same_rooms):
    change_code(project, "2\n")
    (project / "code.py").write_text("3\n")
    with pytest.raises(MeasuredError, match="commit first"):
        confirm(read_recipes(project), project)
