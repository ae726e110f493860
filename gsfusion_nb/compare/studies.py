"""Runs on one recording: all combinations of some values (``sweep``), and named comparisons
(``study``).

The named comparisons are those of the papers, beside their numbers, and the questions that this
project asked itself.
"""

import dataclasses
import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..backends import use_backend
from ..checks import check_name, check_whole, shown
from ..config import presets
from ..config.options import named, named_values, parse_value
from ..errors import ArgumentError
from ..mapping import SYSTEMS, get_system
from ..seeding import check_options
from ..seeding.rule_code import is_rule_file, read_rule_file, rule_folder
from . import roofline
from .command import WhereOptions, run_and_write
from .map_scene import Entry
from .spec import Budget, RunResult, RunSpec
from .statistics import Group, group_runs

Values = Mapping[str, Any]
"""Name -> value: "system", "fidelity", "seeding.rule", an option of the rule as "rule.<name>", or a
setting."""
Row = Mapping[str, float | int]
"""Column -> value."""


@dataclass(frozen=True)
class PaperTable:
    """An ablation of the paper of GSFusion (Wei & Leutenegger 2024) as it is printed there."""

    number: str
    title: str
    data: str
    rows: Mapping[str, Row]
    """Setting -> column -> value, in the paper's order."""


@dataclass(frozen=True)
class Study:
    """Runs that differ in one respect, and the question that they answer."""

    question: str
    variants: Mapping[str, Values]
    """Label -> what is set."""
    common: Values = dataclasses.field(default_factory=dict)
    """What is set in all variants."""
    paper: PaperTable | None = None
    """The table that is printed beside our numbers."""
    views: str = "held_out"
    """Views that this table scores: held_out or mapped."""
    about: str = ""
    """A sentence under the table."""


def read_packaged(path: Path) -> dict[str, Any]:
    """Values of a TOML file of this package; the text "None" stands for no value, which TOML
    lacks."""
    return _with_none(tomllib.loads(path.read_text(encoding="utf-8")))


def _with_none(values: Any) -> Any:
    if isinstance(values, dict):
        return {name: _with_none(value) for name, value in values.items()}
    return None if values == "None" else values


def _read_studies() -> Iterator[tuple[str, Study]]:
    for name, study in read_packaged(Path(__file__).with_suffix(".toml")).items():
        paper = PaperTable(**study["paper"]) if "paper" in study else None
        yield name, Study(**study | {"paper": paper})


STUDIES = dict(_read_studies())
"""Name on the command line -> study. "roofline" has a module of its own."""


def study_names() -> list[str]:
    """Names of all studies, each with its question."""
    return [f"{name} ({study.question})" for name, study in STUDIES.items()] + [
        "roofline (kernels and the limits of this machine)"
    ]


RULE = "seeding.rule"
OPTION = "rule."
"""The setting whose values are rules, and the beginning of the names of a rule's options."""


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(WhereOptions):
    """What is mapped."""

    set: tuple[str, ...] = ()
    """Settings of all runs: --set data.width=320 data.height=240 seeding.rule=uniform
    rule.fraction=0.1."""
    seeds: int = 1
    """Number of seeds: 0, 1, and so on."""
    preset: str = named("", presets)
    """Settings for a data set. Where none is given: room for the built-in scene, otherwise
    replica."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: n_frames=60 (room)."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions(RecordingOptions):
    """Map one recording with every combination of some values, with several seeds, and write a
    table.

    All values are checked before anything runs. After Ctrl-C the same command continues."""

    data: Annotated[str, tyro.conf.Positional] = "room"
    """Folder of a recording, or "room" for the built-in scene."""
    grid: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["-g"]), tyro.conf.UseAppendAction] = ()
    """Values of a setting: --grid tsdf.voxel-size-m=0.01,0.02; of an option of the rule: --grid
    rule.fraction=0.1,0.2; rules: --grid seeding.rule=gsfusion,my_rules.py:mine. Repeat it for
    several settings."""
    system: str = named("gsfusion", lambda: SYSTEMS)
    """Name of the mapping system."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions(RecordingOptions):
    """Run a named comparison on one recording and print a table.

    A variant that was run before, by any command, is taken from the cache."""

    name: Annotated[str, tyro.conf.Positional] = named(MISSING, study_names)
    """What to compare. The ablations of GSFusion's paper run with its settings (fidelity "paper"),
    of which one is changed as it does."""
    data: Annotated[str, tyro.conf.Positional] = "room"
    """Folder of a sequence, or "room" for the built-in scene."""
    only: str = ""
    """Only the variants whose name contains this text, in capital or small letters: --only given.
    Default: all."""
    device: str = "cpu"
    """Only for roofline: the device to measure, cpu or cuda."""


def sweep(options: SweepOptions) -> int:
    """Run ``gsfusion-nb sweep``. Returns the exit status.

    Raises:
        ValueError, KeyError, TypeError: a setting that does not exist, or a value that is refused.
    """
    with use_backend(options.backend):
        specs = sweep_specs(options)
        print(f"{len(specs)} runs, on {options.data}")
        return run_and_write(specs, _folder(options, "sweep", options.data), options)[0]


def study(options: StudyOptions) -> int:
    """Run ``gsfusion-nb study``. Returns the exit status.

    Raises:
        KeyError: no such study. ValueError: ``only`` leaves nothing.
    """
    name = options.name
    check_name("study", name, ("roofline", *STUDIES))
    folder = _folder(options, f"study-{name}", options.data)
    if name == "roofline":
        folder.mkdir(parents=True, exist_ok=True)
        return roofline.main(options.device, folder)
    named_study = STUDIES[name]
    with use_backend(options.backend):
        specs = study_specs(name, options, options.data, options.only)
        print(f"{named_study.question}, on {options.data}\n{ran_under(specs)}")
        status, results = run_and_write(specs, folder, options)
        if named_study.paper:
            print(beside_paper(named_study, results))
    return status


def _folder(options: RecordingOptions, name: str, data: str) -> Path:
    return Path(options.out or f"runs/{name}-{Path(data).name}").expanduser()


def sweep_specs(options: SweepOptions) -> list[RunSpec]:
    """All runs of a sweep, checked.

    Raises:
        ValueError, KeyError, TypeError: as for ``sweep``.
    """
    if not options.grid:
        raise ArgumentError("expected --grid NAME=VALUE,VALUE")
    axes = dict(parse_axis(text) for text in options.grid)
    if len(axes) < len(options.grid):
        raise ArgumentError(f"expected each setting once, got {', '.join(options.grid)}")
    variants = {}
    for values in itertools.product(*axes.values()):
        pairs = dict(zip(axes, values, strict=True))
        label = ", ".join(
            str(v) if n == RULE else f"{n.rpartition('.')[2]} {v}" for n, v in pairs.items()
        )
        variants[label] = {"system": options.system, **pairs}
    return recording_specs(variants, options, options.data)


def study_specs(
    name: str,
    options: RecordingOptions,
    data: str,
    only: str = "",
) -> list[RunSpec]:
    """All runs of a study, checked.

    Raises:
        ValueError, KeyError, TypeError: no variant whose name contains ``only``, or a setting that
            is refused.
    """
    named_study = STUDIES[name]
    variants = {
        label: values
        for label, values in named_study.variants.items()
        if only.lower() in label.lower()
    }
    if not variants:
        raise ArgumentError(
            f"--only: no variant's name contains {only!r}; "
            f"there are {', '.join(named_study.variants)}"
        )
    return recording_specs(variants, options, data, common=named_study.common, online=True)


def recording_specs(
    variants: Mapping[str, Values],
    options: RecordingOptions,
    data: str,
    *,
    common: Values | None = None,
    **fields: Any,
) -> list[RunSpec]:
    """A run of each variant and seed on one recording, checked.

    Args:
        variants: Label -> what is set.
        options: What was asked for; its settings and options of the reader are set in all runs.
        data: Folder of the recording, or "room".
        common: What else is set in all runs, unless ``options`` sets it.
        fields: Other fields of ``RunSpec``.

    Raises:
        ValueError, KeyError, TypeError: a setting that does not exist, or a value that is refused.
    """
    check_whole("seeds", options.seeds, 1)
    place = data if data == "room" else str(Path(data).expanduser().resolve())
    shared = {**(common or {}), **named_values(options.set)}
    reader = named_values(options.reader)
    fields = {"scene": Path(data).name, "data": place, "preset": options.preset} | fields
    fields["reader"] = {**fields.get("reader", {}), **reader}
    specs = [spec_with({**shared, **values}, label, **fields) for label, values in variants.items()]
    for spec in specs:
        spec.config()
        check_options(spec.found_rule(), spec.options)
    Entry(spec=specs[0]).opened()
    specs = [spec.with_code(spec.found_rule()) for spec in specs]
    return [dataclasses.replace(spec, seed=seed) for spec in specs for seed in range(options.seeds)]


def ran_under(specs: Sequence[RunSpec]) -> str:
    """What all runs have in common, in a sentence: system, preset, fidelity, settings, options of
    rule and reader.

    Args:
        specs: At least one run.
    """
    first, *others = map(_values_of, specs)
    shared = {
        name: value
        for name, value in first.items()
        if all((name, value) in o.items() for o in others)
    }
    return f"All runs have {', '.join(f'{name} {value}' for name, value in shared.items())}."


def _values_of(spec: RunSpec) -> dict[str, Any]:
    """Everything that a run sets, by name; a setting that nobody named is that of the preset and
    the fidelity."""
    fidelity = spec.fidelity or next(iter(get_system(spec.system).description.fidelities), "")
    names = {"system": spec.system, "preset": spec.preset} | (
        {"fidelity": fidelity} if fidelity else {}
    )
    options = {f"{OPTION}{name}": value for name, value in spec.options.items()}
    reader = {f"reader {name}": value for name, value in spec.reader.items()}
    return names | dict(spec.settings) | options | reader


def spec_with(values: Values, label: str, **fields: Any) -> RunSpec:
    """A run with some values set; its rule and the options of the rule are those of its system
    otherwise.

    Args:
        values: What is set.
        label: Name in tables.
        fields: Other fields of ``RunSpec``.

    Raises:
        ValueError: the file of a rule cannot be read. FileNotFoundError: it does not exist.
    """
    values = dict(values)
    system = values.pop("system", "gsfusion")
    fidelity = values.pop("fidelity", "")
    base = RunSpec(
        rule=system,
        label=label,
        system=system,
        fidelity=fidelity,
        budget=Budget(steps="own"),
        **fields,
    )
    own = (
        get_system(system)
        .preset(base.preset, **({"fidelity": fidelity} if fidelity else {}))
        .seeding
    )
    rule = values.pop(RULE, own.rule)
    options = dict(own.options) if rule == own.rule else {}
    options |= {
        name.removeprefix(OPTION): v for name, v in values.items() if name.startswith(OPTION)
    }
    settings = {name: v for name, v in values.items() if not name.startswith(OPTION)}
    source = read_rule_file(rule)[0] if is_rule_file(rule) else ""
    folder = str(rule_folder(rule)) if source else ""
    return dataclasses.replace(
        base, rule=rule, options=options, settings=settings, rule_source=source, rule_folder=folder
    )


def parse_axis(text: str) -> tuple[str, list[Any]]:
    """Name and values of ``NAME=VALUE,VALUE,...``: numbers, true, false, or words.

    Raises:
        ValueError: no name, no value, or a value twice.
    """
    name, equals, values = text.partition("=")
    axis = [parse_value(v.strip()) for v in values.split(",") if v.strip()]
    if not equals or not name or not axis:
        raise ArgumentError(f"expected values of a setting as NAME=VALUE,VALUE, got {shown(text)}")
    if len({str(v) for v in axis}) < len(axis):
        raise ArgumentError(f"expected values that differ, got {shown(text)}")
    return name.strip().replace("-", "_"), axis


def beside_paper(named_study: Study, results: Sequence[RunResult]) -> str:
    """Our numbers, means over the seeds, with the paper's in brackets."""
    groups = {g.label: g for g in group_runs(results)}
    conditions = ran_under([result.spec for result in results]) if results else ""
    rows = {
        label: groups[label]
        for label in named_study.variants
        if label in groups and groups[label].runs
    }
    ours = {
        label: _in_the_papers_columns(group, named_study.views) for label, group in rows.items()
    }
    assert named_study.paper is not None
    text = (
        f"{PaperComparison(named_study.paper.number, ours)!r}\n(in brackets: the paper's numbers)"
    )
    return "\n".join(filter(None, (named_study.question, text, conditions, named_study.about)))


def _in_the_papers_columns(group: Group, views: str) -> dict[str, float]:
    """Our numbers under the headings of the paper."""
    names = {
        "PSNR": f"psnr_{views}_db",
        "SSIM": f"ssim_{views}",
        "MB": "model_size_mb",
        "global s": "seconds_global",
        "keyframes": "n_keyframes",
        "Gaussians": "n_gaussians",
    }
    values = {
        name: group.summary(metric).mean
        for name, metric in names.items()
        if group.summary(metric).n
    }
    ms = group.summary("ms_per_frame")
    return values | ({"FPS": 1e3 / ms.mean} if ms.n else {})


_FORMATS = {
    "PSNR": ".2f",
    "SSIM": ".3f",
    "FPS": ".1f",
    "MB": ".1f",
    "global s": ".1f",
    "keyframes": ",.0f",
}


class PaperComparison:
    """An ablation of the paper and your own runs, row by row.

    Args:
        number: "IV" to "VIII".
        ours: Setting -> column -> value; only the paper's columns, and "Gaussians", are shown.
            Settings that the paper does not have are shown with ours alone. Settings that begin
            with a number are sorted by it.

    Raises:
        KeyError: the paper has no such ablation.
    """

    def __init__(self, number: str, ours: Mapping[str, Row]):
        tables = {study.paper.number: study.paper for study in STUDIES.values() if study.paper}
        check_name("ablation table", number, tables)
        self.paper = tables[number]
        self.ours = dict(ours)
        self.columns = list(dict.fromkeys(c for row in self.paper.rows.values() for c in row))
        if any("Gaussians" in row for row in self.ours.values()):
            self.columns.append("Gaussians")

    @property
    def title(self) -> str:
        """One line above the table."""
        return (
            f"Table {self.paper.number}, {self.paper.title}: here (in the paper on "
            f"{self.paper.data})"
        )

    def lines(self) -> list[list[str]]:
        """Cells, the headings first: ours, and the paper's in brackets."""
        settings = _in_order(list(dict.fromkeys([*self.paper.rows, *self.ours])))
        rows = [[self.paper.title, *self.columns]]
        for setting in settings:
            mine = self.ours.get(setting, {})
            theirs = self.paper.rows.get(setting, {})
            rows.append([setting, *(_cell(c, mine, theirs) for c in self.columns)])
        return rows

    def __repr__(self) -> str:
        rows = self.lines()
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        text = []
        for row in rows:
            sides = ["<", *">" * (len(row) - 1)]
            text.append(
                "  ".join(f"{c:{side}{w}}" for c, side, w in zip(row, sides, widths, strict=True))
            )
        return "\n".join([self.title, *text])


def _in_order(settings: list[str]) -> list[str]:
    """Sorted by the number that each begins with; in the given order if one has none."""
    try:
        return sorted(settings, key=lambda setting: float(setting.split()[0]))
    except ValueError:
        return settings


def _cell(column: str, mine: Row, theirs: Row) -> str:
    form = _FORMATS.get(column, ",.0f")
    own = format(mine[column], form) if column in mine else "-"
    return f"{own} ({theirs[column]:{form}})" if column in theirs else own
