"""The lab's page: one HTML file with tables, the Pareto plot, and pictures of the same views to
compare.

The plot has one part for each scene and cost, with the front of the rules that no other beats.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..data import BadFrameError
from ..data.recorded.images import decode_rgb, read_image_bytes
from ..drawing.curves import GRID, INK, MUTED, PAPER
from ..drawing.encoding import data_uri
from ..drawing.page import ColourBar, PageGraph, fill
from ..drawing.pictures import ERROR_COLOURS, ERROR_LIMIT, Picture, error_map, fit_width
from .paired_tests import all_pairs
from .run_result import RunResult
from .statistics import COLUMNS, FIRST_METRIC, Group, group_runs
from .tables import ResultTable, failures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ON_FRONT = "#d1495b"
BEATEN = "#3d85c6"
COSTS = {
    "n_gaussians": "Gaussians (fewer is better)",
    "ms_per_frame": "time per frame, ms (less is better)",
    "n_steps": "gradient steps (fewer is better)",
}
"""Costs of the figure and their labels."""


def pareto_front(cost: np.ndarray, quality: np.ndarray) -> np.ndarray:
    """The candidates that no other beats, that is, none is at least as good in both numbers and
    better in one.

    Args:
        cost: Less is better. [N]
        quality: More is better. [N]

    Returns:
        Whether each candidate is on the front; two equal ones both are. [N] bool
    """
    cost = np.asarray(cost, float)
    quality = np.asarray(quality, float)
    as_good = (cost[:, None] <= cost) & (quality[:, None] >= quality)
    better = (cost[:, None] < cost) | (quality[:, None] > quality)
    return np.logical_not((as_good & better).any(axis=0))


def figure_of(results: Iterable[RunResult]) -> "Figure":
    """Held-out PSNR over each cost on each scene, with the front as a red line, and a name beside
    the best point of each rule; error bars: standard deviation over seeds. Points of a rule at
    several budgets are joined."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    groups = group_runs(results)
    costs = costs_of(groups)
    scenes = list(dict.fromkeys(g.scene for g in groups)) or [""]
    size = (6.4 * len(costs), 4.0 * len(scenes))
    figure = Figure(figsize=size, dpi=100, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    for i, scene in enumerate(scenes):
        for j, cost in enumerate(costs):
            axes = figure.add_subplot(
                len(scenes),
                len(costs),
                i * len(costs) + j + 1,
            )
            _draw(axes, [g for g in groups if g.scene == scene], cost, scene)
    return figure


def costs_of(groups: Sequence[Group]) -> list[str]:
    """The costs that are plotted: the size unless every budget fixes it, and gradient steps only
    where the rules took different numbers of them."""
    steps = {group.summary("n_steps").mean for group in groups if group.summary("n_steps").n}
    fixes_size = bool(groups) and all(group.fixes_size for group in groups)
    return [
        c
        for c in COSTS
        if not (c == "n_gaussians" and fixes_size) and not (c == "n_steps" and len(steps) < 2)
    ]


def _draw(
    axes: "Axes",
    groups: Sequence[Group],
    cost_name: str,
    scene: str,
) -> None:
    from matplotlib.ticker import NullFormatter

    axes.set_xlabel(COSTS[cost_name], color=MUTED)
    axes.set_ylabel(COLUMNS[FIRST_METRIC].name, color=MUTED)
    axes.tick_params(colors=MUTED, which="both")
    axes.grid(True, which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    title = f"{scene}\nred: on the Pareto front".strip()
    # a name is no formula
    axes.set_title(title, fontsize=9, color=MUTED, loc="left", parse_math=False)
    points = [(g.label, g.summary(cost_name), g.summary(FIRST_METRIC)) for g in groups]
    points = [(label, c, q) for label, c, q in points if c.n and np.isfinite(q.mean) and c.mean > 0]
    if not points:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no rule has finished yet", ha="center", va="center", color=MUTED)
        return
    names = [label for label, _, _ in points]
    cost, quality = np.array([[c.mean, q.mean] for _, c, q in points]).T
    wide, high = np.nan_to_num(np.array([[c.sd, q.sd] for _, c, q in points])).T
    front = pareto_front(cost, quality)
    for is_drawn, colour in ((front, ON_FRONT), (~front, BEATEN)):
        left_error = np.minimum(wide, 0.9 * cost)  # a logarithmic axis has no zero
        axes.errorbar(
            cost[is_drawn],
            quality[is_drawn],
            xerr=(left_error[is_drawn], wide[is_drawn]),
            yerr=high[is_drawn],
            fmt="o",
            color=colour,
            alpha=0.8,
            linewidth=1.3,
            zorder=3,
        )
    best = np.argsort(cost[front], kind="stable")
    axes.step(
        cost[front][best],
        quality[front][best],
        where="post",
        color=ON_FRONT,
        linewidth=1.2,
        zorder=2,
    )
    for name in dict.fromkeys(names):
        own = sorted((i for i, other in enumerate(names) if other == name), key=lambda i: cost[i])
        axes.plot(
            cost[own],
            quality[own],
            color=MUTED,
            linewidth=0.8,
            alpha=0.5,
            zorder=1,
        )
    axes.margins(x=0.2, y=0.15)
    if cost.max() >= 2 * cost.min():
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(_plain_number)
        is_short = cost.max() < 10 * cost.min()  # then powers of ten alone are too few
        axes.xaxis.set_minor_formatter(_plain_number if is_short else NullFormatter())
    best_of = {name: max(_rows_of(names, name), key=lambda i: quality[i]) for name in names}
    _write_names(axes, best_of, cost, quality)


def _rows_of(names: Sequence[str], name: str) -> list[int]:
    return [i for i, other in enumerate(names) if other == name]


def _plain_number(value: float | int, _: float | int) -> str:
    """A tick of a logarithmic axis at 1, 2, 3 or 5 times a power of ten; another one has no
    number."""
    first_digit = f"{value:.0e}"[0]
    return f"{value:,.6g}" if first_digit in "1235" else ""


_PLACES = tuple(
    {"xytext": (side * 5, height), "ha": "left" if side > 0 else "right"}
    for height in (4, -11, 14, -21, 24, -31)
    for side in (1, -1)
)
"""Where a name may stand beside its point, the best place first; in points."""


def _write_names(
    axes: "Axes", best_of: Mapping[str, int], cost: np.ndarray, quality: np.ndarray
) -> None:
    """Write each name beside its best point, at the first place in the graph at which it covers no
    other name and no point; at the first one where there is none."""
    from matplotlib.transforms import Bbox

    figure: Any = axes.figure
    figure.draw_without_rendering()
    taken = [
        Bbox.from_bounds(u - 3, v - 3, 6, 6)
        for u, v in axes.transData.transform(np.stack([cost, quality], axis=1))
    ]
    for name, i in best_of.items():
        written = axes.annotate(
            name,
            (float(cost[i]), float(quality[i])),
            textcoords="offset points",
            fontsize=8,
            color=INK,
            parse_math=False,
            **_PLACES[0],
        )
        for place in (*_PLACES, _PLACES[0]):
            written.set(position=place["xytext"], ha=place["ha"])
            box = written.get_window_extent()
            is_inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1
            if is_inside and not any(box.overlaps(other) for other in taken):
                break
        taken.append(box)


_RENDER = re.compile(r"held_out (\S+)")
PICTURE_WIDTH = 640
"""Largest width of a stored picture, pixels: a page of a hundred rules, scenes and budgets has
about 15 MB."""


def views_of(
    result: RunResult,
    folder: Path,
) -> Iterator[tuple[str, dict[str, Picture]]]:
    """The held-out views of a run whose two pictures can be read, in the order of
    ``result.pictures``: number of the frame, and "truth" (as recorded), "render" and "error".

    Args:
        result: A run.
        folder: Where the file names of ``result.pictures`` are looked up.
    """
    for name, file in result.pictures.items():
        match = _RENDER.fullmatch(name)
        if match is None:
            continue
        try:
            render = _read(folder / file)
            truth = _read(folder / result.pictures[f"truth {match[1]}"])
        except (
            BadFrameError,
            KeyError,
        ):  # removed since, or damaged: the other views are still worth showing
            continue
        if render.shape == truth.shape:
            yield match[1], {"truth": truth, "render": render, "error": error_map(render, truth)}


def _read(path: Path) -> Picture:
    return np.ascontiguousarray(decode_rgb(read_image_bytes(path, "colour"), path))


def page_html(
    folder: Path | str,
    results: Sequence[RunResult],
    tables: Sequence[ResultTable],
    warnings: Sequence[str] = (),
) -> str:
    """The page as HTML text; it loads nothing and works from a file.

    Args:
        folder: Where the file names of ``RunResult.pictures`` are looked up.
        results: All runs, also those that failed.
        tables: Of these runs.
        warnings: Sentences above the tables.
    """
    groups = group_runs(results)
    pictures = {}
    n_copies = sum(bool(run.copied_from) for run in results)
    shots = [_shots(group, Path(folder), pictures) for group in groups]
    data = {"pictures": list(pictures), "shots": shots, "sentences": _pair_sentences(results)}
    graph = PageGraph("Quality and cost", figure_of(results))
    return fill(
        "lab.html",
        title="Seeding lab",
        subtitle=f"{len(results)} runs"
        + (f", {n_copies} of them copied from the cache" if n_copies else ""),
        scenes=list(dict.fromkeys(g.scene for g in groups)),
        budgets=list(dict.fromkeys(g.budget for g in groups)),
        labels=list(dict.fromkeys(g.label for g in groups)),
        tables=tables,
        graphs=[graph],
        failures=failures(results),
        warnings=warnings,
        error_bar=ColourBar(
            colours=ERROR_COLOURS, low="no error", high=f"{ERROR_LIMIT:.0%} or more"
        ),
        data=data,
    )


def _shots(
    group: Group,
    folder: Path,
    pictures: dict[str, int],
) -> dict[str, Any]:
    """The pictures of the first run of a group that has any: number of each picture, by view.

    ``pictures`` has each picture once, as a data URI, however many runs share it.
    """
    shots = {
        "label": group.label,
        "scene": group.scene,
        "budget": group.budget,
        "seed": 0,
        "views": [],
    }
    for run in sorted(group.runs, key=lambda r: r.spec.seed):
        views = []
        for frame, views_of_frame in views_of(run, folder):
            uris = {
                name: data_uri(fit_width(picture, PICTURE_WIDTH))
                for name, picture in views_of_frame.items()
            }
            numbers = {name: pictures.setdefault(uri, len(pictures)) for name, uri in uris.items()}
            views.append({"name": frame, **numbers})
        if views:
            return {**shots, "seed": run.spec.seed, "views": views}
    return shots


def _pair_sentences(results: Sequence[RunResult]) -> list[tuple[str, str, str, str]]:
    """Budget, two rules, and what the test says about them, corrected for all pairs of rules."""
    budgets = dict.fromkeys(str(result.spec.budget) for result in results)
    return [(budget, c.a, c.b, str(c)) for budget in budgets for c in all_pairs(results, budget)]
