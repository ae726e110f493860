"""The files about runs: all settings and numbers, where they come from, tables, figures, the
page."""

import csv
import datetime
import io
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..drawing.curves import figure_picture
from ..drawing.page import fill
from ..drawing.pictures import data_uri
from ..errors import UnknownNameError
from ..files import atomic_file, plain_cell, write_file
from .equal_maps import EqualMaps, equal_maps
from .map_scene import budgeted
from .page import figure_of, page_html
from .paired_tests import (
    TESTS,
    Comparison,
    RankTest,
    against_reference,
    all_pairs,
    named_reference,
    rank_test,
)
from .program import package_fingerprint
from .run_all import ResultStore
from .scene_units import scene_units, shared_frames
from .schedule import flat_settings
from .spec import RunResult, RunSpec
from .statistics import (
    COLUMNS,
    Group,
    Summary,
    by_budget,
    group_runs,
    over_units,
    standings,
    summarise,
)
from .tables import ResultTable, all_tables, as_markdown, failures, markdown_sentence

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Table:
    """A comparison that can be run, and what its outputs say about it."""

    specs: list[RunSpec] = field(default_factory=list)
    """Its runs: by scene, budget, rule and seed."""
    text: str = ""
    """The file that describes it."""
    reference: str = ""
    """Label of the rule that all others are tested against; ``named_reference`` if empty."""
    tests: str = "reference"
    """What is tested: a name in ``TESTS``."""
    tuned_on: Mapping[str, str] = field(default_factory=dict)
    """Label of a rule -> the scenes that its values were chosen on, in words."""

    def __str__(self) -> str:
        counts = {
            "rule": len({s.label for s in self.specs}),
            "scene": len({s.scene for s in self.specs}),
            "seed": len({s.seed for s in self.specs}),
            "budget": len({s.budget for s in self.specs}),
        }
        words = " x ".join(f"{n} {name}{'s' if n > 1 else ''}" for name, n in counts.items())
        return f"{len(self.specs)} runs: {words}"


@dataclass(frozen=True, kw_only=True)
class Results:
    """Results of runs: tables, the best first, and the Pareto plot. A notebook displays them."""

    runs: Sequence[RunResult]
    """In any order; those that failed, too."""
    about: Table = field(default_factory=Table)
    """The comparison that they belong to."""
    store: ResultStore = field(default_factory=ResultStore)
    """Where the files of ``RunResult.pictures`` are."""

    @property
    def groups(self) -> list[Group]:
        """The runs of each rule, scene and budget, with means:
        ``group.summary("n_gaussians").mean``."""
        return group_runs(self.runs)

    def __getitem__(self, label: str) -> list[RunResult]:
        """All completed runs of a rule.

        Raises:
            KeyError: no run of this label.
        """
        own = [run for run in self.runs if run.spec.label == label]
        if not own:
            labels = ", ".join(dict.fromkeys(run.spec.label for run in self.runs))
            raise UnknownNameError(f"no rule {label!r}; there are: {labels}")
        return [run for run in own if run.status == "done"]

    @property
    def reference(self) -> str:
        """Label of the rule that all others are tested against."""
        return self.about.reference or named_reference(
            self.about.specs or [run.spec for run in self.runs]
        )

    def tested(self, budget: str) -> list[Comparison]:
        """The comparisons of two rules at a budget that ``about.tests`` asks for."""
        if self.about.tests == "pairs":
            return all_pairs(self.runs, budget)
        return (
            against_reference(self.runs, budget, self.reference)
            if self.about.tests == "reference"
            else []
        )

    def tables(self) -> list[ResultTable]:
        """For each budget the rules with the scenes as columns, and a table of each scene."""
        about = self.about
        return all_tables(
            self.runs, reference=self.reference, tests=about.tests, tuned_on=about.tuned_on
        )

    def figure(self) -> "Figure":
        """Held-out PSNR over each cost."""
        return figure_of(self.runs)

    def write(
        self,
        folder: str | Path,
        *,
        pictures: bool = True,
    ) -> list[Path]:
        """Write ``runs.csv``, ``table.md``, ``table.json``, ``page.html`` and the Pareto plot.

        Existing files are replaced, each completely or not at all; so it can be called again after
        every run.

        Args:
            folder: Where the files go.
            pictures: Write page and figure, too, which takes seconds with many runs.

        Returns:
            The files written.
        """
        folder = Path(folder)
        texts = {
            "runs.csv": as_csv(self.runs),
            "table.md": self._as_markdown(),
            "table.json": json.dumps(self.as_json(), indent=1, allow_nan=False),
        }
        if pictures:
            texts["page.html"] = page_html(
                self.store.folder, self.runs, self.tables(), self.warnings()
            )
        for name, text in texts.items():
            write_file(folder / name, text)
        figures = ("pareto.pdf", "pareto.png") if pictures else ()
        for name in figures:
            with atomic_file(folder / name) as temporary:
                self.figure().savefig(temporary, dpi=150)
        return [folder / name for name in (*texts, *figures)]

    def warnings(self) -> list[str]:
        """What makes rows or scenes fewer than they seem: rows with equal maps, scenes that share
        frames."""
        return [*map(str, equal_maps(self.runs)), *shared_frames(scene_units(self.runs))]

    def _as_markdown(self) -> str:
        """All tables, the comparisons with the reference, and the runs that failed."""
        parts = ["# Results", *map(as_markdown, self.tables())]
        if n_copies := sum(bool(r.copied_from) for r in self.runs):
            parts.append(
                f"{n_copies} of {len(self.runs)} runs were copied from the cache: copied_from in "
                "runs.csv."
            )
        if warnings := self.warnings():
            parts.append(
                "\n".join(
                    [
                        "### Rows or scenes that are the same",
                        "",
                        *(f"- {markdown_sentence(w)}" for w in warnings),
                    ]
                )
            )
        for budget in dict.fromkeys(str(r.spec.budget) for r in self.runs):
            sentences = [str(test) for test in self.tested(budget)]
            if self.about.tests == "nemenyi":
                sentences = rank_test(self.runs, budget).sentences
            if sentences:
                what = f"Tests: {TESTS[self.about.tests]}."
                if self.about.tests == "reference":
                    what += (
                        f" The reference is {markdown_sentence(self.reference)}, which does "
                        "not depend on the results."
                    )
                parts.append(
                    "\n".join(
                        [
                            f"### More than noise? {budget}",
                            "",
                            what,
                            "",
                            *(f"- {markdown_sentence(s)}" for s in sentences),
                        ]
                    )
                )
        if failure_texts := failures(self.runs):
            sentences = [
                f"{label}, {scene}, {budget}, seed {seed}: {why}"
                for label, scene, budget, seed, why in failure_texts
            ]
            lines = [f"- {markdown_sentence(sentence)}" for sentence in sentences]
            parts.append("\n".join(["### Runs that failed", "", *lines]))
        return "\n\n".join(parts) + "\n"

    def as_json(self) -> dict[str, Any]:
        """The numbers of the tables in their stored units, without rounding, as plain values, and
        where they come from.

        ``budgets`` has an entry for each budget, and its ``rows`` one for each rule, in the order
        of the table: ``metrics`` has for each number the mean over the scenes, their standard
        deviation and number, ``scenes`` the mean, standard deviation and number of the seeds on
        each scene, ``test`` the comparison with the reference, the rule minus the reference.
        ``pairs`` has all pairs where these are tested, ``ranks`` the tests of Friedman and Nemenyi.
        ``units`` are the scenes that are independent, as lists of those that share frames, and
        ``equal_maps`` the rows whose maps are equal.
        """
        complete_runs = [r for r in self.runs if r.status == "done"]
        return {
            "command": sys.argv,
            "written": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
            "package": package_fingerprint(),
            "versions": [
                dict(v) for v in {tuple(sorted(r.versions.items())) for r in complete_runs}
            ],
            "seeds": sorted({r.spec.seed for r in self.runs}),
            "table": self.about.text,
            "tuned_on": dict(self.about.tuned_on),
            "rules": {
                r.spec.label: {
                    "rule": r.spec.rule,
                    "source": r.rule_source,
                    "published_training": r.training,
                }
                for r in complete_runs
            },
            "budgets": [self._budget_json(groups) for groups in by_budget(self.groups)],
        }

    def _budget_json(self, groups: Sequence[Group]) -> dict[str, Any]:
        budget = groups[0].budget
        scenes = list(dict.fromkeys(g.scene for g in groups))
        units = scene_units(self.runs)
        comparisons = self.tested(budget)
        reference = self.reference
        against = {
            test.a: test
            for test in (c.towards(reference) for c in comparisons)
            if test.b == reference
        }
        rows = []
        for standing in standings(groups, units):
            own = {g.scene: g for g in groups if g.label == standing.label}
            means = {
                m: {name: s.mean for name, g in own.items() if (s := g.summary(m)).n}
                for m in COLUMNS
            }
            test = against.get(standing.label)
            rows.append(
                {
                    "rule": standing.label,
                    "rank": _number(standing.rank),
                    "metrics": {
                        m: _summary(summarise(over_units(of, units)))
                        for m, of in means.items()
                        if of
                    },
                    "scenes": {
                        scene: {m: _summary(s) for m in COLUMNS if (s := group.summary(m)).n}
                        for scene, group in own.items()
                    },
                    "failed": {
                        scene: group.failed[0].reason
                        for scene, group in own.items()
                        if group.failed
                    },
                    "test": None if test is None else _test_json(test),
                }
            )
        of_unit: dict[str, list[str]] = {}
        for scene in scenes:
            of_unit.setdefault(units[scene], []).append(scene)
        return {
            "budget": budget,
            "scenes": scenes,
            "units": list(of_unit.values()),
            "tests": self.about.tests,
            "reference": reference,
            "rows": rows,
            "pairs": [{"a": c.a, "b": c.b} | _test_json(c) for c in comparisons]
            if self.about.tests == "pairs"
            else [],
            "ranks": _ranks_json(rank_test(self.runs, budget))
            if self.about.tests == "nemenyi"
            else None,
            "equal_maps": [_equal_json(e) for e in equal_maps(self.runs) if e.budget == budget],
        }

    def __repr__(self) -> str:
        lines = [f"{label} did not run: {reason}" for label, _, _, _, reason in failures(self.runs)]
        return "\n\n".join([*map(as_markdown, self.tables()), *dict.fromkeys(lines)])

    def _repr_html_(self) -> str:
        picture = data_uri(figure_picture(self.figure()), "png")
        return fill(
            "live_table.html", tables=self.tables(), failures=failures(self.runs), picture=picture
        )


def as_csv(results: Sequence[RunResult]) -> str:
    """A table with a row for each run: what it was, its numbers, how it was tuned, hashes, and all
    settings.

    ``same_map_as`` has the labels of the rows that made the same map, and ``unit`` the scenes that
    count as one with that of the row.
    """
    units = scene_units(results)
    equal = equal_maps(results)
    rows = [
        {
            **_row(result),
            "same_map_as": _same_map_as(result, equal),
            "unit": units[result.spec.scene],
        }
        for result in results
    ]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, sorted(columns, key=_group), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _same_map_as(result: RunResult, equal: Sequence[EqualMaps]) -> str:
    """Labels of the other rows with the map of ``result``."""
    spec = result.spec
    own_map = (
        e for e in equal if e.budget == str(spec.budget) and (spec.scene, spec.seed) in e.places
    )
    return "; ".join(
        label
        for e in own_map
        if spec.label in e.labels
        for label in e.labels
        if label != spec.label
    )


def _test_json(test: Comparison) -> dict[str, Any]:
    return {
        "difference": _number(test.mean),
        "interval": [_number(v) for v in test.interval],
        "p": _number(test.p),
        "p_corrected": _number(test.corrected),
        "n": len(test.units),
        "verdict": test.verdict,
    }


def _ranks_json(test: RankTest) -> dict[str, Any]:
    pairs = [
        {"a": a, "b": b, "p": p, "better": (a, b) in test.better}
        for (a, b), p in test.pairs.items()
    ]
    ranks = dict(zip(test.labels, test.ranks, strict=True))
    values = {"p": _number(test.p), "n": test.n_units, "mean_ranks": ranks}
    return values | {"left_out": list(test.left_out), "pairs": pairs}


def _equal_json(equal: EqualMaps) -> dict[str, Any]:
    places = [{"scene": scene, "seed": seed} for scene, seed in equal.places]
    return {"rules": list(equal.labels), "places": places}


def _group(column: str) -> int:
    return ("", "metric", "tuned", "setting").index(
        column.partition(".")[0] if "." in column else ""
    )


def _cell(value: Any) -> Any:
    """Collections as JSON, text without formulas, numbers as they are."""
    if isinstance(value, (dict, list, tuple)):
        return json.dumps(value)
    return plain_cell(value) if isinstance(value, str) else value


def _row(result: RunResult) -> dict[str, Any]:
    spec = result.spec
    try:
        settings = flat_settings(budgeted(spec))
    except (ValueError, KeyError, TypeError):  # the settings are why it failed
        settings = {}
    return {
        "label": spec.label,
        "rule": spec.rule,
        "options": dict(spec.options),
        "scene": spec.scene,
        "data": spec.data,
        "reader": dict(spec.reader),
        "seed": spec.seed,
        "system": spec.system,
        "steps": spec.budget.steps,
        "budget_gaussians": spec.budget.gaussians,
        "budget_tolerance": spec.budget.tolerance,
        "status": result.status,
        "reason": result.reason,
        "notes": "; ".join(result.notes),
        "published_training": result.training,
        "key": result.key,
        "map_hash": result.map_hash,
        "data_hash": result.data_hash,
        "copied_from": result.copied_from,
        **{f"metric.{name}": value for name, value in result.metrics.items()},
        **{f"tuned.{name}": value for name, value in result.tuned.items()},
        **{f"setting.{name}": value for name, value in settings.items()},
    }


def _summary(summary: Summary) -> dict[str, Any]:
    return {"mean": _number(summary.mean), "sd": _number(summary.sd), "n": summary.n}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
