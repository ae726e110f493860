"""``gsfusion-nb benchmark``: all scenes of a data set by its published protocol, beside the numbers
of the papers."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..backends import use_backend
from ..checks import check_name
from ..config.options import named, named_values
from ..data.open import known_layouts
from ..data.recorded.files import missing
from ..errors import ArgumentError, SequenceError
from ..files import write_file
from ..mapping import SYSTEMS, get_system, system_names
from .command import run_and_write
from .equal_maps import equal_maps, unknown_maps
from .recording_specs import RecordingOptions, recording_specs
from .run_result import RunResult
from .scene_units import scene_units, shared_frames
from .schedule import flat_settings
from .spec import RunSpec
from .statistics import group_runs, over_units
from .studies import read_packaged

DEEPEST = 3
"""Scenes are looked for in so many levels of folders."""
COLUMNS = {
    "psnr": ("PSNR, dB", ".2f", "psnr_{}_db", 1),
    "ssim": ("SSIM", ".3f", "ssim_{}", 1),
    "lpips": ("LPIPS", ".3f", "lpips_{}", 1),
    "ate": ("ATE RMSE, cm", ".2f", "ate_rmse_m", 100),
    "fps": ("frames/s", ".2f", "fps_mean_inverse", 1),
    "mb": ("MB", ".1f", "model_size_mb", 1),
    "memory": ("memory, MB", ".0f", "peak_memory_mb", 1),
}
"""Column -> heading, format, our metric with {} for the group of views, and factor to the unit
shown."""


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """How a data set is measured."""

    title: str
    format: str
    """Name of its reader."""
    preset: str
    views: str
    """Views that are scored: mapped or held_out."""
    scenes: Sequence[str]
    """Names of the folders of the scenes that papers report."""
    settings: Mapping[str, Any]
    """Settings of all runs."""
    protocol: Sequence[str]
    """Sentences: which frames are mapped, which are scored, and what cannot be compared."""
    reader: Mapping[str, Any] = field(default_factory=dict)
    published: Sequence[Mapping[str, Any]] = ()
    """Rows of papers, means over the scenes: system, source (paper and table), numbers (column ->
    value)."""
    tables: Sequence[Mapping[str, Any]] = ()
    """Tables of papers with other columns, or of other data: title, columns, and rows (name ->
    values as text)."""


DATA_SETS = {
    name: DataSet(**values)
    for name, values in read_packaged(Path(__file__).with_suffix(".toml")).items()
}


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions(RecordingOptions):
    """Map all scenes of a data set by its published protocol, and write a table beside the numbers
    of the papers.

    Writes benchmark.md and the files of gsfusion-nb lab. After Ctrl-C the same command continues.
    Whatever --set changes in the protocol is named in the table."""

    name: Annotated[str, tyro.conf.Positional] = named(MISSING, lambda: DATA_SETS)
    """Which data set."""
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
    check_name("data set", options.name, DATA_SETS)
    data_set = DATA_SETS[options.name]
    with use_backend(options.backend):
        specs, unread = benchmark_specs(data_set, options)
        folder = Path(options.out or f"runs/benchmark-{options.name}").expanduser()
        status, results = run_and_write(specs, folder, options)
        text = report(data_set, results, named_values(options.set), unread)
        write_file(folder / "benchmark.md", text)
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
    sentences = [
        *data_set.protocol,
        *([f"Scenes of the papers that are not here: {', '.join(absent)}."] if absent else []),
    ]
    failure_lines = [
        f"{r.spec.label} failed on {r.spec.scene}: {r.reason}"
        for r in results
        if r.status == "failed"
    ]
    table = [
        f"| {' | '.join(row)} |" for row in (heads, ["---", *["---:"] * len(COLUMNS), "---"], *rows)
    ]
    seeming = [*map(str, equal_maps(results)), *unknown_maps(results), *shared_frames(units)]
    bullets = [
        f"- {sentence}" for sentence in (*sentences, *cards, *seeming, *unread, *failure_lines)
    ]
    more = [line for paper_table in data_set.tables for line in _published_table(paper_table)]
    return "\n".join([f"# {data_set.title}", "", *table, "", *bullets, "", *more])


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
    """What a reader must know of our row: frames, size, poses, passes, seeds, and what was
    changed."""
    settings = flat_settings(own[0].spec.config())
    frames = sorted({round(r.metrics["n_frames"]) for r in own})
    several = f"{frames[0]:,}" if len(frames) == 1 else f"{frames[0]:,} to {frames[-1]:,}"
    passes = settings.get("optim.global_iterations", settings.get("final.passes"))
    seeds = len({r.spec.seed for r in own})
    words = (
        f"{label}: {several} frames mapped a scene, poses {settings['tracking.poses']}, "
        f"{passes} passes over the "
    )
    views = data_set.views.replace("_", "-")
    words += f"keyframes after the scan, scores of {views} views, {seeds} seed"
    words += "s" if seeds > 1 else ""
    return (
        f"{words}; changed: {', '.join(f'{k}={v}' for k, v in changes.items())}"
        if changes
        else words
    )
