"""The recipes of the tables, and the files of their numbers."""

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
MEASURED = "docs/measured"
COMMIT_HERE = "commit_here"
"""Key of a file of numbers: whether its commit is in the history of this repository; absent means
that it is."""
SAME_MAPS = "same_maps"
"""Key of a file of numbers: a later commit that makes the same maps, and when that was found."""
KEYS = {
    "about",
    "cells",
    "columns",
    "depends",
    "maps",
    "minutes",
    "quiet",
    "rows",
    "runs",
    "texts",
}
ABSOLUTE_PATH = re.compile(r"(?<![\w.~:/\\])(?:~|[A-Za-z]:)?(?:[/\\][^/\\\s\"']+){2,}[/\\]?")


class MeasuredError(ValueError):
    """A recipe, a file of numbers or a page that cannot be used; the message says what was
    expected."""


def read_recipes(root: Path = ROOT) -> dict[str, dict[str, Any]]:
    """Recipes by name, with the paths of their groups in ``depends`` and a list of command lines
    for each run."""
    recipes = tomllib.loads((root / MEASURED / "recipes.toml").read_text(encoding="utf-8"))
    groups = recipes.pop("groups", {})
    for name, recipe in recipes.items():
        if unknown := set(recipe) - KEYS:
            raise MeasuredError(f"{name}: unknown keys {sorted(unknown)}; there are {sorted(KEYS)}")
        recipe["depends"] = sorted(
            {path for item in recipe["depends"] for path in groups.get(item, [item])}
        )
        recipe["runs"] = {
            run: [lines] if isinstance(lines, str) else lines
            for run, lines in recipe["runs"].items()
        }
        recipe["commands"] = list(
            dict.fromkeys(line for lines in recipe["runs"].values() for line in lines)
        )
    return recipes


def read_numbers(name: str, root: Path = ROOT) -> dict[str, Any]:
    """The numbers of a table, from its file."""
    return json.loads((root / MEASURED / f"{name}.json").read_text(encoding="utf-8"))


def write_numbers(path: Path, numbers: Mapping[str, Any]) -> None:
    """Write a file of numbers. Folders of the machine that measured are left out: of a path its
    last name is kept."""
    text = json.dumps(without_folders(numbers), indent=1, ensure_ascii=False) + "\n"
    path.write_text(text, encoding="utf-8")


def without_folders(value: Any) -> Any:
    """``value`` with the last name of each absolute path in it: of the folder of a recording, the
    recording's name."""
    if isinstance(value, Mapping):
        return {key: without_folders(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [without_folders(inner) for inner in value]
    if not isinstance(value, str):
        return value
    # there may be spaces in it
    if PurePosixPath(value).is_absolute() or PureWindowsPath(value).is_absolute():
        return PureWindowsPath(value).name
    return ABSOLUTE_PATH.sub(lambda match: PureWindowsPath(match[0]).name, value)
