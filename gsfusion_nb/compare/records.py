"""``runs.csv`` and ``provenance.json``: every setting and number of every run, and where they come from."""

import csv
import datetime
import hashlib
import io
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..files import plain_cell, write_file
from .map_scene import budgeted
from .result import RunResult
from .run_key import package_fingerprint
from .schedule import flat_settings


def write_records(folder: Path, results: Sequence[RunResult], *, text: str = "") -> list[Path]:
    """Write ``runs.csv`` and ``provenance.json``, each completely or not at all.

    Args:
        folder: The output folder.
        results: The runs so far.
        text: The file that described them.

    Returns:
        The files written.
    """
    texts = {"runs.csv": as_csv(results), "provenance.json": json.dumps(provenance(results, text), indent=1)}
    for name, content in texts.items():
        write_file(folder / name, content)
    return [folder / name for name in texts]


def as_csv(results: Sequence[RunResult]) -> str:
    """A table with a row for each run: what it was, its numbers, how it was tuned, hashes, and all settings."""
    rows = [_row(result) for result in results]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    groups = ("", "metric.", "tuned.", "setting.")
    order = {group: [c for c in columns if _group(c) == group] for group in groups}
    text = io.StringIO()
    writer = csv.DictWriter(text, [c for group in groups for c in order[group]], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: Any) -> Any:
    """Collections as JSON, text without formulas, numbers as they are."""
    if isinstance(value, (dict, list, tuple)):
        return json.dumps(value)
    return plain_cell(value) if isinstance(value, str) else value


def provenance(results: Sequence[RunResult], text: str = "") -> dict[str, Any]:
    """Versions, command, sources of the rules, and hashes of data and maps."""
    done = [result for result in results if result.status == "done"]
    return {
        "written": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": sys.argv,
        "package": package_fingerprint(),
        "versions": _different([dict(r.versions) for r in done]),
        "table": text,
        "rules": {
            r.spec.label: {"rule": r.spec.rule, "blake2b": _hash(r.rule_source), "source": r.rule_source} for r in done
        },
        "data": {r.spec.scene: {"data": r.spec.data, "reader": dict(r.spec.reader), "hash": r.data_hash} for r in done},
        "maps": {r.key: {"label": r.spec.label, "scene": r.spec.scene, "seed": r.spec.seed, "hash": r.map_hash}
                 for r in done},
    }  # fmt: skip


def _row(result: RunResult) -> dict[str, Any]:
    spec = result.spec
    what = {
        "label": spec.label, "rule": spec.rule, "options": dict(spec.options), "scene": spec.scene, "data": spec.data,
        "reader": dict(spec.reader), "seed": spec.seed, "system": spec.system, "steps": spec.budget.steps,
        "budget_gaussians": spec.budget.gaussians, "budget_seconds": spec.budget.seconds,
        "budget_tolerance": spec.budget.tolerance, "status": result.status, "reason": result.reason,
        "copied_from": result.copied_from,
        "notes": "; ".join(result.notes), "key": result.key, "map_hash": result.map_hash, "data_hash": result.data_hash,
    }  # fmt: skip
    return {
        **what,
        **{f"metric.{name}": value for name, value in result.metrics.items()},
        **{f"tuned.{name}": value for name, value in result.tuned.items()},
        **{f"setting.{name}": value for name, value in _settings(result).items()},
    }


def _settings(result: RunResult) -> Mapping[str, Any]:
    try:
        return flat_settings(budgeted(result.spec))
    except (ValueError, KeyError, TypeError):  # the settings are why it failed
        return {}


def _group(column: str) -> str:
    return next((g for g in ("metric.", "tuned.", "setting.") if column.startswith(g)), "")


def _different(found: list[dict[str, str]]) -> list[dict[str, str]]:
    return [values for i, values in enumerate(found) if values not in found[:i]]


def _hash(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
