"""A repository with one table, and maps of given hashes."""

import json

import pytest
import same_maps
from measuring.cells import made
from measuring.history import git
from measuring.recipes import read_recipes
from table_project import RECIPE, VALUES, commit


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
    recipe = read_recipes(tmp_path)["walls"]
    numbers = {
        "commands": recipe["commands"],
        **made(recipe, VALUES),
        "date": "2026-01-01",
    }
    numbers |= {
        "commit": git("rev-parse", "HEAD", root=tmp_path).strip(),
        "machine": {"cpu": "a computer"},
    }
    (tmp_path / "docs/measured/walls.json").write_text(json.dumps(numbers))
    return tmp_path


@pytest.fixture
def same_rooms(monkeypatch):
    """The project's code is what makes its maps; hashes of both sides by commit."""
    hashes = {"now": {"a": "1", "b": "2"}, "then": {"a": "1", "b": "2"}}
    monkeypatch.setattr(same_maps, "ROOMS", ("code.py",))
    monkeypatch.setattr(same_maps, "hashes_of_folder", lambda folder: hashes["now"])
    monkeypatch.setattr(same_maps, "hashes_of_commit", lambda *_: hashes["then"])
    return hashes
