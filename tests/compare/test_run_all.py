"""All runs of a comparison: the same numbers wherever they run, nothing twice, and failures as
rows."""

import dataclasses
import os
import shutil
from typing import Any

import cv2
import pytest

from gsfusion_nb.compare import Budget, RunResult, executors, program
from gsfusion_nb.compare.command import WhereOptions, run_and_write
from gsfusion_nb.compare.executors import InProcess, Task, do_task, executor, threads_of_each
from gsfusion_nb.compare.map_scene import Entry
from gsfusion_nb.compare.run_all import ResultStore, run_all
from gsfusion_nb.compare.run_result import MEASURED
from gsfusion_nb.runs.run_folder import RunFolder


@pytest.fixture
def entries(spec):
    """Two rules with two seeds and a budget, and one that fails."""
    made = [spec("uniform", seed=seed, budget=Budget(gaussians=120)) for seed in (0, 1)]
    made += [spec("gsfusion", label="quadtree"), spec("dense", budget=Budget(gaussians=120))]
    return [Entry(spec=s) for s in made]


def numbers(result: RunResult) -> dict:
    """Everything but times and where it was found."""
    values: dict[str, Any] = dataclasses.asdict(result)
    del values["copied_from"]
    values["metrics"] = {k: v for k, v in values["metrics"].items() if k not in MEASURED}
    return values


class Counting(InProcess):
    """Counts what is really done."""

    def __init__(self):
        super().__init__()
        self.done = []

    def put(self, number, task):
        self.done.append(task.kind)
        super().put(number, task)


def test_runs_are_done_once(entries, tmp_path):
    first = Counting()
    store = ResultStore(tmp_path / "cache")
    results = dict(run_all([*entries, entries[0]], store, first))
    assert sorted(results) == [0, 1, 2, 3, 4]
    assert sorted(first.done) == ["run", "run", "run", "tune", "tune"]
    assert [results[i].status for i in range(4)] == ["done", "done", "done", "failed"]
    assert "has no size option" in results[3].reason
    assert numbers(results[0]) == numbers(results[4])
    assert results[2].spec.label == "quadtree"
    assert all((tmp_path / "cache" / name).is_file() for name in results[2].pictures.values())

    again = Counting()
    other = ResultStore(tmp_path / "cache")
    renamed = [Entry(spec=dataclasses.replace(entries[2].spec, label="another name"))]
    reused = dict(run_all([*entries[:2], *renamed], other, again))
    assert again.done == []
    assert numbers(reused[1]) == numbers(results[1])
    assert reused[2].spec.label == "another name"
    assert {r.copied_from for r in results.values()} == {""}
    assert {r.copied_from for r in reused.values()} == {str(tmp_path / "cache")}
    edited = [Entry(spec=dataclasses.replace(entries[1].spec, seed=2))]
    assert dict(run_all(edited, other, again))[0].status == "done"
    assert again.done == ["run"]  # its tuning is known


def test_a_stop_keeps_what_is_done(entries, tmp_path):
    store = ResultStore(tmp_path / "cache")
    runs = run_all(entries[2:] + entries[:2], store)
    next(runs)
    runs.close()
    counting = Counting()
    assert len(dict(run_all(entries, store, counting))) == 4
    assert counting.done.count("run") == 2


def test_a_damaged_or_altered_result_is_computed_again_and_named(entries, tmp_path, caplog):
    """Also one of another run under this name, and one of the right form whose number somebody has
    changed."""
    store = ResultStore(tmp_path / "cache")
    results = dict(run_all(entries[1:3], store))
    path = tmp_path / "cache" / "results" / f"{results[1].key}.json"
    content = path.read_text()
    other = path.with_name(f"{results[0].key}.json").read_text()
    found = f'"psnr_held_out_db": {results[1].metrics["psnr_held_out_db"]}'
    assert found in content
    damages = {
        "cut": ('{"spec": 3', "is not valid JSON"),
        "number": (
            content.replace(found, '"psnr_held_out_db": 99.9'),
            "was changed after it was written",
        ),
        "type": (
            content.replace(found, '"psnr_held_out_db": "x"'),
            "was changed after it was written",
        ),
        "unsealed": (content.replace('"checksum"', '"check"'), "has no checksum"),
        "other": (other, "is the result of another run"),
    }
    for name, (text, message) in damages.items():
        path.write_text(text)
        caplog.clear()
        store = ResultStore(tmp_path / "cache")
        counting = Counting()
        assert store.find(entries[2].spec) is None
        again = dict(run_all(entries[2:3], store, counting))[0]
        assert (numbers(again), counting.done) == (numbers(results[1]), ["run"]), name
        said = [line for line in caplog.messages if "computed again" in line]
        assert len(said) == 1, name
        assert str(path) in said[0]
        assert message in said[0]
    tuned = next((tmp_path / "cache" / "tuned").iterdir())
    tuned.write_text(tuned.read_text().replace('"n_runs"', '"runs"'))
    assert ResultStore(tmp_path / "cache").find_tuned(entries[1].spec) is None


def test_other_data_are_seen_by_runs_that_were_made_before(spec, scene, tmp_path):
    """One bit in the middle of an image behind a link: another key, and no result of the old
    data."""
    shutil.copytree(scene, tmp_path / "wall")
    (tmp_path / "link").symlink_to(tmp_path / "wall", target_is_directory=True)
    runs = [Entry(spec=spec(data=str(tmp_path / "link")))]
    store = ResultStore(tmp_path / "cache")
    first = dict(run_all(runs, store))[0]
    image = tmp_path / "wall" / "depth" / "000004.png"
    depth = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    assert depth is not None
    depth[18, 24] += 1
    cv2.imwrite(str(image), depth)
    second = dict(run_all(runs, store))[0]
    assert second.key != first.key
    assert second.map_hash != first.map_hash


def test_data_or_programs_that_differ_where_a_run_is_done_fail_it(
    spec, scene, tmp_path, monkeypatch
):
    shutil.copytree(scene, tmp_path / "wall")
    task = Task(
        kind="run",
        spec=spec(data=str(tmp_path / "wall")),
        backend="auto",
    )
    assert len(task.spec.key) == 32
    shutil.copyfile(tmp_path / "wall/rgb/000001.png", tmp_path / "wall/rgb/000003.png")
    result = do_task(task).result
    assert result is not None
    assert result.status == "failed"
    assert str(tmp_path / "wall") in result.reason


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"the version of torch": "0.1"}, "the version of torch"),
        ({"the sources of gsfusion_nb": "other"}, "the sources of gsfusion_nb"),
        ({"torch.nn.functional.conv2d, replaced": "5e"}, "torch.nn.functional.conv2d, replaced"),
    ],
)
def test_a_process_with_another_program_says_which_part_differs(spec, change, word):
    task = Task(kind="run", spec=spec(), backend="auto", program=program.program_parts() | change)
    assert f"could differ: {word}. " in do_task(task).reason


def test_a_process_names_some_of_many_differences(spec):
    others = {f"numpy.f{i}, replaced": "5e" for i in range(8)}
    task = Task(kind="run", spec=spec(), backend="auto", program=program.program_parts() | others)
    reason = do_task(task).reason
    assert "numpy.f4, replaced; and 3 more" in reason
    assert "numpy.f5" not in reason


def test_the_key_has_the_versions_of_the_libraries(monkeypatch):
    before = program.run_key()
    monkeypatch.setattr(program, "libraries", lambda: {"torch": "0.1"})
    assert program.run_key() != before


@pytest.mark.ci
def test_two_commands_in_one_folder_and_two_on_one_cache(spec, tmp_path, monkeypatch):
    """The second of two in one folder is refused; two on one cache at the same time give the same
    results."""
    options = WhereOptions(out=str(tmp_path / "a"))
    with RunFolder(tmp_path / "a"), pytest.raises(FileExistsError, match="is in use"):
        run_and_write([spec()], tmp_path / "a", options)
    monkeypatch.setenv("GSFUSION_CACHE", str(tmp_path / "cache"))
    one, two = (
        run_all(
            [Entry(spec=spec()), Entry(spec=spec(seed=1))],
            ResultStore(),
        )
        for _ in range(2)
    )
    found = [next(one), next(two), next(one), next(two)]
    assert [result.status for _, result in found] == ["done"] * 4
    assert len({result.map_hash for i, result in found if i == 0}) == 1
    assert run_and_write([spec()], tmp_path / "d", options)[0] == 0
    assert "1 of 1 runs were copied" in (tmp_path / "d" / "table.md").read_text()
    assert str(tmp_path / "cache") in (tmp_path / "d" / "runs.csv").read_text()
    status, (run,) = run_and_write(
        [spec()],
        tmp_path / "e",
        WhereOptions(cache=False),
    )
    assert (status, run.copied_from, run.map_hash) == (0, "", found[0][1].map_hash)
    assert "copied from" not in (tmp_path / "e" / "table.md").read_text()


def test_it_is_said_how_many_runs_will_be_computed(spec, tmp_path, capsys):
    store = ResultStore(tmp_path)
    runs = [spec(), spec(label="again")]
    store.keep(
        RunResult(
            spec=runs[0],
            status="done",
            metrics={"n_gaussians": 20.0, "n_steps": 1.0},
        )
    )
    run_and_write(runs, tmp_path, WhereOptions(cache=False))
    assert "0 of 2 runs to compute" in capsys.readouterr().out


@pytest.mark.ci
def test_processes_give_the_same_numbers(same_torch_everywhere, entries, tmp_path):
    with executor(2) as two:
        there = dict(run_all(entries, ResultStore(tmp_path / "cache a"), two))
    here = dict(run_all(entries, ResultStore(tmp_path / "cache b")))
    assert {i: numbers(r) for i, r in here.items()} == {i: numbers(r) for i, r in there.items()}
    assert all((tmp_path / "cache a" / name).is_file() for name in there[2].pictures.values())


@pytest.mark.ci
def test_a_process_that_dies_is_a_reason(same_torch_everywhere, spec, tmp_path):
    source = f"""import os

def dies(ctx):
    if os.getpid() != {os.getpid()}:
        os._exit(9)
"""
    with executor(2) as two:
        runs = [Entry(spec=spec("r.py:dies", rule_source=source))]
        found = dict(run_all(runs, ResultStore(tmp_path / "cache"), two))
    assert "its process was lost" in found[0].reason


def test_each_process_has_its_share_of_the_cores():
    assert set(threads_of_each(10_000).values()) == {"1"}


def test_what_cannot_be_sent_is_said(spec, scene):
    from gsfusion_nb.data import open_sequence

    task = Task(
        kind="run",
        spec=spec(),
        backend="auto",
        sequence=open_sequence(scene),
    )
    with pytest.raises(ValueError, match="was opened in this process"):
        task.packed()


def test_a_dask_cluster_that_does_not_answer_is_refused(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(executors, "CONNECT_S", 0.3)
    with (
        pytest.raises(ValueError, match="no Dask scheduler answers at tcp"),
        executor(dask="tcp://127.0.0.1:1"),
    ):
        pass
