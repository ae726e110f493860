"""A row for each run: what it was, its numbers, how it was tuned, hashes, and all settings."""

import csv
import io
import json
from collections.abc import Sequence
from typing import Any

from ..files import plain_cell
from .equal_maps import EqualMaps, equal_maps
from .map_scene import budgeted
from .run_result import RunResult
from .scene_units import scene_units
from .schedule import flat_settings


def as_csv(results: Sequence[RunResult]) -> str:
    """A table with a row for each run: what it was, its numbers, how it was tuned, hashes, and all
    settings.

    ``same_map_as`` has the labels of the rows that made the same map, and ``unit`` the scenes that
    count as one with that of the row.
    """
    units = scene_units(results)
    equal = equal_maps(results)
    rows = [
        {
            **_row(result),
            "same_map_as": _same_map_as(result, equal),
            "unit": units[result.spec.scene],
        }
        for result in results
    ]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, sorted(columns, key=_group), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _same_map_as(result: RunResult, equal: Sequence[EqualMaps]) -> str:
    """Labels of the other rows with the map of ``result``."""
    spec = result.spec
    own_map = (
        e for e in equal if e.budget == str(spec.budget) and (spec.scene, spec.seed) in e.places
    )
    return "; ".join(
        label
        for e in own_map
        if spec.label in e.labels
        for label in e.labels
        if label != spec.label
    )


def _group(column: str) -> int:
    return ("", "metric", "tuned", "setting").index(
        column.partition(".")[0] if "." in column else ""
    )


def _cell(value: Any) -> Any:
    """Collections as JSON, text without formulas, numbers as they are."""
    if isinstance(value, (dict, list, tuple)):
        return json.dumps(value)
    return plain_cell(value) if isinstance(value, str) else value


def _row(result: RunResult) -> dict[str, Any]:
    spec = result.spec
    try:
        settings = flat_settings(budgeted(spec))
    except (ValueError, KeyError, TypeError):  # the settings are why it failed
        settings = {}
    return {
        "label": spec.label,
        "rule": spec.rule,
        "options": dict(spec.options),
        "scene": spec.scene,
        "data": spec.data,
        "reader": dict(spec.reader),
        "seed": spec.seed,
        "system": spec.system_name,
        "loss": spec.training.get("loss", {}).get("name", ""),
        "optimiser": spec.training.get("optimiser", {}).get("name", ""),
        "device": spec.device,
        "steps": spec.budget.steps,
        "budget_gaussians": spec.budget.gaussians,
        "budget_tolerance": spec.budget.tolerance,
        "status": result.status,
        "reason": result.reason,
        "notes": "; ".join(result.notes),
        "published_training": result.training,
        "key": result.key,
        "map_hash": result.map_hash,
        "data_hash": result.data_hash,
        "copied_from": result.copied_from,
        **{f"metric.{name}": value for name, value in result.metrics.items()},
        **{f"tuned.{name}": value for name, value in result.tuned.items()},
        **{f"setting.{name}": value for name, value in settings.items()},
    }
