"""``gsfusion-nb benchmark``: all scenes of a data set by its published protocol, beside the numbers
of the papers."""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..backends import use_backend
from ..config.options import named, named_values
from ..data.open import known_layouts
from ..data.recorded.files import missing
from ..errors import ArgumentError, SequenceError
from ..files import write_file
from ..mapping import SYSTEMS, get_system, system_names
from .command import run_and_write
from .data_sets import COLUMNS, DATA_SETS, DataSet, column_of, data_set_of
from .equal_maps import equal_maps, unknown_maps
from .paper_table import PaperRow, PaperTable
from .recording_specs import RecordingOptions, recording_specs
from .run_result import RunResult
from .scene_units import scene_units, shared_frames
from .schedule import flat_settings
from .spec import RunSpec
from .statistics import group_runs, over_units
from .tables import Cell

DEEPEST = 3
"""Scenes are looked for in so many levels of folders."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions(RecordingOptions):
    """Map all scenes of a data set by its published protocol, and write a table beside the numbers
    of the papers.

    Writes benchmark.md, benchmark.tex and the files of gsfusion-nb lab. After Ctrl-C the same
    command continues. Whatever --set changes in the protocol is named in the table."""

    name: Annotated[str, tyro.conf.Positional] = named(MISSING, lambda: DATA_SETS)
    """Which data set; or a TOML file with one of your own, or with rows of papers to add to one
    (docs/data_sets.md): FILE.toml or FILE.toml:NAME."""
    folder: Annotated[str, tyro.conf.Positional]
    """The folder with the scenes, or one scene."""
    systems: tuple[str, ...] = named(tuple(SYSTEMS), system_names)
    """Names of the mapping systems, also one in a file, which is executed: FILE.py:Name."""


def benchmark(options: BenchmarkOptions) -> int:
    """Run the command. Returns the exit status of ``run_and_write``.

    Raises:
        KeyError: no such data set or system. FileNotFoundError: the folder holds no scene of this
            data set.
        ValueError: a setting that does not exist, a value that is refused, or no scene that can be
            read.
    """
    data_set = data_set_of(options.name)
    name = Path(options.name.rpartition(".toml:")[2]).stem
    with use_backend(options.backend):
        specs, unread = benchmark_specs(data_set, options)
        folder = Path(options.out or f"runs/benchmark-{name}").expanduser()
        status, results = run_and_write(specs, folder, options)
        text = report(data_set, results, named_values(options.set), unread)
        write_file(folder / "benchmark.md", text)
        write_file(folder / "benchmark.tex", beside_papers(data_set, results).as_latex())
        print(text)
    return status


def scenes_in(folder: Path, format: str) -> dict[str, Path]:
    """Name -> folder of each scene of this layout in ``folder``, which may be a scene itself.

    Raises:
        FileNotFoundError: there is none; the message says what the layout looks for.
    """
    layout = known_layouts()[format]
    scenes = dict[str, Path]()
    for place, subfolders, _ in os.walk(folder, followlinks=True):
        relative = Path(place).relative_to(folder)
        if not missing(layout.locate(Path(place)), layout.looks_for):
            scenes["-".join(relative.parts) or folder.resolve().name] = Path(place)
            subfolders.clear()
        if len(relative.parts) == DEEPEST:
            subfolders.clear()
    if not scenes:
        sentence = (
            f"expected a folder with {', '.join(layout.looks_for)}, in it or up to "
            f"{DEEPEST} folders below"
        )
        raise FileNotFoundError(f"{folder} holds no scene in the layout {format}; {sentence}")
    return dict(sorted(scenes.items()))


def benchmark_specs(
    data_set: DataSet,
    options: BenchmarkOptions,
) -> tuple[list[RunSpec], list[str]]:
    """All runs, checked: scenes x systems x seeds; and a sentence about each scene that cannot be
    read.

    Raises:
        KeyError, FileNotFoundError, ValueError: as for ``benchmark``.
    """
    variants = {title: {"system": name} for name, title in titles_of(options.systems).items()}
    preset = dataclasses.replace(options, preset=options.preset or data_set.preset)
    reader: dict[str, Any] = {"format": data_set.format, **data_set.reader}
    specs = list[RunSpec]()
    unread = list[str]()
    for scene, place in scenes_in(Path(options.folder).expanduser(), data_set.format).items():
        fields = {"common": data_set.settings, "scene": scene, "online": True, "reader": reader}
        try:
            specs += recording_specs(variants, preset, str(place), **fields)
        except SequenceError as e:
            unread.append(f"{scene} cannot be read: {e}")
    if not specs:
        raise ArgumentError("\n".join(unread))
    return specs, unread


def titles_of(systems: Sequence[str]) -> dict[str, str]:
    """Name of a system, or "FILE.py:Name" -> what its row is called: its title, with its name where
    others have the same title.

    Raises:
        KeyError, TypeError, ValueError, FileNotFoundError: as for ``get_system``.
    """
    titles = {name: get_system(name).description.title for name in systems}
    same = [title for title in titles.values() if list(titles.values()).count(title) > 1]
    return {
        name: f"{title} ({name.rpartition(':')[2]})" if title in same else title
        for name, title in titles.items()
    }


def report(
    data_set: DataSet,
    results: Sequence[RunResult],
    changes: Mapping[str, Any],
    unread: Sequence[str] = (),
) -> str:
    """The table, our rows first, then the protocol, and under which conditions each of our numbers
    was measured.

    Args:
        asked: The data set.
        results: All runs; a row has the mean over the scenes of a system.
        changed: Settings that the user gave.
        unread: Sentences about scenes that cannot be read.
    """
    heads = ["system", *(heading for heading, *_ in COLUMNS.values()), "source"]
    rows = []
    cards = []
    units = scene_units(results)
    for label in dict.fromkeys(r.spec.label for r in results):
        own = [r for r in results if r.spec.label == label and r.status == "done"]
        if own:
            rows.append(
                [
                    f"**{label}, here**",
                    *_cells(_means(own, data_set.views, units)),
                    f"{_count(own, data_set)} scenes",
                ]
            )
            cards.append(_card(label, own, data_set, changes))
    rows += [[row["system"], *_cells(row["numbers"]), row["source"]] for row in data_set.published]
    scene_names = {r.spec.scene for r in results}
    absent = [name for name in data_set.scenes if not any(name in scene for scene in scene_names)]
    failure_lines = [
        f"{r.spec.label} failed on {r.spec.scene}: {r.reason}"
        for r in results
        if r.status == "failed"
    ]
    table = [
        f"| {' | '.join(row)} |" for row in (heads, ["---", *["---:"] * len(COLUMNS), "---"], *rows)
    ]
    seeming = [*map(str, equal_maps(results)), *unknown_maps(results), *shared_frames(units)]
    if absent:
        cards.append(f"scenes of the papers that are not here: {', '.join(absent)}")
    ran = (*cards, *seeming, *unread, *failure_lines)
    more = [line for paper_table in data_set.tables for line in _published_table(paper_table)]
    parts = [f"# {data_set.title}", "", *table, "", *_bullets("What ran here", ran)]
    parts += _bullets("The protocol of the papers", data_set.protocol)
    return "\n".join([*parts, *more])


def beside_papers(data_set: DataSet, results: Sequence[RunResult]) -> PaperTable:
    """The table for a paper: our means and the published numbers. None is bold, because no test
    compares numbers of others."""
    columns = tuple(column_of(name) for name in COLUMNS)
    units = scene_units(results)
    rows = []
    for label in dict.fromkeys(r.spec.label for r in results):
        own = [r for r in results if r.spec.label == label and r.status == "done"]
        if own:
            rows.append(("here", label, _means(own, data_set.views, units)))
    rows += [(row["source"], row["system"], row["numbers"]) for row in data_set.published]
    return PaperTable(
        title=data_set.title,
        columns=columns,
        rows=tuple(
            PaperRow(
                scene=source,
                label=label,
                cells=tuple(
                    Cell(text=c.text(v), value=c.shown(v))
                    for c, v in ((c, numbers.get(c.metric, math.nan)) for c in columns)
                ),
            )
            for source, label, numbers in rows
        ),
        notes=(*data_set.protocol, "what ran here, and how: benchmark.md"),
        first_heading="Source",
    )


def _bullets(title: str, sentences: Sequence[str]) -> list[str]:
    """The lines of a list under its heading; none without a sentence."""
    return [f"## {title}", "", *(f"- {s}" for s in sentences), ""] if sentences else []


def _published_table(paper_table: Mapping[str, Any]) -> list[str]:
    """The lines of a table of a paper."""
    rows = [["", *paper_table["columns"]], ["---", *["---:"] * len(paper_table["columns"])]]
    rows += [[name, *values] for name, values in paper_table["rows"].items()]
    return [f"## {paper_table['title']}", "", *(f"| {' | '.join(row)} |" for row in rows), ""]


def _means(
    own: Sequence[RunResult],
    views: str,
    units: Mapping[str, str],
) -> dict[str, float]:
    """Column -> mean over the scenes of the mean over the seeds; scenes of one unit count as
    one."""
    means_of_columns = {}
    for column, (_, _, metric, scale) in COLUMNS.items():
        summaries = {group.scene: group.summary(metric.format(views)) for group in group_runs(own)}
        means = over_units(
            {scene: s.mean for scene, s in summaries.items() if s.n},
            units,
        )
        if means:
            means_of_columns[column] = scale * sum(means) / len(means)
    return means_of_columns


def _cells(numbers: Mapping[str, float]) -> list[str]:
    return [
        format(numbers[column], form) if column in numbers else "–"
        for column, (_, form, *_) in COLUMNS.items()
    ]


def _count(own: Sequence[RunResult], data_set: DataSet) -> str:
    scenes = {r.spec.scene for r in own}
    n_scenes = sum(any(name in scene for scene in scenes) for name in data_set.scenes)
    return f"{n_scenes} of the {len(data_set.scenes)}, {len(scenes) - n_scenes} other"


def _card(
    label: str,
    own: Sequence[RunResult],
    data_set: DataSet,
    changes: Mapping[str, Any],
) -> str:
    """What a reader must know of our row, as it was: fidelity, frames, size, poses, passes, seeds,
    device, program, and what was changed."""
    spec = own[0].spec
    settings = flat_settings(spec.config())
    frames = sorted({round(r.metrics["n_frames"]) for r in own})
    several = f"{frames[0]:,}" if len(frames) == 1 else f"{frames[0]:,} to {frames[-1]:,}"
    sizes = sorted({r.image_size for r in own if r.image_size})
    passes = settings.get("optim.global_iterations", settings.get("final.passes"))
    seeds = len({r.spec.seed for r in own})
    programs = {r.versions["program"] for r in own if "program" in r.versions}
    parts = [
        _fidelity_words(spec),
        f"{several} frames mapped a scene" + (f" at {' and '.join(sizes)}" if sizes else ""),
        f"poses {settings['tracking.poses']}",
        *([] if passes is None else [f"{passes} passes over the keyframes after the scan"]),
        f"scores of {data_set.views.replace('_', '-')} views",
        f"{seeds} seed{'s' if seeds > 1 else ''}",
        *(f"{kind} {code['name']}" for kind, code in spec.training.items()),
        f"on {spec.device}",
        *sorted(programs),
    ]
    words = f"{label}: {', '.join(parts)}"
    if not changes:
        return words
    return f"{words}; changed: {', '.join(f'{name}={value}' for name, value in changes.items())}"


def _fidelity_words(spec: RunSpec) -> str:
    """Which settings a run has: a published fidelity, or this package's own."""
    description = spec.found_system().description
    fidelity = description.fidelity_of(spec.config())
    if not description.fidelities:
        return "its only settings"
    if fidelity.partition(",")[0] == description.fidelities[0]:
        return f'fidelity "{fidelity}" (settings of this package, not of the paper)'
    return f'fidelity "{fidelity}"'
