"""Every number in a table of the docs comes from a file that a command wrote, and the files fit
their recipes."""

import pytest
from measuring.history import check_history, is_in_history
from measuring.pages import fill, pages
from measuring.recipes import (
    MEASURED,
    ROOT,
    MeasuredError,
    read_numbers,
    read_recipes,
    without_folders,
)

RECIPES = read_recipes()


def test_no_number_was_edited_by_hand():
    assert [p.name for p in fill(write=False)] == []


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_depends_on_files_that_exist(name):
    for path in RECIPES[name]["depends"]:
        path = path.removeprefix(":(exclude)")
        assert any(ROOT.glob(path)), f"{name} depends on {path}, which does not exist"


@pytest.mark.parametrize(
    "name",
    sorted(p.stem for p in (ROOT / MEASURED).glob("*.json")),
)
def test_a_file_of_numbers_has_a_recipe_and_whole_rows(name):
    assert name in RECIPES
    numbers = read_numbers(name)
    assert {"commit", "date", "machine", "commands"} <= set(numbers)
    assert without_folders(numbers) == numbers
    assert all(len(row) == len(numbers["columns"]) for row in numbers["rows"])


def test_each_table_that_was_measured_stands_on_a_page():
    text = "".join(page.read_text("utf-8") for page in pages())
    names = [path.stem for path in (ROOT / MEASURED).glob("*.json")]
    assert [name for name in names if f"<!-- table: {name} -->" not in text] == []


def test_each_file_of_numbers_says_whether_its_commit_is_in_the_history():
    try:
        check_history()
    except MeasuredError as error:
        pytest.skip(str(error))
    numbers = {path.stem: read_numbers(path.stem) for path in (ROOT / MEASURED).glob("*.json")}
    wrong = [
        n for n, of in numbers.items() if is_in_history(of["commit"]) != of.get("commit_here", True)
    ]
    assert wrong == [], "run: python tools/measured.py --fill"
