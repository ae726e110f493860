"""The lab's page: one HTML file with tables, the Pareto plot, and pictures of the same views to compare."""

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..data import BadFrameError
from ..data.recorded.images import decode_rgb, read_image_bytes
from ..drawing.page import ColourBar, PageGraph, fill
from ..drawing.pictures import ERROR_COLOURS, ERROR_LIMIT, Picture, data_uri, error_map, fit_width
from .pareto import figure_of
from .spec import RunResult
from .statistics import Group, compare, corrected, group_runs
from .tables import ResultTable, failures

_RENDER = re.compile(r"held_out (\S+)")
PICTURE_WIDTH = 640
"""Largest width of a stored picture, pixels: a page of a hundred rules, scenes and budgets has about 15 MB."""


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
        if match is None:
            continue
        try:
            render, truth = _read(folder / file), _read(folder / result.pictures[f"truth {match[1]}"])
        except (BadFrameError, KeyError):  # removed since, or damaged: the other views are still worth showing
            continue
        if render.shape == truth.shape:
            yield ViewPictures(name=match[1], truth=truth, render=render)


def _read(path: Path) -> Picture:
    return np.ascontiguousarray(decode_rgb(read_image_bytes(path, "colour"), path))


def page_html(folder: Path | str, results: Sequence[RunResult], tables: Sequence[ResultTable]) -> str:
    """The page as HTML text; it loads nothing and works from a file.

    Args:
        folder: Where the file names of ``RunResult.pictures`` are looked up.
        results: All runs, also those that failed.
        tables: Of these runs.
    """
    groups, pictures, copied = group_runs(results), {}, sum(bool(run.copied_from) for run in results)
    shots = [_shots(group, Path(folder), pictures) for group in groups]
    data = {"pictures": list(pictures), "shots": shots, "sentences": _pair_sentences(results)}
    graph = PageGraph("Quality and cost", figure_of(results))
    return fill(
        "lab.html",
        title="Seeding lab",
        subtitle=f"{len(results)} runs" + (f", {copied} of them copied from the cache" if copied else ""),
        scenes=list(dict.fromkeys(g.scene for g in groups)),
        budgets=list(dict.fromkeys(g.budget for g in groups)),
        labels=list(dict.fromkeys(g.label for g in groups)),
        tables=tables,
        graphs=[graph],
        failures=failures(results),
        error_bar=ColourBar(colours=ERROR_COLOURS, low="no error", high=f"{ERROR_LIMIT:.0%} or more"),
        data=data,
    )


def _shots(group: Group, folder: Path, pictures: dict[str, int]) -> dict[str, Any]:
    """The pictures of the first run of a group that has any: number of each picture, by view.

    ``pictures`` has each picture once, as a data URI, however many runs share it.
    """
    shown = {"label": group.label, "scene": group.scene, "budget": group.budget, "seed": 0, "views": []}
    for run in sorted(group.runs, key=lambda r: r.spec.seed):
        views = []
        for view in views_of(run, folder):
            named = {"truth": view.truth, "render": view.render, "error": view.error}
            uris = {name: data_uri(fit_width(picture, PICTURE_WIDTH)) for name, picture in named.items()}
            numbers = {name: pictures.setdefault(uri, len(pictures)) for name, uri in uris.items()}
            views.append({"name": view.name, **numbers})
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
