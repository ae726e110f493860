"""The tables: what is bold, what is said under them, and that special characters are harmless."""

import dataclasses

import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.map_scene import Entry
from gsfusion_nb.compare.markdown import as_markdown
from gsfusion_nb.compare.one_run import _training
from gsfusion_nb.compare.outputs import Results
from gsfusion_nb.compare.statistics import group_runs
from gsfusion_nb.compare.tables import all_tables, failures, scene_table


@pytest.fixture(scope="module")
def equal(made_run):
    budget = Budget(gaussians=4000)
    runs = [
        made_run(
            "a_b",
            seed=s,
            psnr=24.0 + 0.1 * s,
            budget=budget,
            n_gaussians=4000.0 + s,
        )
        for s in range(3)
    ]
    runs += [
        made_run(
            "c|d",
            seed=s,
            psnr=25.0,
            budget=budget,
            n_gaussians=4100.0,
            notes=["the mesh was not scored"],
        )
        for s in range(3)
    ]
    runs += [
        made_run("lost", seed=s, budget=budget, failed="ValueError: 100 % wrong") for s in range(3)
    ]
    return runs


def test_markdown(equal):
    text = as_markdown(scene_table(group_runs(equal)))
    lines = text.splitlines()
    assert lines[0] == "### room, 4,000 Gaussians, equal steps"
    assert lines[2] == "| rule | PSNR held out, dB | PSNR mapped, dB | Gaussians | Gradient steps |"
    assert lines[4] == r"| c\|d | **25.00 ± 0.00** | **27.00 ± 0.00** | 4,100 ± 0 | 200 ± 0 |"
    assert lines[5] == r"| a\_b | 24.10 ± 0.10 | 26.10 ± 0.10 | 4,001 ± 1 | 200 ± 0 |"
    assert lines[6] == "| lost | – | – | – | – |"
    assert (
        "- ± within a scene: standard deviation over 3 seeds, which change only random draws"
        in lines
    )
    assert "- lost: 0 of 3 runs" in lines
    assert r"- c\|d: the mesh was not scored" in lines
    assert failures(equal)[0] == (
        "lost",
        "room",
        "4,000 Gaussians, equal steps",
        0,
        "ValueError: 100 % wrong",
    )


def test_at_own_budgets_the_table_says_what_differs(made_run):
    own = Budget(steps="own")
    runs = [made_run("a", seed=s, n_gaussians=1000.0, n_steps=100.0, budget=own) for s in range(2)]
    runs += [made_run("b", seed=s, n_gaussians=4000.0, budget=own) for s in range(2)]
    table = scene_table(group_runs(runs))
    assert table.notes[1] == (
        "not equal between the rules: 1,000 to 4,000 Gaussians and 100 to 200 gradient steps; "
        "quality also depends on these"
    )
    cells = dict(
        zip(
            (c.metric for c in table.columns),
            table.rows[0].cells,
            strict=True,
        )
    )
    assert cells["psnr_held_out_db"].text == "24.00 ± 0.00"
    assert [row.cells[2].best for row in table.rows] == [
        True,
        False,
    ]  # fewer Gaussians are better where they are free


def test_the_scenes_as_columns(made_run):
    lead = {"room": 1.0, "hall": 1.2, "kitchen": 0.9, "attic": 1.1}
    runs = [made_run(n, s, psnr=20 + d * (n == "a")) for s, d in lead.items() for n in ("b", "a")]
    runs += [made_run("near", s, psnr=21.0 + 0.3 * (-1) ** i) for i, s in enumerate(lead)] + [
        made_run("c", "hall")
    ]
    table = all_tables(runs, reference="a", tuned_on={"a": "room"})[0]
    names = [c.name for c in table.columns]
    assert names == [
        *(f"{s}, dB" for s in lead),
        "Mean, dB",
        "Mean rank",
        "Rule minus reference, dB",
        "p",
    ]
    assert [(row.label, row.cells[4].text, row.cells[4].best) for row in table.rows] == [
        ("a", "21.05", True),
        ("near", "21.00", False),
        ("b", "20.00", False),
        ("c", "–", False),
    ]
    assert [row.cells[6].text for row in table.rows[:3]] == [
        "–",
        "-0.05 (-0.79 to 0.69)",
        "-1.05 (-1.26 to -0.84)",
    ]
    assert "a was tuned on: room" in table.notes
    assert any(note.startswith("one seed") for note in table.notes)
    by_b = all_tables(runs)[0]  # the first of the comparison, whatever the results are
    assert by_b.rows[0].cells[6].text == "1.05 (0.84 to 1.26)"
    assert any(
        note.endswith("the reference is b, which does not depend on the results")
        for note in by_b.notes
    )
    in_pairs = all_tables(runs, reference="a", tests="pairs")[0]
    assert in_pairs.rows[1].cells[6].text == "-0.05 (-0.79 to 0.69)"
    # corrected for more comparisons
    assert in_pairs.rows[2].cells[7].value > table.rows[2].cells[7].value
    in_ranks = all_tables(runs, tests="nemenyi")[0]
    assert [c.name for c in in_ranks.columns][-1] == "Mean rank"
    nothing = all_tables(runs, reference="nobody")[0]
    assert (
        "nothing is tested: the reference nobody has no completed run, or no other rule has one"
        in nothing.notes
    )
    assert [row.label for row in by_b.rows] == [row.label for row in table.rows]


def test_rules_that_their_publication_trains_otherwise_are_marked_in_every_table(made_run):
    tied = [
        dataclasses.replace(made_run("tied", scene), training="centres fixed, 100 steps a frame")
        for scene in ("room", "hall")
    ]
    results = Results(
        runs=[*tied, made_run("plain", "room", psnr=20.0), made_run("plain", "hall", psnr=20.0)]
    )
    note = (
        "† the publication trains the Gaussians otherwise than here, so the row is about this "
        "rule, and not about that system: tied (centres fixed, 100 steps a frame)"
    )
    tables = results.tables()
    assert [table.scene for table in tables] == ["", "room", "hall"]
    for table in tables:
        assert [(row.label, row.mark) for row in table.rows] == [("tied", "†"), ("plain", "")]
        assert note in table.notes
        assert "| tied † |" in as_markdown(table)
    html = results._repr_html_()
    assert html.count(">tied †</th>") == 5  # two scenes have more numbers behind a click
    assert html.count(note) == 3
    assert (
        results.as_json()["rules"]["tied"]["published_training"]
        == "centres fixed, 100 steps a frame"
    )


def test_the_rules_that_are_marked(spec):
    """Not in the system of the publication, nor where it takes the steps that it brings."""
    own = Budget(steps="own")
    assert "100 steps a frame" in _training(Entry(spec=spec("vtgaussian")))
    assert "centres and rotations fixed" in _training(Entry(spec=spec("vtgaussian", budget=own)))
    assert _training(Entry(spec=spec("rtg_slam")))
    assert _training(Entry(spec=spec("rtg_slam", system="rtg_slam"))) == ""
    assert _training(Entry(spec=spec("splatam_like"))) == "60 steps a frame"
    assert _training(Entry(spec=spec("splatam_like", budget=own))) == ""
    assert _training(Entry(spec=spec("uniform"))) == ""
