"""Compiling is not work: clocks of frames and of runs stand still meanwhile."""

import contextlib
import threading
import time

import pytest

from gsfusion_nb import compile_clock
from gsfusion_nb.compile_clock import CompileClock, working_time
from gsfusion_nb.mapping.stage_clock import StageClock
from gsfusion_nb.runs import run_clock
from gsfusion_nb.runs.run_clock import RunClock


@pytest.fixture
def ticks(monkeypatch):
    """``ticks(s)``: the clock of the process goes on by ``s`` seconds, and does not otherwise."""
    now = [100.0]

    def go_on(seconds):
        now[0] += seconds

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "thread_time", lambda: 0.5 * now[0])
    return go_on


@pytest.fixture
def clock(monkeypatch):
    """A compile clock of its own for what is tested."""
    clock = CompileClock()
    for module in (compile_clock, run_clock):
        monkeypatch.setattr(module, "COMPILE_CLOCK", clock)
    return clock


def test_a_function_that_is_compiled_within_another_counts_once(ticks, clock):
    ticks(1)
    with clock.compiling():
        ticks(2)
        with contextlib.suppress(KeyError), clock.compiling():
            ticks(4)
            raise KeyError
        ticks(8)
    ticks(16)
    assert (clock.seconds, clock.cpu_seconds) == (14.0, 7.0)
    assert working_time() == 131.0 - 14.0


def test_each_thread_counts_its_own(ticks, clock):
    def compile_there():
        with clock.compiling():
            ticks(4)

    thread = threading.Thread(target=compile_there)
    thread.start()
    thread.join()
    assert clock.seconds == 0.0


def test_stages_of_a_frame_and_of_a_run_leave_it_out(ticks, clock):
    stages = StageClock()
    with clock.compiling():  # before the run
        ticks(32)
    run = RunClock(clock=time.perf_counter, cpu=time.thread_time)
    with run("mapping"), stages("tsdf"):
        ticks(1)
        with clock.compiling():
            ticks(60)
        ticks(2)
    ticks(4)
    metrics = run.metrics()
    assert stages.seconds == {"tsdf": 3.0}
    assert metrics["seconds_mapping"] == 3.0
    assert metrics["seconds_compiling"] == 60.0
    assert metrics["seconds_other"] == 4.0
    assert metrics["seconds_total"] == 67.0
    assert run.cpu_seconds["compiling"] == 30.0
    assert run.cpu_seconds["mapping"] == 1.5
