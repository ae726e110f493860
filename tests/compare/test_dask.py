"""A comparison on a Dask cluster of several worker processes, one of which is killed in the
middle."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest

from gsfusion_nb.compare import executors
from gsfusion_nb.compare.command import WhereOptions, run_and_write
from gsfusion_nb.compare.executors import on_dask
from gsfusion_nb.compare.map_scene import Entry
from gsfusion_nb.compare.run_all import ResultStore, run_all
from gsfusion_nb.compare.run_result import MEASURED

pytestmark = pytest.mark.filterwarnings("ignore")  # Dask warns of what it does to its workers


@pytest.fixture(scope="module")
def distributed():
    return pytest.importorskip("distributed", reason='needs the extra "cluster"')


def numbers(result):
    return {k: v for k, v in result.metrics.items() if k not in MEASURED}, result.map_hash


@pytest.mark.ci
def test_a_cluster_gives_the_numbers_of_this_process(distributed, spec, tmp_path):
    entries = [Entry(spec=spec("uniform")), Entry(spec=spec("nonsense"))]
    here = dict(run_all(entries, ResultStore(tmp_path / "cache a")))
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
    )
    with cluster, distributed.Client(cluster) as client:
        there = dict(run_all(entries, ResultStore(tmp_path / "cache b"), on_dask(client)))
    assert numbers(there[0]) == numbers(here[0])
    assert there[1].reason == here[1].reason != ""


@pytest.mark.slow
def test_a_worker_that_is_killed_changes_no_number(
    distributed, same_torch_everywhere, spec, tmp_path
):
    entries = [
        Entry(spec=spec(rule, seed=seed))
        for rule in ("uniform", "gsfusion", "dense")
        for seed in range(4)
    ]
    here = dict(run_all(entries, ResultStore(tmp_path / "cache a")))
    cluster = distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None
    )
    with cluster, distributed.Client(cluster) as client:
        victim = client.run(os.getpid).popitem()[1]
        there = {}
        for i, result in run_all(entries, ResultStore(tmp_path / "cache b"), on_dask(client)):
            there[i] = result
            if len(there) == 2:
                os.kill(victim, signal.SIGKILL)
        assert victim not in client.run(os.getpid).values()
    assert [there[i].reason for i in range(12)] == [""] * 12
    assert {i: numbers(r) for i, r in there.items()} == {i: numbers(r) for i, r in here.items()}


@pytest.mark.ci
def test_a_cluster_that_loses_its_last_worker_ends_with_a_sentence(
    distributed, same_torch_everywhere, spec, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(executors, "NO_WORKER_S", 0.5)
    monkeypatch.setattr(executors, "_LOOK_S", 0.1)
    with distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=None) as cluster:
        options = WhereOptions(dask=cluster.scheduler_address, cache=False)
        assert run_and_write([spec()], tmp_path / "a", options) == (1, [])
        with distributed.Client(cluster) as client:
            cluster.scale(1)
            client.wait_for_workers(1, timeout=60)
            runs = run_all(
                [Entry(spec=spec(seed=s)) for s in range(6)],
                ResultStore(tmp_path / "b"),
                on_dask(client),
            )
            next(runs)
            cluster.scale(0)
            with pytest.raises(executors.NoWorkerError, match=re.escape(cluster.scheduler_address)):
                list(runs)
    assert "no worker" in capsys.readouterr().err


CLUSTER = "--nthreads 1 --no-dashboard --local-directory"


@pytest.fixture
def started(tmp_path):
    """``started(name, words, **environment)``: a process of Dask's command line, ended after the
    test."""
    processes = []

    def start(name, words, **environment):
        command = [sys.executable, "-m", "dask", *words.split()]
        with (tmp_path / f"{name}.log").open("w") as log:
            processes.append(
                subprocess.Popen(
                    command, stdout=log, stderr=log, env=os.environ | environment, cwd=tmp_path
                )
            )
        return processes[-1]

    yield start
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait()


@pytest.fixture
def scheduler(distributed, started, tmp_path):
    """Address of a scheduler in a process of its own."""
    file = tmp_path / "scheduler.json"
    started(
        "scheduler", f"scheduler --scheduler-file {file} --port 0 --host 127.0.0.1 --no-dashboard"
    )
    while not file.exists() or not file.read_text():
        time.sleep(0.1)
    return json.loads(file.read_text())["address"]


@pytest.mark.slow
def test_two_workers_with_caches_of_their_own_compute_what_this_process_computes(
    distributed, same_torch_everywhere, spec, tmp_path, started, scheduler
):
    entries = [
        Entry(spec=spec(rule, seed=seed))
        for rule in ("uniform", "gsfusion", "edge_strokes")
        for seed in (0, 1)
    ]
    here = dict(run_all(entries, ResultStore(tmp_path / "cache a")))
    for name in ("one", "two"):
        cache = tmp_path / f"cache of {name}"
        started(
            name,
            f"worker {scheduler} {CLUSTER} {tmp_path}/{name}",
            GSFUSION_CACHE=str(cache),
            XDG_CACHE_HOME=str(cache),
        )
    empty = ResultStore(tmp_path / "cache b")
    assert not any(file.is_file() for file in (tmp_path / "cache b").rglob("*"))
    with distributed.Client(scheduler) as client:
        client.wait_for_workers(2, timeout=120)
        there = dict(run_all(entries, empty, on_dask(client)))
        assert len({*client.run(os.getpid).values(), os.getpid()}) == 3
    # where a copied result would have come from
    assert not list(tmp_path.glob("cache of */**/results/*"))
    assert [there[i].reason for i in range(6)] == [""] * 6
    assert {i: numbers(r) for i, r in there.items()} == {i: numbers(r) for i, r in here.items()}
