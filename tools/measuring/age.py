"""Which tables are older than what they depend on, and which of them have today's maps all the
same."""

import datetime
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import same_maps

from .history import changed_files, check_history, git, is_in_history
from .recipes import (
    COMMIT_HERE,
    MEASURED,
    ROOT,
    SAME_MAPS,
    MeasuredError,
    read_numbers,
    write_numbers,
)


def reason_of_age(
    name: str,
    recipe: Mapping[str, Any],
    root: Path = ROOT,
) -> str:
    """Why a table is older than what it depends on; empty if it is not."""
    if reason := reason_to_start_anew(name, recipe, root):
        return reason
    numbers = read_numbers(name, root)
    changed = changed_files(last_commit(numbers, root), tuple(recipe["depends"]), root)
    if not changed:
        return ""
    more = f" ({len(changed)} files in all)" if len(changed) > 1 else ""
    return f"{changed[0]} changed since {numbers['date']}{more}"


def reason_to_start_anew(name: str, recipe: Mapping[str, Any], root: Path = ROOT) -> str:
    """Why there are no numbers of this recipe that today's code could be compared with; empty if
    there are."""
    if not (root / MEASURED / f"{name}.json").is_file():
        return "never measured"
    numbers = read_numbers(name, root)
    if not is_in_history(numbers["commit"], root):
        return f"its commit is not in this repository: {numbers['commit'][:8]} of {numbers['date']}"
    if any(numbers[key] != recipe[key] for key in ("commands", "columns")):
        return "the recipe has changed"
    return ""


def last_commit(numbers: Mapping[str, Any], root: Path = ROOT) -> str:
    """The commit with which a table was measured, or the last one that makes the same maps."""
    later = numbers.get(SAME_MAPS, {}).get("commit", "")
    return later if later and is_in_history(later, root) else numbers["commit"]


def note_commits(root: Path = ROOT) -> list[str]:
    """Write into each file of numbers whether its commit is in the history; returns the names of
    those that changed."""
    check_history(root)
    pages = []
    for path in sorted((root / MEASURED).glob("*.json")):
        numbers = json.loads(path.read_text(encoding="utf-8"))
        is_here = is_in_history(numbers["commit"], root)
        if numbers.get(COMMIT_HERE, True) != is_here:
            pages.append(path.stem)
            numbers.pop(COMMIT_HERE, None)
            write_numbers(path, numbers if is_here else numbers | {COMMIT_HERE: False})
    return pages


def list_old(
    recipes: Mapping[str, dict[str, Any]],
    root: Path = ROOT,
) -> list[str]:
    """Print the tables whose recipe, or files that it depends on, have changed since; returns their
    names.

    Raises:
        MeasuredError: this cannot be known here.
    """
    check_history(root)
    old = []
    for name, recipe in recipes.items():
        why = reason_of_age(name, recipe, root)
        if why:
            old.append(name)
            quiet = ", without other load" if recipe.get("quiet") else ""
            print(f"{name}: {recipe['about']}: {why}")
            print(
                f'  make measured RENEW="{name}"    # about {recipe.get("minutes", "?")} minutes '
                f"of one core{quiet}"
            )
    print(f"{len(old)} tables are older than what they depend on.")
    return old


def confirm(recipes: Mapping[str, dict[str, Any]], root: Path = ROOT) -> dict[str, str]:
    """Compare today's maps with those of the commits of old tables, bit for bit. Where they are the
    same, the table is as good as measured today, and its file says so.

    A table of times, one whose recipe has changed, and one that depends on a changed file outside
    of ``same_maps.ROOMS`` must be measured again.

    A recipe whose numbers are of some of the maps alone, as those of one system, names them by how
    they begin (``maps``); then only these must be the same.

    Returns:
        Name of each old table -> why it is not confirmed; empty if it is.

    Raises:
        MeasuredError: this cannot be known here, or what the maps depend on is not committed.
    """
    check_history(root)
    if dirty_files := git("status", "--porcelain", "--", *same_maps.ROOMS, root=root).strip():
        raise MeasuredError(f"commit first what the maps depend on:\n{dirty_files}")
    reasons: dict[str, str] = {}
    by_commit: dict[str, list[str]] = {}
    for name, recipe in recipes.items():
        if reason_of_age(name, recipe, root):
            reasons[name] = reason_to_measure(name, recipe, root)
            if not reasons[name]:
                by_commit.setdefault(last_commit(read_numbers(name, root), root), []).append(name)
    if not by_commit:
        return reasons
    now = same_maps.hashes_of_folder(root)
    for names in by_commit.values():
        for name in names:
            check_maps(name, recipes[name], now)
    head = git("rev-parse", "HEAD", root=root).strip()
    for commit, names in by_commit.items():
        different = same_maps.differences(same_maps.hashes_of_commit(commit, root), now)
        for name in names:
            if others := maps_of(recipes[name], different):
                reasons[name] = f"{len(others)} maps are others since {commit[:8]}: {others[0]}"
                continue
            numbers = read_numbers(name, root)
            numbers[SAME_MAPS] = {"commit": head, "date": datetime.date.today().isoformat()}
            write_numbers(root / MEASURED / f"{name}.json", numbers)
    return reasons


def maps_of(recipe: Mapping[str, Any], maps: Iterable[str]) -> list[str]:
    """Those of the maps that the numbers of a recipe are of: all, or those that begin as its
    ``maps`` say."""
    return [name for name in maps if name.startswith(tuple(recipe.get("maps", [""])))]


def check_maps(name: str, recipe: Mapping[str, Any], maps: Iterable[str]) -> None:
    """Raise ``MeasuredError`` if the ``maps`` of a recipe name none of the maps."""
    known = list(maps)
    for beginning in recipe.get("maps", [""]):
        if not any(map_name.startswith(beginning) for map_name in known):
            raise MeasuredError(f"{name}: no map begins with {beginning!r}; there are {known}")


def reason_to_measure(name: str, recipe: Mapping[str, Any], root: Path = ROOT) -> str:
    """Why equal maps would not make an old table current; empty if they would."""
    if recipe.get("quiet"):
        return "its times must be measured"
    if reason := reason_to_start_anew(name, recipe, root):
        return reason
    numbers = read_numbers(name, root)
    changed = changed_files(last_commit(numbers, root), tuple(recipe["depends"]), root)
    elsewhere = [path for path in changed if not path.startswith(same_maps.ROOMS)]
    return f"{elsewhere[0]} changed, which makes no map" if elsewhere else ""
