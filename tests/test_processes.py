"""Jobs in several processes: results as they come, failures as None, and needs kept apart."""

import os
import subprocess
import sys

import pytest

from gsfusion_nb.work import _next, run_in_processes, usable_cores


def test_every_job_gives_its_result_or_none():
    """A job that raises gives None. The jobs run in other processes."""
    needs = [frozenset(), frozenset({"a"}), frozenset({"a"}), frozenset()]
    jobs = [("3",), ("__import__('os').getpid()",), ("int('four')",), ("5",)]
    found = dict(run_in_processes(eval, jobs, needs, 2))
    assert found.pop(1) not in (None, os.getpid())
    assert found == {0: 3, 2: None, 3: 5}


def test_processes_that_end_leave_none_and_are_replaced():
    assert dict(run_in_processes(os._exit, [(0,), (0,)], [frozenset()] * 2, 1)) == {0: None, 1: None}


_KILLED_WITH_A_JOB_RUNNING = """
import os, signal, threading, time
from gsfusion_nb.work import WorkerPool

if __name__ == "__main__":
    pool = WorkerPool(time.sleep, 1)
    pool.start(0, (600,))
    print(next(iter(pool._processes.values())).pid, flush=True)
    time.sleep(1)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.ci
def test_processes_end_in_the_middle_of_a_job_when_the_one_that_started_them_is_killed(tmp_path):
    script = tmp_path / "killed.py"
    script.write_text(_KILLED_WITH_A_JOB_RUNNING, encoding="utf-8")
    done = subprocess.run([sys.executable, script], stdout=subprocess.PIPE, timeout=60)  # waits for the child's stdout
    assert done.returncode == -9
    assert int(done.stdout)


def test_a_job_waits_for_what_another_one_uses():
    needs = [frozenset("ab"), frozenset("b"), frozenset("c"), frozenset("abc")]
    assert _next([0, 1, 2, 3], needs, set()) == 0
    assert _next([1, 2, 3], needs, {0}) == 2
    assert _next([1, 3], needs, {0, 2}) is None
    assert _next([3], needs, {2}) is None
    assert _next([3], needs, set()) == 3


def test_nothing_to_do_starts_nothing():
    assert list(run_in_processes(int, [], [], 3)) == []
    assert usable_cores() >= 1
