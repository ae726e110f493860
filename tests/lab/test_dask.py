"""A comparison on a Dask cluster of several worker processes, one of which is killed in the middle."""

import os
import signal

import pytest

from gsfusion_nb.lab.executors import OnDask
from gsfusion_nb.lab.map_scene import Entry
from gsfusion_nb.lab.result import MEASURED
from gsfusion_nb.lab.run_all import run_all
from gsfusion_nb.lab.store import ResultStore

pytestmark = pytest.mark.filterwarnings("ignore")  # Dask warns of what it does to its workers


@pytest.fixture(scope="module")
def distributed():
    return pytest.importorskip("distributed", reason='needs the extra "cluster"')


def numbers(result):
    return {k: v for k, v in result.metrics.items() if k not in MEASURED}, result.per_view, result.map_hash


def test_a_cluster_gives_the_numbers_of_this_process(distributed, spec, tmp_path):
    entries = [Entry(spec=spec("uniform")), Entry(spec=spec("nonsense"))]
    here = dict(run_all(entries, ResultStore(tmp_path / "a", tmp_path / "cache a")))
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None)
    with cluster, distributed.Client(cluster) as client:
        there = dict(run_all(entries, ResultStore(tmp_path / "b", tmp_path / "cache b"), OnDask(client)))
    assert numbers(there[0]) == numbers(here[0])
    assert there[1].reason == here[1].reason != ""


@pytest.mark.slow
def test_a_worker_that_is_killed_changes_no_number(distributed, spec, tmp_path):
    entries = [Entry(spec=spec(rule, seed=seed)) for rule in ("uniform", "gsfusion", "dense") for seed in range(4)]
    here = dict(run_all(entries, ResultStore(tmp_path / "a", tmp_path / "cache a")))
    cluster = distributed.LocalCluster(n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None)
    with cluster, distributed.Client(cluster) as client:
        victim, there = client.run(os.getpid).popitem()[1], {}
        for i, result in run_all(entries, ResultStore(tmp_path / "b", tmp_path / "cache b"), OnDask(client)):
            there[i] = result
            if len(there) == 2:
                os.kill(victim, signal.SIGKILL)
        assert victim not in client.run(os.getpid).values()
    assert [there[i].reason for i in range(12)] == [""] * 12
    assert {i: numbers(r) for i, r in there.items()} == {i: numbers(r) for i, r in here.items()}
