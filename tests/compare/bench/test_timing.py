import os
import sys
import time

import pytest
import torch

from gsfusion_nb import work as memory_module
from gsfusion_nb.compare.bench import timing
from gsfusion_nb.compare.bench.rows import Row, with_speed
from gsfusion_nb.compare.bench.timing import Lap, Timing, lap, measure, summary, threads
from gsfusion_nb.work import PeakMemory


def test_medians_by_hand():
    result = summary([Lap(0.001, 0.010), Lap(0.002, 0.030), Lap(0.009, 0.020)], peak_mb=5.0)
    assert (result.wall_ms, result.cpu_ms, result.runs, result.peak_mb) == (pytest.approx(2), pytest.approx(20), 3, 5.0)


def test_a_gpu_s_own_clock_counts():
    laps = [Lap(0.004, 0.001, 0.001), Lap(0.004, 0.001, 0.003), Lap(0.004, 0.001, 0.002)]
    timing = summary(laps)
    assert timing.device_ms == pytest.approx(2)
    assert summary([Lap(0.004, 0.001)]).device_ms is None
    slow, fast = (Row(section="raster", case="a", method=m, timing=t) for m, t in (
        ("cpu", Timing(wall_ms=9.0, cpu_ms=8.0, runs=3, peak_mb=None)), ("gpu", timing),
    ))  # fmt: skip
    assert [row.speed for row in with_speed([slow, fast], threads=1)] == [1.0, pytest.approx(4.0)]


def test_sleeping_takes_wall_time_and_no_cpu_time():
    took = lap(lambda: time.sleep(0.05))
    assert took.wall_s >= 0.05
    assert took.cpu_s < 0.5 * took.wall_s


def test_the_first_run_is_not_counted_and_the_budget_ends_it():
    calls = []
    result = measure(lambda: calls.append(0), budget_s=0.0)
    assert result.runs == timing.LEAST_RUNS
    assert len(calls) == timing.LEAST_RUNS + 1


def test_long_work_runs_only_once_more(monkeypatch):
    monkeypatch.setattr(timing, "LONG_RUN_S", 0.001)
    calls = []
    assert measure(lambda: calls.append(time.sleep(0.002)), budget_s=5.0).runs == 1
    assert len(calls) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
def test_memory_of_a_known_size():
    with PeakMemory() as none:
        pass
    with PeakMemory() as memory:
        torch.ones(25_000_000)
    if memory.peak_mb is None:
        pytest.skip("this system does not let a process reset its peak")
    assert none.peak_mb is not None
    assert none.peak_mb < 5
    assert 98 < memory.peak_mb < 120


def test_without_the_system_s_help_memory_is_unknown(monkeypatch):
    monkeypatch.setattr(memory_module, "_reset_peak", lambda: False)
    with PeakMemory() as memory:
        pass
    assert memory.peak_mb is None


def test_threads_are_set_and_put_back(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    before = torch.get_num_threads()
    with threads(2):
        assert torch.get_num_threads() == 2
        assert os.environ["OMP_NUM_THREADS"] == "2"
    assert torch.get_num_threads() == before
    assert os.environ["OMP_NUM_THREADS"] == "7"
