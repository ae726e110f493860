"""A comparison and its results: tables, figures and the files about its runs."""

import datetime
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..drawing.curves import figure_picture
from ..drawing.encoding import data_uri
from ..drawing.page import fill
from ..errors import UnknownNameError
from ..files import atomic_file, write_file
from .equal_maps import equal_maps
from .markdown import as_markdown, markdown_sentence
from .page import figure_of, page_html
from .paired_tests import TESTS, Comparison, against_reference, all_pairs, named_reference
from .paper_table import PaperTable, paper_tables
from .paper_table import as_csv as papers_csv
from .program import package_fingerprint
from .rank_test import rank_test
from .results_json import budget_json
from .run_all import ResultStore
from .run_result import RunResult
from .runs_csv import as_csv
from .scene_units import scene_units, shared_frames
from .spec import RunSpec
from .statistics import Group, by_budget, group_runs
from .tables import ResultTable, all_tables, failures

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

    def paper_tables(self, views: str = "") -> list[PaperTable]:
        """For each budget a table as papers print it, with a row of each scene and rule:
        ``table.as_latex()``. ``views``: those that are scored, held_out or mapped."""
        about = self.about
        return paper_tables(self.runs, reference=self.reference, tests=about.tests, views=views)

    def figure(self) -> "Figure":
        """Held-out PSNR over each cost."""
        return figure_of(self.runs)

    def write(
        self,
        folder: str | Path,
        *,
        pictures: bool = True,
    ) -> list[Path]:
        """Write ``runs.csv``, ``table.md``, ``table.json``, ``paper.tex``, ``paper.csv``,
        ``paper.md``, ``page.html`` and the Pareto plot.

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
        papers = self.paper_tables()
        texts |= {
            "paper.tex": "\n".join(table.as_latex() for table in papers),
            "paper.csv": papers_csv(papers),
            "paper.md": "\n".join(table.as_markdown() for table in papers),
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
            "budgets": [
                budget_json(
                    self.runs,
                    groups,
                    self.tested(groups[0].budget),
                    tests=self.about.tests,
                    reference=self.reference,
                )
                for groups in by_budget(self.groups)
            ],
        }

    def __repr__(self) -> str:
        lines = [f"{label} did not run: {reason}" for label, _, _, _, reason in failures(self.runs)]
        return "\n\n".join([*map(as_markdown, self.tables()), *dict.fromkeys(lines)])

    def _repr_html_(self) -> str:
        picture = data_uri(figure_picture(self.figure()), "graph")
        return fill(
            "live_table.html", tables=self.tables(), failures=failures(self.runs), picture=picture
        )
