"""Numbers in the docs: measured by commands, kept in ``docs/measured/*.json``, filled into the
pages from there.

    python tools/measured.py                 # list the tables that are out of date; needs git
    python tools/measured.py --renew NAME    # run a table's commands, fill the pages
    python tools/measured.py --confirm       # are today's maps those of the tables, bit for bit?
    python tools/measured.py --fill          # fill the pages from the JSON files

A table is out of date where something that it depends on has changed since it was measured.

``docs/measured/index.md`` explains the recipes and the markers in the pages.
"""

import argparse
import ast
import csv
import datetime
import json
import os
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import same_maps

ROOT = Path(__file__).resolve().parents[1]
MEASURED = "docs/measured"
COMMIT_HERE = "commit_here"
"""Key of a file of numbers: whether its commit is in the history of this repository; absent means
that it is."""
SAME_MAPS = "same_maps"
"""Key of a file of numbers: a later commit that makes the same maps, and when that was found."""
KEYS = {"about", "depends", "columns", "rows", "runs", "cells", "texts", "minutes", "quiet"}
MARKER = re.compile(
    r"(?<!`)<!-- (table|commands|text): ([\w-]+)(?: ([\w-]+))? -->(.*?)<!-- end -->", re.DOTALL
)
TRAINED_OTHERWISE = "†"
"""Mark of a rule whose publication trains the Gaussians otherwise, as in the tables of the lab."""
ABSOLUTE_PATH = re.compile(r"(?<![\w.~:/\\])(?:~|[A-Za-z]:)?(?:[/\\][^/\\\s\"']+){2,}[/\\]?")
NUMBER = re.compile(r"-?\d+(\.\d*)?(e[-+]?\d+)?")
Record = dict[str, Any]


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


# ---- Filling the pages ---------------------------------------------------------------------------


def filled(
    page: str,
    numbers: Callable[[str], Mapping[str, Any]],
) -> str:
    """The text of a page with every marked place made again; ``numbers`` gives the numbers of a
    name."""

    def place(match: re.Match[str]) -> str:
        kind, name, key, _ = match.groups()
        values = numbers(name)
        if kind == "text":
            return f"<!-- text: {name} {key} -->{values['texts'][key]}<!-- end -->"
        lines = ["```", *of_one_seed(values["commands"]), "```"]
        if kind == "table":
            rows = [
                values["columns"],
                ["---"] + ["---:"] * (len(values["columns"]) - 1),
                *values["rows"],
            ]
            lines = [re.sub(" +", " ", f"| {' | '.join(row)} |") for row in rows]
            lines += ["", origin(name, values)]
        return "\n".join([f"<!-- {kind}: {name} -->", *lines, "<!-- end -->"])

    return MARKER.sub(place, page)


def origin(name: str, numbers: Mapping[str, Any]) -> str:
    """The sentence under a table: when it was measured, and with which commit."""
    commit = numbers["commit"][:8]
    if numbers.get(COMMIT_HERE, True):
        text = f"Measured on {numbers['date']} with commit `{commit}`{with_threads(numbers)}."
        later = numbers.get(SAME_MAPS)
        return f"{text} Commit `{later['commit'][:8]}` makes the same maps." if later else text
    return (
        f"**These are not today's numbers.** They were measured on {numbers['date']} with commit "
        f"`{commit}`, which is "
        f'not in this repository. Measure again with `make measured RENEW="{name}"`.'
    )


def with_threads(numbers: Mapping[str, Any]) -> str:
    """Of a table with times: with how many threads; otherwise nothing."""
    if not numbers.get("quiet"):
        return ""
    threads = numbers["machine"]["threads"]
    return f", with {threads} threads" if threads > 1 else ", with one thread"


def of_one_seed(commands: Iterable[str]) -> list[str]:
    """Commands without those that differ from an earlier one by their seed alone."""
    first: dict[str, str] = {}
    for line in commands:
        first.setdefault(re.sub(r" --seed \d+", "", line), line)
    return list(first.values())


def pages(root: Path = ROOT) -> list[Path]:
    """README and all pages of the docs."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def fill(root: Path = ROOT, *, write: bool) -> list[Path]:
    """Fill all pages from the files of numbers; returns those that differed."""
    stale = []
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        new = filled(text, lambda name: read_numbers(name, root))
        if new != text:
            stale.append(page)
            if write:
                page.write_text(new, encoding="utf-8")
    return stale


# ---- Which are old -------------------------------------------------------------------------------


def git(*arguments: str, root: Path = ROOT) -> str:
    """The output of git.

    Raises:
        MeasuredError: git is not there, or failed; an empty answer is never taken for a failure,
            nor the other way.
    """
    try:
        process = subprocess.run(
            ["git", *arguments],
            cwd=root,
            capture_output=True,
            text=True,
        )
    except FileNotFoundError:
        raise MeasuredError(
            "git is not installed, so the age of the tables cannot be known"
        ) from None
    if process.returncode != 0:
        raise MeasuredError(f"git {' '.join(arguments)} failed in {root}: {process.stderr.strip()}")
    return process.stdout


def check_history(root: Path = ROOT) -> None:
    """Check that the whole history is here, by which commits are told from unknown ones.

    Raises:
        MeasuredError: no git checkout, or one whose history was cut.
    """
    process = subprocess.run(
        ["git", "rev-parse", "--show-toplevel"], cwd=root, capture_output=True, text=True
    )
    if process.returncode != 0 or Path(process.stdout.strip()).resolve() != root.resolve():
        raise MeasuredError(
            f"{root} is not a git checkout, so which tables are old cannot be known here"
        )
    if git("rev-parse", "--is-shallow-repository", root=root).strip() == "true":
        raise MeasuredError(
            "the history of this checkout is cut, so the age of the tables cannot be known: run "
            "git fetch --unshallow"
        )


def is_in_history(commit: str, root: Path = ROOT) -> bool:
    """Whether a commit is HEAD or an ancestor of it. One of another branch, or that is gone, is
    not."""
    call = ["git", "merge-base", "--is-ancestor", commit, "HEAD"]
    return subprocess.run(call, cwd=root, capture_output=True).returncode == 0


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


def changed_files(
    commit: str,
    paths: tuple[str, ...],
    root: Path = ROOT,
) -> list[str]:
    """Files below ``paths`` that are not today what they were at ``commit``. Of a Python file its
    statements count, and neither its layout nor its comments and docstrings."""
    different = git(
        "diff", "--name-only", "--no-renames", f"{commit}..HEAD", "--", *paths, root=root
    ).splitlines()
    return [path for path in different if not is_same_program(commit, path, root)]


@cache
def is_same_program(
    commit: str,
    path: str,
    root: Path = ROOT,
) -> bool:
    """Whether a Python file has the same statements at ``commit`` and today."""
    if not path.endswith(".py"):
        return False
    try:
        then, now = (git("show", f"{side}:{path}", root=root) for side in (commit, "HEAD"))
    except MeasuredError:  # on one side there is no such file
        return False
    return statements(then) == statements(now)


def statements(source: str) -> str:
    """The statements of a Python file as text, without layout, comments and docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [part for part in node.body if not _is_text(part)]
    return ast.dump(tree)


def _is_text(statement: ast.AST) -> bool:
    """Whether a statement is a text that stands by itself, as docstrings do."""
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


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


# ---- Confirming ----------------------------------------------------------------------------------


def confirm(recipes: Mapping[str, dict[str, Any]], root: Path = ROOT) -> dict[str, str]:
    """Compare today's maps with those of the commits of old tables, bit for bit. Where they are the
    same, the table is as good as measured today, and its file says so.

    A table of times, one whose recipe has changed, and one that depends on a changed file outside
    of ``same_maps.ROOMS`` must be measured again.

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
    head = git("rev-parse", "HEAD", root=root).strip()
    for commit, names in by_commit.items():
        others = same_maps.differences(same_maps.hashes_of_commit(commit, root), now)
        for name in names:
            if others:
                reasons[name] = f"{len(others)} maps are others since {commit[:8]}: {others[0]}"
                continue
            numbers = read_numbers(name, root)
            numbers[SAME_MAPS] = {"commit": head, "date": datetime.date.today().isoformat()}
            write_numbers(root / MEASURED / f"{name}.json", numbers)
    return reasons


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


# ---- Measuring -----------------------------------------------------------------------------------


COMPARISONS = ("lab", "study", "sweep", "benchmark")
"""Commands that keep their results for later commands."""


def call_of(
    command: str,
    target: Path,
    bench: Path,
    *,
    measures_times: bool = False,
) -> list[str]:
    """A command line of a recipe as a list for ``subprocess``.

    Args:
        command: Begins with gsfusion-nb or python.
        target: Folder for its results.
        bench: File for the results of ``bench``.
        measures_times: No result of an earlier command is used: its times are those of another
            hour.
    """
    program, what, *rest = shlex.split(command)
    if program not in ("gsfusion-nb", "python"):
        raise MeasuredError(f"expected a command of gsfusion-nb or python, got {command!r}")
    call = [sys.executable, what, *rest]
    if program == "gsfusion-nb":
        call.insert(1, "-m")
        call.insert(2, "gsfusion_nb")
        call += ["--json", str(bench)] if what == "bench" else ["--out", str(target)]
        call += ["--no-cache"] if measures_times and what in COMPARISONS else []
    return [str(ROOT / part) if part.startswith("docs/") else part for part in call]


def records_of(
    command: str,
    recordings: Path,
    target_file: Path | None = None,
    *,
    measures_times: bool = False,
) -> list[Record]:
    """Run one command line in the folder of the recordings; what it wrote, as flat records.

    With ``target_file``, the folder of an earlier call of the same command, nothing runs.
    """
    program, what, *_ = shlex.split(command)
    with tempfile.TemporaryDirectory() as folder:
        target = target_file or Path(folder) / "out"
        bench = Path(folder) / "bench.json"
        call = call_of(command, target, bench, measures_times=measures_times)
        if target_file is None:
            process = subprocess.run(call, cwd=recordings, stdout=subprocess.PIPE, text=True)
            # a run failed: its cell is empty, or the page says so
            may_fail = what == "lab" and process.returncode == 1
            if process.returncode != 0 and not may_fail:
                raise MeasuredError(
                    f"ended with status {process.returncode} in {recordings}: {command}"
                )
            if program == "python":
                return leaves(json.loads(process.stdout.strip().splitlines()[-1]))
        if what in ("sweep", "study", "benchmark") and (target / "runs.csv").is_file():
            rows = csv.DictReader((target / "runs.csv").read_text(encoding="utf-8").splitlines())
            return [
                {k.removeprefix("metric."): _value_of(k, t) for k, t in r.items()} for r in rows
            ]
        if what == "bench":
            rows = json.loads(bench.read_text(encoding="utf-8"))["rows"]
            return [row | row.pop("values") | (row.pop("timing") or {}) for row in rows]
        if what == "demo":
            return leaves(
                {
                    p.parent.name: json.loads(p.read_text())["metrics"]
                    for p in target.glob("*/metrics.json")
                }
            )
        path = target / ("metrics.json" if what == "map" else "table.json")
        records = json.loads(path.read_text(encoding="utf-8"))
        if what == "map":
            return [of_the_map(records)]
        return of_the_lab(records) if what == "lab" else leaves(records)


def _value_of(column: str, text: str) -> float | str:
    """A cell of runs.csv; a label stays text, also "10"."""
    return float(text) if column != "label" and NUMBER.fullmatch(text) else text


def leaves(table: Any, label: str = "") -> list[Record]:
    """The records in nested dictionaries and lists; ``label`` is made of the keys above, with /
    between."""
    if isinstance(table, list):
        return [record for row in table for record in leaves(row, label)]
    if table and all(isinstance(value, dict) for value in table.values()):
        return [
            r
            for key, value in table.items()
            for r in leaves(value, f"{label}/{key}" if label else key)
        ]
    return [{"label": label} | table]


def of_the_map(document: Mapping[str, Any]) -> Record:
    """The record of a run: its metrics, and the processor time of each stage, in seconds, under the
    stage's name with ``processor_seconds_`` before it."""
    stages = document["processor_seconds"]
    seconds = {f"processor_seconds_{stage}": took for stage, took in stages.items()}
    return {"label": ""} | document["metrics"] | seconds


def of_the_lab(table: Mapping[str, Any]) -> list[Record]:
    """A record of each rule and budget with its rank and test, and one for each of its scenes with
    the means there."""
    records = []
    of_rule = table.get("rules", {})
    for budget in table["budgets"]:
        if "units" in budget and len(budget["units"]) < len(budget["scenes"]):
            raise MeasuredError(
                f"scenes of {budget['budget']} share frames, so they are no independent numbers"
            )
        for row in budget["rows"]:
            is_other = bool(of_rule.get(row["rule"], {}).get("published_training"))
            key = {"label": row["rule"], "budget": budget["budget"]} | (
                {"mark": TRAINED_OTHERWISE} if is_other else {}
            )
            records.append(key | {"rank": row["rank"]} | (row["test"] or {}))
            for scene, metrics in row["scenes"].items():
                records.append(
                    key | {"scene": scene} | {name: of["mean"] for name, of in metrics.items()}
                )
    return records


def cell(template: str, values: Mapping[str, list[Record]]) -> str:
    """A cell with its places filled: ``{run; field}`` or
    ``{run; label; key=value; field*100:.2f}``.

    ``{run; label; less=other; field}`` is the difference to the records of another label, each with
    that of its scene.
    """
    return re.sub(r"\{([^{}]+)\}", lambda match: _place(match[1], values), template)


def _place(place: str, values: Mapping[str, list[Record]]) -> str:
    from gsfusion_nb.evaluation.metrics import METRICS

    run, *filters, field = (part.strip() for part in place.split(";"))
    if run not in values:
        raise MeasuredError(f"{{{place}}}: no run {run!r}; there are {list(values)}")
    field, _, spec = field.partition(":")
    field, _, scale = field.partition("*")
    may_miss = field.endswith("?")
    field = field.removesuffix("?")
    conditions = dict(f.split("=", 1) if "=" in f else ("label", f) for f in filters)
    other = conditions.pop("less", None)
    numbers = by_scene(values[run], conditions, field)
    if other is not None:
        less = dict(by_scene(values[run], conditions | {"label": other}, field))
        numbers = [(scene, number - less[scene]) for scene, number in numbers if scene in less]
    numbers = [number for _, number in numbers]
    if may_miss and all(number is None for number in numbers):
        return ""
    if not numbers or not all(isinstance(number, int | float) for number in numbers):
        raise MeasuredError(
            f"{{{place}}}: expected numbers, got {numbers}; fields: {sorted(values[run][0])}"
        )
    metric = METRICS.get(field)
    factor = float(scale) if scale else metric.scale if metric else 1.0
    spec = spec or (f",.{metric.digits}f" if metric else ".4g")
    deviation = f" ± {statistics.stdev(numbers) * factor:{spec}}" if len(numbers) > 1 else ""
    return f"{statistics.fmean(numbers) * factor:{spec}}{deviation}"


def by_scene(
    records: list[Record],
    conditions: Mapping[str, str],
    field: str,
) -> list[tuple[Any, Any]]:
    """Scene, or None, and the field of the records that have all that is wanted."""
    fitting = (
        r
        for r in records
        if field in r and all(str(r.get(key)) == value for key, value in conditions.items())
    )
    return [(r.get("scene"), r[field]) for r in fitting]


def made(
    recipe: Mapping[str, Any],
    values: Mapping[str, list[Record]],
) -> dict[str, Any]:
    """Columns, rows and texts of a table from the records of its runs."""
    rows = recipe["rows"]
    cells = recipe.get("cells")
    if isinstance(rows, str):  # a run: a row for each of its labels
        marks = {r["label"]: r.get("mark", "") for r in values[rows]}
        rows = [[f"`{label}` {mark}".strip(), f"{rows}; {label}"] for label, mark in marks.items()]
    if cells:  # each row is a heading and what stands for @ in the cells
        rows = [
            [row[0], *(text.replace("@", row[-1]) for text in cells)] if len(row) == 2 else row
            for row in rows
        ]
    if wrong := [row for row in rows if len(row) != len(recipe["columns"])]:
        raise MeasuredError(
            f"expected rows of {len(recipe['columns'])} cells, or a heading and a key; got "
            f"{wrong[0]}"
        )
    texts = {key: cell(text, values) for key, text in recipe.get("texts", {}).items()}
    return {
        "columns": recipe["columns"],
        "rows": [[cell(text, values) for text in row] for row in rows],
        "texts": texts,
    }


def renew(
    name: str,
    recipe: Mapping[str, Any],
    recordings: Path,
    finished_records: dict[str, list[Record]],
) -> None:
    """Run the commands of a table and write its numbers. ``finished_records`` has the records of
    commands that have run already."""
    from gsfusion_nb.compare.bench.timing import describe

    if dirty_files := git("status", "--porcelain", "--", *recipe["depends"]).strip():
        raise MeasuredError(f"commit first what the numbers depend on:\n{dirty_files}")
    for line in recipe["commands"]:
        if line not in finished_records:
            print(f"{name}: {line}", flush=True)
            finished_records[line] = records_of(
                line, recordings, measures_times=recipe.get("quiet", False)
            )
    values = {
        run: [r for line in lines for r in finished_records[line]]
        for run, lines in recipe["runs"].items()
    }
    machine = describe(int(os.environ.get("NUMBA_NUM_THREADS", os.cpu_count() or 1)))
    numbers = {key: recipe[key] for key in ("about", "commands", "depends")} | made(recipe, values)
    numbers |= {"commit": git("rev-parse", "HEAD").strip()}
    numbers |= {"date": datetime.date.today().isoformat(), "versions": machine["versions"]}
    if recipe.get("quiet"):
        numbers["quiet"] = True
    numbers["machine"] = {
        "cpu": machine["processor"],
        "cores": machine["cores"],
        "threads": machine["threads"],
    }
    plain_types = (int, float, str)  # but not the settings of a sweep and empty cells
    numbers["values"] = {
        run: [
            {
                k: v
                for k, v in r.items()
                if isinstance(v, plain_types) and v != "" and "setting." not in k
            }
            for r in records
        ]
        for run, records in values.items()
    }
    write_numbers(ROOT / MEASURED / f"{name}.json", numbers)


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


def main(arguments: list[str] | None = None) -> int:
    """List, renew or fill. Returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--renew", nargs="+", metavar="NAME", default=[], help="tables to measure again"
    )
    parser.add_argument(
        "--recordings", type=Path, default=ROOT, help="folder in which commands find the recordings"
    )
    parser.add_argument(
        "--read", type=Path, metavar="FOLDER", help="take what the command has written here already"
    )
    parser.add_argument(
        "--fill", action="store_true", help="fill the pages from the files of numbers"
    )
    parser.add_argument(
        "--confirm",
        action="store_true",
        help="compare today's maps with those of the old tables, which takes ten minutes",
    )
    options = parser.parse_args(arguments)
    recipes = read_recipes()
    finished_records: dict[str, list[Record]] = {}
    try:
        if options.confirm:
            for name, reason in confirm(recipes).items():
                print(f"{name}: {reason or 'the same maps'}")
            fill(write=True)
            return 0
        if not options.renew and not options.fill:
            list_old(recipes)
            return 0
        if options.read:
            line = recipes[options.renew[0]]["commands"][0]
            finished_records[line] = records_of(line, options.recordings, options.read)
        try:
            for name in options.renew:
                renew(name, recipes[name], options.recordings.resolve(), finished_records)
        finally:
            try:
                for name in note_commits():
                    print(
                        f"{name}: whether its commit is in this repository is noted in its file now"
                    )
            except MeasuredError as error:  # the pages are filled all the same
                print(error, file=sys.stderr)
            for page in fill(write=True):
                print(f"filled {page.relative_to(ROOT)}")
    except (MeasuredError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
