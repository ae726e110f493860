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
import datetime
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from measuring.age import confirm, list_old, note_commits
from measuring.cells import made
from measuring.history import git
from measuring.pages import fill
from measuring.recipes import MEASURED, ROOT, MeasuredError, read_recipes, write_numbers
from measuring.records import Record, records_of


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
