"""The files about runs: all settings and numbers, where they come from, tables, figures, the page."""

import csv
import datetime
import hashlib
import io
import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files import atomic_file, plain_cell, write_file
from .map_scene import budgeted
from .page import page_html
from .pareto import figure_of
from .schedule import flat_settings
from .spec import RunResult, package_fingerprint
from .statistics import COLUMNS, Group, Summary, against_reference, by_budget, group_runs, standings, summarise
from .table_file import Table
from .tables import ResultTable, as_markdown, failures, latex_file, scene_table, scenes_table


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


if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PARETO = ("pareto.pdf", "pareto.png")


def write_outputs(
    folder: Path | str, results: Iterable[RunResult], table: Table | None = None, *, pictures: bool = True
) -> list[Path]:
    """Write ``runs.csv``, ``provenance.json``, ``table.md``, ``table.tex``, ``table.json``, ``page.html``, and the
    Pareto figure as PDF and PNG, which is left out where every budget fixes size or time.

    Existing files are replaced, each completely or not at all; so it can be called again after every run.

    Args:
        folder: Where the files go; the names in ``RunResult.pictures`` are looked up there.
        results: All runs, also those that failed. The order of the rules, scenes and budgets is kept.
        table: The file that described them, for its reference, what rules were tuned on, and the scenes left out.
        pictures: Write page and figure, too, which takes seconds with many runs.

    Returns:
        The files written.
    """
    folder, results, table = Path(folder), list(results), table or Table()
    tables = all_tables(results, table)
    texts = {
        "runs.csv": as_csv(results),
        "provenance.json": json.dumps(provenance(results, table.text), indent=1),
        "table.md": markdown_file(results, tables, table),
        "table.tex": latex_file(tables),
        "table.json": json.dumps(as_json(results, table), indent=1, allow_nan=False),
    }
    if pictures:
        texts["page.html"] = page_html(folder, results, table)
    for name, text in texts.items():
        write_file(folder / name, text)
    figures = _PARETO if pictures and not all(group.fixes_cost for group in group_runs(results)) else ()
    for name in _PARETO:
        (folder / name).unlink(missing_ok=True) if name not in figures else save_figure(
            figure_of(results), folder / name
        )
    return [folder / name for name in (*texts, *figures)]


def all_tables(results: Iterable[RunResult], table: Table | None = None) -> list[ResultTable]:
    """For each budget: the rules with the scenes as columns, if there are several, and a table of each scene."""
    results, table, tables = list(results), table or Table(), []
    for of_budget in by_budget(group_runs(results)):
        scenes = list(dict.fromkeys(group.scene for group in of_budget))
        if len(scenes) > 1:
            budget = of_budget[0].budget
            tables.append(scenes_table(results, budget, reference=table.reference, tuned_on=table.tuned_on))
        tables += [scene_table([g for g in of_budget if g.scene == scene]) for scene in scenes]
    return tables


def markdown_file(results: Sequence[RunResult], tables: Iterable[ResultTable], table: Table) -> str:
    """All tables, the comparisons with the reference, the scenes that were left out, and the runs that failed."""
    parts = ["# Results", *map(as_markdown, tables)]
    for budget in dict.fromkeys(str(r.spec.budget) for r in results):
        if tests := against_reference(results, budget, table.reference):
            parts.append("\n".join([f"### More than noise? {budget}", "", *(f"- {test}" for test in tests)]))
    if table.skipped:
        parts.append("\n".join(["### Scenes that were left out", "", *(f"- {line}" for line in table.skipped)]))
    lost = failures(results)
    if lost:
        lines = [f"- {label}, {scene}, {budget}, seed {seed}: {reason}" for label, scene, budget, seed, reason in lost]
        parts.append("\n".join(["### Runs that failed", "", *lines]))
    return "\n\n".join(parts) + "\n"


def as_json(results: Sequence[RunResult], table: Table) -> dict[str, Any]:
    """The numbers of the tables in their stored units, without rounding, as plain values.

    ``budgets`` has an entry for each budget, and its ``rows`` one for each rule, in the order of the table:
    ``metrics`` has for each number the mean over the scenes, their standard deviation and number, ``scenes`` the mean,
    standard deviation and number of the seeds on each scene, ``test`` the comparison with the reference.
    """
    done = [r for r in results if r.status == "done"]
    return {
        "command": sys.argv,
        "written": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "package": package_fingerprint(),
        "versions": [dict(v) for v in {tuple(sorted(r.versions.items())) for r in done}],
        "seeds": sorted({r.spec.seed for r in results}),
        "table": table.text,
        "tuned_on": dict(table.tuned_on),
        "skipped": list(table.skipped),
        "budgets": [_budget_json(results, groups, table) for groups in by_budget(group_runs(results))],
    }


def _budget_json(results: Sequence[RunResult], groups: Sequence[Group], table: Table) -> dict[str, Any]:
    budget, scenes = groups[0].budget, list(dict.fromkeys(g.scene for g in groups))
    tests = against_reference(results, budget, table.reference)
    against = {test.b: test for test in tests}
    rows = []
    for standing in standings(groups):
        own = {g.scene: g for g in groups if g.label == standing.label}
        means = {m: [s.mean for g in own.values() if (s := g.summary(m)).n] for m in COLUMNS}
        test = against.get(standing.label)
        rows.append({
            "rule": standing.label,
            "rank": _number(standing.rank),
            "metrics": {m: _summary(summarise(of)) for m, of in means.items() if of},
            "scenes": {
                scene: {m: _summary(s) for m in COLUMNS if (s := group.summary(m)).n} for scene, group in own.items()
            },
            "failed": {scene: group.failed[0].reason for scene, group in own.items() if group.failed},
            "test": None if test is None else {
                "difference": _number(test.mean), "interval": [_number(v) for v in test.interval],
                "p": _number(test.p_t), "p_corrected": _number(test.corrected),
                "p_signed_rank": _number(test.p_signed_rank), "n": len(test.units), "verdict": test.verdict,
            },
        })  # fmt: skip
    return {"budget": budget, "scenes": scenes, "reference": tests[0].a if tests else "", "rows": rows}


def _summary(summary: Summary) -> dict[str, Any]:
    return {"mean": _number(summary.mean), "sd": _number(summary.sd), "n": summary.n}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PDF or PNG, without a date, so that equal figures are equal files."""
    import matplotlib

    options: dict[str, Any] = {"metadata": {"CreationDate": None}} if path.suffix == ".pdf" else {"dpi": 150}
    with matplotlib.rc_context({"pdf.fonttype": 42}), atomic_file(path) as temporary:
        figure.savefig(temporary, **options)
