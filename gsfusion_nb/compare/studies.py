"""``gsfusion-nb study``: the comparisons of the papers, beside their numbers, and the questions
that this project asked itself."""

import dataclasses
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..backends import use_backend
from ..checks import check_name
from ..config.options import named
from ..errors import ArgumentError
from ..mapping import get_system, system_names
from . import error_study, roofline, view_study
from .command import run_and_write
from .recording_specs import (
    RecordingOptions,
    Values,
    labels_with,
    output_folder,
    ran_under,
    recording_specs,
)
from .run_result import RunResult
from .spec import RunSpec
from .statistics import Group, group_runs

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
"""Name on the command line -> study."""
OTHER_STUDIES = {
    "views": view_study.QUESTION,
    "errors": error_study.QUESTION,
    "roofline": "kernels and the limits of this machine",
}
"""Name -> question of the studies that have a module of their own."""


def study_names() -> list[str]:
    """Names of all studies, each with its question."""
    questions = {name: study.question for name, study in STUDIES.items()} | OTHER_STUDIES
    return [f"{name} ({question})" for name, question in questions.items()]


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
    system: str = named("", system_names)
    """Another system, by its name or as FILE.py:Name, which is executed. It is compared with those
    that the variants name; where they name none, it takes the place of the study's system."""


def study(options: StudyOptions) -> int:
    """Run ``gsfusion-nb study``. Returns the exit status.

    Raises:
        KeyError: no such study. ValueError: ``only`` leaves nothing, or the study takes no other
            system.
    """
    name = options.name
    check_name("study", name, (*OTHER_STUDIES, *STUDIES))
    if options.system and name not in STUDIES:
        raise ArgumentError(f"the study {name} takes no other system; leave out --system")
    folder = output_folder(options, f"study-{name}", options.data)
    if name == "roofline":
        folder.mkdir(parents=True, exist_ok=True)
        return roofline.main(options.device, folder)
    if name in ("views", "errors"):
        of_views = view_study if name == "views" else error_study
        with use_backend(options.backend):
            return of_views.main(options, options.data, folder, options.only)
    named_study = STUDIES[name]
    with use_backend(options.backend):
        specs = study_specs(name, options, options.data, options.only, options.system)
        print(f"{named_study.question}, on {options.data}\n{ran_under(specs)}")
        status, results = run_and_write(specs, folder, options)
        if named_study.paper:
            print(beside_paper(named_study, results))
    return status


def study_specs(
    name: str,
    options: RecordingOptions,
    data: str,
    only: str = "",
    system: str = "",
) -> list[RunSpec]:
    """All runs of a study, checked.

    Raises:
        ValueError, KeyError, TypeError: no variant whose name contains ``only``, or a setting that
            is refused.
    """
    named_study = STUDIES[name]
    labels = labels_with(only, named_study.variants, "variant")
    variants = {label: named_study.variants[label] for label in labels}
    common = named_study.common
    if system and any("system" in values for values in variants.values()):
        variants |= _variants_of(system, variants)
    elif system:
        common = {**common, "system": system}
    return recording_specs(variants, options, data, common=common, online=True)


def _variants_of(system: str, variants: Mapping[str, Values]) -> dict[str, Values]:
    """The variants of a study with another system in place of theirs, each once. They are called
    after its title and the values in which they differ."""
    title = get_system(system).description.title
    own: list[dict[str, Any]] = []
    for values in variants.values():
        others = {name: v for name, v in values.items() if name not in ("system", "fidelity")}
        if "system" in values and others not in own:
            own.append(others)
    differing_names = [name for name in own[0] if len({str(v.get(name)) for v in own}) > 1]
    return {
        ", ".join([title, *(str(values.get(name)) for name in differing_names)]): {
            "system": system,
            **values,
        }
        for values in own
    }


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
