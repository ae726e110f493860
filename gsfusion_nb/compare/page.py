"""The lab's page: one HTML file with tables, Pareto plots, pictures to compare, and where everything comes from."""

import dataclasses
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..data import BadFrameError
from ..data.recorded.images import decode_rgb, read_image_bytes
from ..drawing.curves import figure_svg
from ..drawing.page import ColourBar, PageGraph, fill
from ..drawing.pictures import ERROR_COLOURS, ERROR_LIMIT, Picture, data_uri, error_map, fit_width
from ..evaluation.metrics import format_value
from .pareto import costs_of, pareto_figure, scene_points
from .spec import RunResult
from .statistics import (
    COLUMNS,
    FIRST_METRIC,
    Group,
    against_reference,
    by_budget,
    compare,
    corrected,
    group_runs,
    p_text,
)
from .table_file import Table
from .tables import failures, scene_table, scenes_table

_RENDER = re.compile(r"held_out (\S+)")


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewPictures:
    """One held-out view of a run."""

    name: str
    """Number of the frame, as in the names of the pictures."""
    truth: Picture
    """As recorded."""
    render: Picture
    """As rendered from the map."""

    @property
    def error(self) -> Picture:
        """Mean absolute error over the channels as colour (``drawing.pictures.error_map``)."""
        return error_map(self.render, self.truth)


def views_of(result: RunResult, folder: Path) -> Iterator[ViewPictures]:
    """The views of a run whose two pictures can be read, in the order of ``result.pictures``.

    Args:
        result: A run.
        folder: Where the file names of ``result.pictures`` are looked up.
    """
    for name, file in result.pictures.items():
        match = _RENDER.fullmatch(name)
        truth_file = result.pictures.get(f"truth {match[1]}") if match else None
        if match is None or truth_file is None:
            continue
        try:
            render, truth = _read(folder / file), _read(folder / truth_file)
        except BadFrameError:  # removed since, or damaged: the other views are still worth showing
            continue
        if render.shape == truth.shape:
            yield ViewPictures(name=match[1], truth=truth, render=render)


def _read(path: Path) -> Picture:
    return np.ascontiguousarray(decode_rgb(read_image_bytes(path, "colour"), path))


PICTURE_WIDTH = 640
"""Largest width of a stored picture, pixels: a page of a hundred rules, scenes and budgets has about 15 MB."""


_NOUNS = {"n_gaussians": "size", "ms_per_frame": "time", "n_steps": "gradient steps"}


class Pictures:
    """Pictures as data URIs, each stored once however many runs share it."""

    def __init__(self):
        self.uris: list[str] = []
        self._numbers: dict[str, int] = {}

    def number(self, picture: Picture) -> int:
        """Position of a picture in ``uris``; a wide one is made smaller."""
        uri = data_uri(fit_width(picture, PICTURE_WIDTH))
        if uri not in self._numbers:
            self._numbers[uri] = len(self.uris)
            self.uris.append(uri)
        return self._numbers[uri]


def page_html(folder: Path | str, results: Iterable[RunResult], table: Table | None = None) -> str:
    """The page as HTML text; it loads nothing and works from a file.

    Args:
        folder: Where the file names of ``RunResult.pictures`` are looked up.
        results: All runs, also those that failed.
        table: As for ``write_outputs``.
    """
    results, pictures, table = list(results), Pictures(), table or Table()
    groups = group_runs(results)
    shots = [_shots(group, Path(folder), pictures) for group in groups]
    data = {"pictures": pictures.uris, "shots": shots, "sentences": _pair_sentences(results)}
    return fill(
        "lab.html",
        title="Seeding lab",
        subtitle=_subtitle(results, groups),
        scenes=list(dict.fromkeys(g.scene for g in groups)),
        budgets=list(dict.fromkeys(g.budget for g in groups)),
        labels=list(dict.fromkeys(g.label for g in groups)),
        tables=_tables(results, groups, table),
        graphs=_graphs([group for group in groups if not group.fixes_cost]),
        noise=_noise(results, table.reference),
        failures=failures(results),
        provenance=provenance(results),
        error_bar=ColourBar(colours=ERROR_COLOURS, low="no error", high=f"{ERROR_LIMIT:.0%} or more"),
        data=data,
    )


def provenance(results: Sequence[RunResult]) -> dict[str, Any]:
    """Where the numbers come from: versions, settings that all runs share, sources, tuning, hashes of data and maps."""
    done = [r for r in results if r.status == "done"]
    versions = {name: value for r in done for name, value in r.versions.items()}
    flat = [{"system": r.spec.system, "preset": r.spec.preset, **r.spec.settings} for r in results]
    shared = {
        name: value for name, value in (flat[0] if flat else {}).items() if all(f.get(name) == value for f in flat)
    }
    sources: dict[str, tuple[list[str], str]] = {}
    for r in done:
        names, _ = sources.setdefault(r.rule_source, ([], r.rule_source))
        if r.spec.label not in names:
            names.append(r.spec.label)
    return {
        "versions": [(name, format_value(value)) for name, value in versions.items()],
        "settings": [(name, format_value(value)) for name, value in shared.items()],
        "sources": [(", ".join(names), source) for names, source in sources.values() if source],
        "data": list(dict.fromkeys((r.spec.scene, r.data_hash) for r in done if r.data_hash)),
        "maps": [
            (r.spec.label, r.spec.scene, str(r.spec.budget), r.spec.seed, _tuning(r.tuned), r.map_hash) for r in done
        ],
    }


def _subtitle(results: Sequence[RunResult], groups: Sequence[Group]) -> str:
    counts = {
        "rule": len({g.label for g in groups}), "scene": len({g.scene for g in groups}),
        "budget": len({g.budget for g in groups}), "seed": len({r.spec.seed for r in results}), "run": len(results),
    }  # fmt: skip
    return " · ".join(f"{n} {noun}{'s' if n != 1 else ''}" for noun, n in counts.items())


def _tables(results: Sequence[RunResult], groups: Sequence[Group], about: Table) -> list[dict[str, Any]]:
    """A table for each budget and scene; the one over all scenes has the scene ""."""
    tables = []
    for of_budget in by_budget(groups):
        budget, scenes = of_budget[0].budget, list(dict.fromkeys(g.scene for g in of_budget))
        for scene in scenes:
            table = scene_table([g for g in of_budget if g.scene == scene])
            tables.append({"budget": budget, "scene": scene, "table": table})
        if len(scenes) > 1:
            table = scenes_table(results, budget, reference=about.reference, tuned_on=about.tuned_on)
            tables.append({"budget": budget, "scene": "", "table": table})
    return tables


def _graphs(groups: Sequence[Group]) -> list[PageGraph]:
    graphs = []
    for scene, cost in itertools.product(dict.fromkeys(g.scene for g in groups), costs_of(groups)):
        points = scene_points([g for g in groups if g.scene == scene], cost)
        if len(points.names):
            title = f"{scene}: quality and {_NOUNS[cost]}"
            figure = pareto_figure(dataclasses.replace(points, title=""))
            graphs.append(PageGraph(title, figure_svg(figure, f"{title}; {points.quality_label}, {points.cost_label}")))
    return graphs


def _shots(group: Group, folder: Path, pictures: Pictures) -> dict[str, Any]:
    """The pictures of the first run of a group that has any: number of each picture, by view."""
    shown = {"label": group.label, "scene": group.scene, "budget": group.budget, "seed": 0, "views": []}
    for run in sorted(group.runs, key=lambda r: r.spec.seed):
        views = [
            {
                "name": view.name,
                "truth": pictures.number(view.truth),
                "render": pictures.number(view.render),
                "error": pictures.number(view.error),
            }
            for view in views_of(run, folder)
        ]
        if views:
            return {**shown, "seed": run.spec.seed, "views": views}
    return shown


def _pair_sentences(results: Sequence[RunResult]) -> list[tuple[str, str, str, str]]:
    """Budget, two rules, and what the test says about them, corrected for all pairs of rules."""
    found = []
    for budget in dict.fromkeys(str(r.spec.budget) for r in results):
        labels = dict.fromkeys(r.spec.label for r in results if str(r.spec.budget) == budget)
        pairs = [compare(results, a, b, budget=budget) for a, b in itertools.combinations(labels, 2)]
        found += [(budget, c.a, c.b, str(c)) for c in corrected(pairs)]
    return found


def _noise(results: Sequence[RunResult], reference: str) -> list[dict[str, Any]]:
    """A table for each budget: the reference and each other rule."""
    column, found = COLUMNS[FIRST_METRIC], []
    for budget in dict.fromkeys(str(r.spec.budget) for r in results):
        tests = against_reference(results, budget, reference)
        rows = [
            (
                c.b, column.text(c.mean), f"{column.text(c.interval[0])} to {column.text(c.interval[1])}",
                _bare(c.p_t), _bare(c.corrected), f"{len(c.units)}", _VERDICTS[c.verdict],
            )
            for c in tests
        ]  # fmt: skip
        if rows:
            found.append({"budget": budget, "best": tests[0].a, "rows": rows})
    return found


_VERDICTS = {
    "unknown": "cannot be said", "equal": "equal everywhere", "noise": "within noise", "a": "more than noise",
    "b": "more than noise",
}  # fmt: skip


def _bare(p: float) -> str:
    return p_text(p).removeprefix("p ").removeprefix("= ")


def _tuning(tuned: Mapping[str, Any]) -> str:
    """How the budget of a run was reached, as short text."""
    if not tuned:
        return ""
    words = f"{tuned.get('option', '')} = {format_value(tuned.get('value', ''))}"
    return f"{words}, {tuned.get('n_runs', 0)} tuning runs, {format_value(tuned.get('error_percent', 0.0))} % off"
