"""A loss and an optimiser of one's own in comparisons."""

import csv
import io

import pytest

from gsfusion_nb.compare import RunSpec
from gsfusion_nb.compare.map_scene import Entry
from gsfusion_nb.compare.one_run import run_entry
from gsfusion_nb.compare.recording_specs import ran_under
from gsfusion_nb.compare.runs_csv import as_csv
from gsfusion_nb.compare.sweep import SweepOptions, sweep_specs
from gsfusion_nb.compare.table_file import read_table
from gsfusion_nb.errors import ForeseenError
from gsfusion_nb.seeding.named_code import TrainingNotNamedError

LOSSES = """
from gsfusion_nb.optim import ViewLoss

import scale


def squares(rendered, view):
    gap = rendered.rgb - view.rgb
    return ViewLoss(value=scale.HALF * gap.square().sum(), v_rgb=gap)


def plain(param, gradient, m, v, steps, *, lr):
    param -= lr * gradient


number = 3
"""
QUICK = ("tsdf.voxel_size_m=0.08", "sh_degree=0", "optim.global_iterations=1")


@pytest.fixture
def file(tmp_path):
    (tmp_path / "scale.py").write_text("HALF = 0.5\n")
    path = tmp_path / "losses.py"
    path.write_text(LOSSES)
    return path


def specs_of(scene, **options):
    settings = (*QUICK, "data.hold_out_every=4", "data.hold_out_offset=2")
    return sweep_specs(
        SweepOptions(data=str(scene), set=settings, grid=("optim.lr_xyz=0.001",), **options)
    )


def test_every_comparison_takes_them_and_another_process_has_them_too(scene, file):
    [usual] = specs_of(scene)
    [own] = specs_of(scene, loss=f"{file}:squares", optimiser=f"{file}:plain")
    assert own.key != usual.key
    assert f"loss {file}:squares" in ran_under([own])
    sent = RunSpec.from_json(own.to_json())  # what a process of --jobs or Dask gets
    assert sent.key == own.key
    file.unlink()
    results = [run_entry(Entry(spec=spec)) for spec in (usual, sent)]
    assert [result.status for result in results] == ["done", "done"]
    assert results[0].map_hash != results[1].map_hash
    rows = list(csv.DictReader(io.StringIO(as_csv(results))))
    assert [row["loss"] for row in rows] == ["", f"{file}:squares"]
    assert {row["device"] for row in rows} == {"cpu"}


def test_an_edit_of_a_loss_or_beside_it_changes_the_key(scene, file):
    def key(**options):
        [spec] = specs_of(scene, **options)
        return spec.key

    loss = {"loss": f"{file}:squares"}
    keys = [key(**loss)]
    file.write_text(LOSSES.replace("v_rgb=gap", "v_rgb=2 * gap"))
    keys.append(key(**loss))
    (file.parent / "scale.py").write_text("HALF = 0.25\n")
    keys.append(key(**loss))
    assert len(set(keys)) == 3


def test_losses_are_compared_in_one_sweep(scene, file):
    options = SweepOptions(
        data=str(scene), set=QUICK, grid=(f"loss={file}:squares,",), optimiser=f"{file}:plain"
    )
    [spec] = sweep_specs(options)
    assert set(spec.training) == {"loss", "optimiser"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"loss": "losses.py"}, "expected a loss in a file as FILE.py:name"),
        ({"loss": "FILE:missing"}, "has no function 'missing'; expected a loss"),
        ({"optimiser": "FILE:number"}, "has no function 'number'; expected an optimiser"),
        ({"optimiser": "nowhere.py:f"}, "nowhere.py does not exist"),
        ({"optimiser": "FILE:squares"}, "squares"),
    ],
)
def test_what_is_no_loss_or_optimiser_is_named(scene, file, options, message):
    options = {kind: text.replace("FILE", str(file)) for kind, text in options.items()}
    with pytest.raises((ForeseenError, OSError, TypeError), match=message):
        specs_of(scene, **options)


def test_a_table_compares_losses_and_executes_only_named_files(scene, file, tmp_path):
    table = tmp_path / "table.toml"
    table.write_text(f'''
fidelity = "paper"
[settings]
"data.hold_out_every" = 4
"data.hold_out_offset" = 2
"tsdf.voxel_size_m" = 0.08
[[scenes]]
data = "{scene}"
[[rules]]
rule = "uniform"
[[rules]]
rule = "uniform"
label = "squares"
loss = "losses.py:squares"
''')
    with pytest.raises(TrainingNotNamedError, match="asks for the loss or optimiser 'squares'"):
        read_table(table)
    usual, own = read_table(table, rule_files=[file]).specs
    assert not usual.training
    assert set(own.training) == {"loss"}
    assert usual.fidelity == own.fidelity == "paper"
    assert usual.key != own.key
