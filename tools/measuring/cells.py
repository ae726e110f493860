"""The cells of a table, from the records of its runs."""

import re
import statistics
from collections.abc import Mapping
from typing import Any

from .recipes import MeasuredError
from .records import Record


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
