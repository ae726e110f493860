"""What a reader must know about a table of the lab: seeds, failures, tests, and what was not
equal."""

from collections.abc import Sequence

from .equal_maps import equal_maps, unknown_maps
from .paired_tests import TESTS, Comparison
from .statistics import Group

OTHERWISE = "†"
"""Mark of a row whose publication trains the Gaussians otherwise."""


def note_on_tests(reference: str, tests: str, comparisons: Sequence[Comparison]) -> str:
    """What was tested, and what the tests needed to be told before."""
    if tests == "reference" and not comparisons:
        return (
            f"nothing is tested: the reference {reference} has no completed run, or no other "
            "rule has one"
        )
    rule = (
        f"; the reference is {reference}, which does not depend on the results"
        if tests != "nemenyi"
        else ""
    )
    return f"tests: {TESTS[tests]}{rule}"


def trained_otherwise(groups: Sequence[Group]) -> dict[str, str]:
    """Label of a rule -> how its publication trains the Gaussians, of the rules of which that is
    not as here."""
    return {run.spec.label: run.training for group in groups for run in group.runs if run.training}


def notes_on_table(groups: Sequence[Group]) -> list[str]:
    """What a reader must know about the runs of one table: seeds, failures, and what was not
    equal."""
    runs = [run for group in groups for run in group.runs]
    if not runs:
        return ["no run was completed"]
    most = max(len(g.runs) + len(g.failed) for g in groups)
    notes = [
        note_on_seeds(groups),
        *(f"{g.label}: {len(g.runs)} of {most} runs" for g in groups if len(g.runs) < most),
    ]
    budget = runs[0].spec.budget
    parts = []
    for metric, noun, own in (
        ("n_gaussians", "Gaussians", budget.gaussians is None),
        ("n_steps", "gradient steps", budget.steps == "own"),
    ):
        means = [s.mean for s in (g.summary(metric) for g in groups) if s.n]
        if own and means and max(means) > min(means):
            parts.append(f"{min(means):,.0f} to {max(means):,.0f} {noun}")
    if parts:
        notes.append(
            f"not equal between the rules: {' and '.join(parts)}; quality also depends on these"
        )
    notes += notes_on_rows(groups)
    return list(
        dict.fromkeys(
            [*notes, *(f"{run.spec.label}: {note}" for run in runs for note in run.notes)]
        )
    )


def notes_on_rows(groups: Sequence[Group]) -> list[str]:
    """Which rows have equal maps, and which are not trained as their publication trains them."""
    runs = [run for group in groups for run in group.runs]
    notes = [*map(str, equal_maps(runs)), *unknown_maps(runs)]
    if trainings := trained_otherwise(groups):
        rows = "; ".join(f"{label} ({training})" for label, training in trainings.items())
        notes.append(
            f"{OTHERWISE} the publication trains the Gaussians otherwise than here, so the row is "
            f"about this rule, and not about that system: {rows}"
        )
    return notes


def note_on_seeds(groups: Sequence[Group]) -> str:
    """What ± means within a scene, or that one seed has none."""
    seeds = len({run.spec.seed for group in groups for run in group.runs})
    if seeds < 2:
        return "one seed: no standard deviation within a scene"
    return (
        f"± within a scene: standard deviation over {seeds} seeds, which change only random draws"
    )
