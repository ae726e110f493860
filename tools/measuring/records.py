"""Running the commands of a recipe: what each wrote, as flat records."""

import csv
import json
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .recipes import ROOT, MeasuredError

TRAINED_OTHERWISE = "†"
"""Mark of a rule whose publication trains the Gaussians otherwise, as in the tables of the lab."""
NUMBER = re.compile(r"-?\d+(\.\d*)?(e[-+]?\d+)?")
Record = dict[str, Any]
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
