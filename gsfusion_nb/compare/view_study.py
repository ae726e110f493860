"""``gsfusion-nb study views``: what a number of decibels means, by where the scored views are.

A map is scored on views that it was made of, on held-out views between them, and on views of
stretches of the walk that were not mapped. Beside the three systems stand Gaussians that belong to
a frame (``frame_owned``): their score on mapped views is higher than that of any map, and says
little about the scene.
"""

import csv
import io
import json
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_name
from ..drawing.pictures import to_uint8
from ..evaluation import ImageScores, NotComputed, score_view
from ..files import write_file
from ..gaussians import GaussianModel
from ..render import render_forward
from ..types import Camera, RenderOutput
from .frame_owned import FrameOwnedMap, train_step
from .map_scene import Entry, budgeted, finished, map_scene
from .markdown import number_text, plain_markdown
from .recording_specs import (
    RecordingOptions,
    check_one_process,
    labels_with,
    ran_under,
    recording_specs,
)
from .spec import RunSpec
from .walk_split import WalkSplit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUESTION = "What a map shows from views that it was made of, between them, and far from all"
SYSTEMS = {"GSFusion": "gsfusion", "RTG-SLAM": "rtg_slam", "GPS-SLAM": "gps_slam"}
"""Label -> name of the system."""
MERGED_PASSES = 2
"""Passes over the mapped views with the Gaussians of all sets as one map."""
OWN_SETS = "frame-owned"
ONE_MAP = "frame-owned, one map"
TRAINED_MAP = f"frame-owned, one map, {MERGED_PASSES} passes"
WAYS = (*SYSTEMS, OWN_SETS, ONE_MAP, TRAINED_MAP)
"""Labels of the rows."""
GROUPS = ("mapped", "between", "far")
"""Views that are scored."""
PICTURES_IN_A_ROW = 4
ABOUT = """\
Mapped views were given to the map, views between are held out among them, far views are from two
stretches of the walk, a tenth of it each, of which nothing was mapped. Depth: mean absolute error
where the view has depth. frame-owned: each mapped frame has a round Gaussian for every pixel, of
which colour, radius and opacity are trained on that frame and then frozen; a view is drawn from the
set of the nearest frame and the two before it. One map: all sets together.
Some views are easier than others: compare the rows of a column, and a difference of columns with
that of another row.
"""

Draw = Callable[[Camera, Float[Tensor, "4 4"]], RenderOutput]


@dataclass(frozen=True, kw_only=True, eq=False)
class WayScores:
    """How one way shows the views."""

    label: str
    seed: int
    n_gaussians: int
    psnr_db: Mapping[str, float]
    """Group of views -> mean PSNR; a group of which no view could be scored is missing."""
    depth_l1_m: Mapping[str, float]
    """Group of views -> mean absolute error of the depth, metres."""
    pictures: Mapping[str, tuple[Tensor, float]]
    """Group of views -> picture of its middle view, and the PSNR of that. [H, W, 3]"""

    def numbers(self) -> dict[str, float]:
        """All numbers by name; ``inflation_db`` is how far the PSNR of mapped views is above that
        of far ones."""
        numbers = {"n_gaussians": float(self.n_gaussians)}
        numbers |= {f"psnr_{group}_db": value for group, value in self.psnr_db.items()}
        numbers |= {f"depth_l1_{group}_m": value for group, value in self.depth_l1_m.items()}
        if {"mapped", "far"} <= self.psnr_db.keys():
            numbers["inflation_db"] = self.psnr_db["mapped"] - self.psnr_db["far"]
        return numbers


def main(options: RecordingOptions, data: str, folder: Path, only: str = "") -> int:
    """``gsfusion-nb study views``: print the table, and write it and the pictures to ``folder``.

    Raises:
        ValueError: a recording that is too short, ``only`` leaves nothing, or more than one process
            is asked for.
    """
    check_one_process(options, "views")
    labels = labels_with(only, WAYS, "way")
    specs = view_specs(options, data)
    split = WalkSplit.of(Entry(spec=specs[0]).opened())
    print(f"{QUESTION}, on {data}\n{ran_under(specs)}\n{views_in_words(split)}")
    scores = []
    for way in score_ways(specs, split, labels):
        print(f"{way.label}, seed {way.seed}: {_in_words(way)}", flush=True)
        scores.append(way)
    text = as_markdown(scores)
    print(f"\n{text}")
    about = f"{QUESTION}\n\n{views_in_words(split)}\n\n{ABOUT}"
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / "table.md", f"{about}\n{text}\n".encode())
    write_file(folder / "table.json", json.dumps(as_records(scores), indent=1).encode())
    write_file(folder / "views.csv", as_csv(scores).encode())
    views_figure(split, scores).savefig(folder / "views.png")
    print(f"\nFiles in {folder}")
    return 0


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewComparison:
    """Maps of one walk and how they show its views; as text the table."""

    split: WalkSplit
    scores: Sequence[WayScores]

    def __repr__(self) -> str:
        lines = [f"{way.label}: {_in_words(way)}" for way in self.scores]
        return "\n".join([views_in_words(self.split), *lines])

    def figure(self) -> "Figure":
        """A mapped view and a far one, as a photograph and as each way shows it."""
        return views_figure(self.split, self.scores)


def compare_views(
    data: str = "room",
    *,
    ways: Sequence[str] = WAYS,
    settings: Sequence[str] = (),
    reader: Sequence[str] = (),
) -> ViewComparison:
    """What ``gsfusion-nb study views`` does, with one seed.

    Args:
        data: Folder of a recording, or "room" for the built-in scene.
        ways: Some of ``WAYS``.
        settings: Of all systems, such as ``("data.width=160", "data.height=120")``.
        reader: Options of the layout's reader, such as ``("n_frames=60",)``.

    Raises:
        ValueError, KeyError, TypeError: a recording that is too short, a way or a setting that does
            not exist, or a value that is refused.
    """
    for way in ways:
        check_name("way", way, WAYS)
    options = RecordingOptions(set=tuple(settings), reader=tuple(reader))
    specs = view_specs(options, data)
    split = WalkSplit.of(Entry(spec=specs[0]).opened())
    return ViewComparison(split=split, scores=list(score_ways(specs, split, ways)))


def view_specs(options: RecordingOptions, data: str) -> list[RunSpec]:
    """A run of each system and seed, with the poses of the recording.

    Raises:
        ValueError, KeyError, TypeError: a setting that does not exist, or a value that is refused.
    """
    variants = {label: {"system": name} for label, name in SYSTEMS.items()}
    return recording_specs(variants, options, data, common={"tracking.poses": "given"})


def score_ways(
    specs: Sequence[RunSpec], split: WalkSplit, labels: Sequence[str] = WAYS
) -> Iterator[WayScores]:
    """Make the maps one after the other and score each.

    Args:
        specs: The runs of the systems.
        split: What is mapped, and what is scored.
        labels: Which of ``WAYS``.
    """
    for spec in specs:
        if spec.label in labels:
            entry = Entry(spec=spec, sequence=split.sequence)
            mapper = finished(map_scene(entry, budgeted(spec))).run.mapper
            yield _scores(spec.label, mapper.render, len(mapper.gaussians), split, spec.seed)
    if not {OWN_SETS, ONE_MAP, TRAINED_MAP} & set(labels):
        return
    owned = FrameOwnedMap()
    for frame in split.sequence.mapping:
        owned.add(frame)
    if OWN_SETS in labels:
        yield _scores(OWN_SETS, owned.render, len(owned), split)
    merged = owned.merged()
    draw = partial(draw_model, merged)
    if ONE_MAP in labels:
        yield _scores(ONE_MAP, draw, len(merged), split)
    if TRAINED_MAP in labels:
        for _ in range(MERGED_PASSES):
            for frame in split.sequence.mapping:
                train_step(merged, frame, [])
        yield _scores(TRAINED_MAP, draw, len(merged), split)


def draw_model(model: GaussianModel, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
    """The picture of a map of Gaussians."""
    return render_forward(model.params, camera, T_WC)[0]


def _scores(label: str, draw: Draw, n_gaussians: int, split: WalkSplit, seed: int = 0) -> WayScores:
    """Draw and score all views."""
    psnr_db = {}
    depth_l1_m = {}
    pictures = {}
    for group, positions in split.views().items():
        rows = []
        for place, frame in enumerate(split.frames(positions)):
            with torch.no_grad():
                output = draw(frame.camera, frame.T_WC)
            rows.append(score_view(output, frame))
            if place == len(positions) // 2:
                pictures[group] = (output.rgb.clamp(0, 1).cpu(), rows[-1].psnr)
        scores = ImageScores(rows=tuple(rows))
        for name, values in (("psnr", psnr_db), ("depth_l1_m", depth_l1_m)):
            mean = scores.mean(name)
            if not isinstance(mean, NotComputed):
                values[group] = mean
    return WayScores(
        label=label,
        seed=seed,
        n_gaussians=n_gaussians,
        psnr_db=psnr_db,
        depth_l1_m=depth_l1_m,
        pictures=pictures,
    )


def views_in_words(split: WalkSplit) -> str:
    """How many views each group has, and how far they are from the nearest mapped one."""
    parts = [f"{len(split.sequence.mapping)} frames mapped"]
    for group, positions in split.views().items():
        if group != "mapped" and positions:
            degrees, metres = split.distance(positions)
            parts.append(
                f"{len(positions)} views {group}, on average {100 * metres:.0f} cm and "
                f"{degrees:.0f} degrees from the nearest mapped one"
            )
    return "; ".join(parts) + "."


def _in_words(way: WayScores) -> str:
    views = ", ".join(f"{psnr:.2f} dB {group}" for group, psnr in way.psnr_db.items())
    return f"{views}, {way.n_gaussians:,} Gaussians"


def as_records(scores: Sequence[WayScores]) -> dict[str, dict[str, float]]:
    """Label -> its numbers, means over the seeds: PSNR in dB and depth error in metres of each
    group of views, ``inflation_db`` and ``n_gaussians``. What is not known is missing."""
    records = {}
    for label in dict.fromkeys(way.label for way in scores):
        numbers = [way.numbers() for way in scores if way.label == label]
        names = dict.fromkeys(name for row in numbers for name in row)
        records[label] = {
            name: statistics.fmean(row[name] for row in numbers if name in row) for name in names
        }
    return records


def as_markdown(scores: Sequence[WayScores]) -> str:
    """``as_records`` as a table, a row for each way; depth in centimetres."""
    heads = [
        "map",
        *(f"{group}, dB" for group in GROUPS),
        "mapped - far, dB",
        *(f"depth {group}, cm" for group in GROUPS),
        "Gaussians",
    ]
    lines = [f"| {' | '.join(heads)} |", "|---|" + "---:|" * (len(heads) - 1)]
    for label, numbers in as_records(scores).items():
        depth_cm = {g: 100 * numbers.get(f"depth_l1_{g}_m", math.nan) for g in GROUPS}
        cells = [
            *(number_text(numbers.get(f"psnr_{group}_db", math.nan), ".2f") for group in GROUPS),
            number_text(numbers.get("inflation_db", math.nan), "+.2f"),
            *(number_text(depth_cm[group], ".1f") for group in GROUPS),
            number_text(numbers["n_gaussians"], ",.0f"),
        ]
        lines.append(f"| {' | '.join([plain_markdown(label), *cells])} |")
    return "\n".join(lines)


def as_csv(scores: Sequence[WayScores]) -> str:
    """A row for each way and seed, with its ``numbers``."""
    rows = [{"map": way.label, "seed": way.seed} | way.numbers() for way in scores]
    text = io.StringIO()
    columns = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def views_figure(split: WalkSplit, scores: Sequence[WayScores]) -> "Figure":
    """A mapped view and below it a far one: the photograph, then what each way shows there, with
    its PSNR; ``PICTURES_IN_A_ROW``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ways = list({way.label: way for way in reversed(scores)}.values())[::-1]
    views = split.views()
    blocks = []
    for group in ("mapped", "far"):
        positions = views[group]
        if not positions:
            continue
        (photograph,) = split.frames([positions[len(positions) // 2]])
        shown = [(f"{group} view {photograph.index}\nphotograph", photograph.rgb)]
        for way in ways:
            picture, psnr_db = way.pictures[group]
            shown.append((f"{way.label}\n{psnr_db:.1f} dB", picture))
        blocks.append(shown)
    columns = min(PICTURES_IN_A_ROW, 1 + len(ways))
    rows_of_block = math.ceil((1 + len(ways)) / columns)
    n_rows = rows_of_block * len(blocks)
    figure = Figure(
        figsize=(2.1 * columns, 2.0 * n_rows), dpi=100, facecolor="white", layout="constrained"
    )
    FigureCanvasAgg(figure)
    grid = figure.subplots(n_rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for i, shown in enumerate(blocks):
        cells = grid[i * rows_of_block : (i + 1) * rows_of_block].flat
        for axes, (title, picture) in zip(cells, shown, strict=False):
            axes.imshow(to_uint8(picture))
            axes.set_title(title, fontsize=9)
    return figure
