"""The notebook of the short path: cells of the chapters that need nothing else."""

import ast
import builtins
import re
import shutil
import symtable
import tomllib
from pathlib import Path

import pytest

from gsfusion_nb.course.short_path import short_path

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
PLAN = (NOTEBOOKS / "short_path.toml").read_text(encoding="utf-8")


def code(notebook):
    """Id -> source of the code cells."""
    return {c["id"]: "".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"}


def test_every_exercise_comes_once_and_before_its_solution():
    notebook = short_path(NOTEBOOKS)
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(ids) == len(set(ids))
    sources = code(notebook).values()
    exercises = re.findall(r"^check\.(\w+)\(\1\)$", "\n".join(sources), re.MULTILINE)
    assert 4 <= len(set(exercises)) == len(exercises) <= 6
    for name in exercises:
        assert ["BEGIN SOLUTION" in source for source in sources if f"def {name}(" in source] == [
            False,
            True,
        ]


def scopes(table):
    return [table, *(inner for child in table.get_children() for inner in scopes(child))]


def test_a_cell_reads_names_of_its_own_chapter_only():
    """Chapters give the same names to different things."""
    sources = code(short_path(NOTEBOOKS))
    imported = [
        node for node in ast.walk(ast.parse(sources["imports"])) if isinstance(node, ast.alias)
    ]
    bound = {alias.asname or alias.name: "imports" for alias in imported}
    assert len(bound) == len(imported)
    named = [name.split("/") for part in tomllib.loads(PLAN)["part"] for name in part["cells"]]
    for chapter, cell in named:
        tables = scopes(symtable.symtable(sources.get(cell, ""), cell, "exec"))
        binds = {
            s.get_name() for s in tables[0].get_symbols() if s.is_assigned() or s.is_imported()
        }
        reads = {
            s.get_name()
            for t in tables
            for s in t.get_symbols()
            if s.is_referenced() and s.is_global()
        }
        reads |= {s.get_name() for s in tables[0].get_symbols() if s.is_referenced()}
        for name in reads - binds - vars(builtins).keys():
            assert bound.get(name) in (chapter, "imports"), (
                f"{chapter}/{cell} reads {name} of {bound.get(name)}"
            )
        bound |= dict.fromkeys(binds, chapter)


def test_a_cell_that_is_gone_is_told(tmp_path):
    shutil.copy(NOTEBOOKS / "00_quickstart.ipynb", tmp_path)
    (tmp_path / "short_path.toml").write_text(
        '[[part]]\ntext = "## Title"\ncells = ["00/q02", "00/gone", "02/q02"]'
    )
    with pytest.raises(
        ValueError, match=r"short_path\.toml names cells that no chapter has: 00/gone, 02/q02"
    ):
        short_path(tmp_path)


def test_the_first_screen_has_the_picture_that_moves(tmp_path):
    """It is attached to a cell of chapter 0, which is not in this notebook."""
    first = short_path(NOTEBOOKS)["cells"][0]
    (name,) = first["attachments"]
    assert f"(attachment:{name})" in "".join(first["source"])
    assert "|" not in "".join(first["source"])
    shutil.copytree(NOTEBOOKS, tmp_path / "copy")
    plan = tmp_path / "copy/short_path.toml"
    plan.write_text(PLAN.replace('attachments = "00/q00"', 'attachments = "00/gone"'))
    with pytest.raises(ValueError, match="names cells that no chapter has: 00/gone"):
        short_path(tmp_path / "copy")


def test_no_constant_that_nothing_here_uses():
    """Chapter 3's SWEEP is for its section 7, which is not in this notebook."""
    notebook = short_path(NOTEBOOKS)
    constants = [
        "".join(cell["source"])
        for cell in notebook["cells"]
        if "parameters" in cell["metadata"].get("tags", ())
    ]
    assert len(constants) >= 4
    assert not re.search(r"SWEEP|SMALL_STEPS|section \d", "\n".join(constants))
    assert "VOXEL_M = 0.02  # edge of a voxel, metres" in "\n".join(constants)
