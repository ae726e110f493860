"""The file of a comparison: all of it is checked before anything runs, with the place in the
file."""

import pytest

from gsfusion_nb.cli import main as cli
from gsfusion_nb.compare import LiveTable
from gsfusion_nb.compare.command import LabOptions, _as_asked, main
from gsfusion_nb.compare.table_file import EXAMPLE, TableError, read_table

GOOD = """\
seeds = [0, 3]
[settings]
"data.hold_out_every" = 4
"data.hold_out_offset" = 2
tsdf = { voxel-size-m = 0.08 }
[[rules]]
rule = "uniform"
options = { fraction = 0.1 }
[[rules]]
rule = "mine.py:some"
size_option = "step"
size_range = [1, 90]
[[scenes]]
data = "%s"
label = "a wall"
[[budgets]]
gaussians = 150
[[budgets]]
steps = "own"
"""
RULE = "def some(ctx, *, step=7):\n    return ctx.seeds_at(ctx.pixels()[::step], 1.0)\n"


@pytest.fixture
def table(scene, tmp_path):
    """``table(old, new)``: the path of a good file with one change."""
    (tmp_path / "mine.py").write_text(RULE)

    def write(old="", new=""):
        text = GOOD % scene
        assert old in text
        (tmp_path / "t.toml").write_text(text.replace(old, new, 1))
        return tmp_path / "t.toml"

    return write


def read_mine(path):
    """The table, with its rule named."""
    return read_table(path, rule_files=[path.with_name("mine.py")])


def test_all_combinations_in_order(table):
    found = read_mine(table())
    assert str(found) == "8 runs: 2 rules x 1 scene x 2 seeds x 2 budgets"
    assert [(s.label, s.seed, s.budget.gaussians) for s in found.specs[:3]] == [
        ("uniform fraction=0.1", 0, 150),
        ("uniform fraction=0.1", 3, 150),
        ("some", 0, 150),
    ]
    some = found.specs[2]
    assert (some.rule_source, some.size_range, some.scene) == (RULE, (1, 90), "a wall")
    assert some.config().tsdf.voxel_size_m == 0.08


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("seeds = [0, 3]", "seeds = [0, -3]", "seeds: "),
        ("seeds =", 'system = "slam"\nseeds =', "slam"),
        ("hold_out_every", "hold_out_evry", "hold_out_evry"),
        ('rule = "uniform"', 'rule = "unifrom"', "unifrom"),
        ("fraction = 0.1", "fration = 0.1", "fration"),
        ("mine.py:some", "mine.py:other", "other"),
        ('size_option = "step"', "", "rules[1]: "),
        ('"step"', '"stepp"', "stepp"),
        ("/wall", "/well", "scenes[0]: "),
        ("gaussians = 150", "gaussians = 0", "budgets[0]: budget.gaussians"),
        ('"own"', '"same"', "budgets[1]: "),
        ('"data.hold_out_every" = 4', '"data.hold_out_every" = 0', "scenes[0]: "),
        ("[[scenes]]", "[[scene]]", "scene"),
        ('label = "a wall"', "settings = { sh_degree = 0, sh_degre = 1 }", "scenes[0]: "),
        ("seeds = [0, 3]", "seeds = [0, 3", "TOML: "),
        (
            "seeds =",
            'tests = "wilcoxon"\nseeds =',
            "tests: no test 'wilcoxon'; known: nemenyi, pairs, reference",
        ),
        ("seeds =", 'reference = "the best"\nseeds =', "reference: no rule 'the best'"),
    ],
)
def test_mistakes_are_found_before_anything_runs(table, old, new, place):
    with pytest.raises(TableError) as error:
        read_mine(table(old, new))
    assert place in str(error.value)


def test_settings_are_checked_together(table):
    path = table("[[rules]]", '"tsdf.near_m" = 7\n"tsdf.far_m" = 9\n[[rules]]')
    assert read_mine(path).specs[0].config().tsdf.near_m == 7.0


def test_equal_names_are_refused(table):
    with pytest.raises(TableError, match="uniform"):
        read_mine(
            table(
                "[[scenes]]",
                '[[rules]]\nrule = "uniform"\noptions = { fraction = 0.1 }\n[[scenes]]',
            )
        )


def test_the_example_is_a_good_file(tmp_path, capsys):
    path = tmp_path / "new.toml"
    assert main(LabOptions(new=str(path))) == 0
    assert path.read_text() == EXAMPLE
    assert str(read_table(path)) == "16 runs: 4 rules x 2 scenes x 2 seeds x 1 budget"
    with pytest.raises(FileExistsError, match="new"):
        main(LabOptions(new=str(path)))
    with pytest.raises(FileNotFoundError, match="--new"):
        main(LabOptions(table=str(tmp_path / "none.toml")))
    with pytest.raises(ValueError, match="--new"):
        main(LabOptions())


def test_what_is_tested_is_named_before_anything_runs(table, tmp_path):
    path = table("seeds =", 'tests = "pairs"\nreference = "some"\nseeds =')
    found = read_mine(path)
    assert (found.tests, found.reference) == ("pairs", "some")
    asked = _as_asked(found, LabOptions(tests="nemenyi"))
    assert (asked.tests, asked.reference) == ("nemenyi", "some")
    assert (
        _as_asked(found, LabOptions(reference="uniform fraction=0.1")).reference
        == "uniform fraction=0.1"
    )
    out = ["--out", str(tmp_path / "out"), "--rule-file", str(tmp_path / "mine.py")]
    assert cli(["lab", str(path), *out, "--reference", "the best"]) == 1
    assert cli(["lab", str(path), *out, "--tests", "wilcoxon"]) == 1
    with pytest.raises(KeyError, match="no rule 'the best'; known: uniform"):
        LiveTable(found.specs[:1], tmp_path, reference="the best")


@pytest.mark.ci
def test_the_command_writes_everything(table, tmp_path, capsys):
    import csv
    import json

    out = tmp_path / "out"
    path = table("seeds = [0, 3]", "seeds = 1")
    path.write_text(path.read_text().replace('[[budgets]]\nsteps = "own"\n', ""))
    status = main(
        LabOptions(
            table=str(path),
            out=str(out),
            rule_file=(str(tmp_path / "mine.py"),),
        )
    )
    text = capsys.readouterr().out
    assert (status, text.count("failed:")) == (0, 0), text
    rows = list(csv.DictReader((out / "runs.csv").read_text().splitlines()))
    assert [(r["label"], r["budget_gaussians"], r["steps"], r["status"]) for r in rows] == [
        ("uniform fraction=0.1", "150", "equal", "done"),
        ("some", "150", "equal", "done"),
    ]
    assert abs(int(rows[0]["metric.n_gaussians"][:3]) - 150) < 8
    assert rows[0]["setting.tsdf.voxel_size_m"] == "0.08"
    origin = json.loads((out / "table.json").read_text())
    assert origin["rules"]["some"]["source"] == RULE
    assert origin["table"] == path.read_text()
    assert "[  2/2]" in text
    assert "2 of 2 runs in" in text
    again = LabOptions(table=str(path), out=str(out), rule_file=(str(tmp_path / "mine.py"),))
    assert main(again) == 0
    assert "2 of 2 runs in " in capsys.readouterr().out
