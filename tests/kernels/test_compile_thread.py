"""Ctrl-C is heard while a kernel is compiled, and the compiler is left alone."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from gsfusion_nb import interrupts
from gsfusion_nb.compile_clock import COMPILE_CLOCK

compile_thread = pytest.importorskip("gsfusion_nb.kernels.runtime.numba.compile_thread")
Compilation = compile_thread.Compilation


@pytest.fixture
def released():
    """Set at the end of the test, for what waits in a compiler."""
    event = threading.Event()
    yield event
    event.set()
    for thread in list(interrupts.not_waited_for):
        thread.join(timeout=60)
    assert interrupts.not_waited_for == []


def test_what_the_compiler_returns_and_raises():
    assert Compilation.begin(lambda: 3, "kernel").result() == 3

    def fails():
        raise TypeError("no such type")

    with pytest.raises(TypeError, match="no such type"):
        Compilation.begin(fails, "kernel").result()
    assert interrupts.not_waited_for == []


def test_a_signal_is_heard_and_the_compiler_goes_on(released):
    finished = []

    def compile_long():
        os.kill(os.getpid(), signal.SIGINT)
        released.wait()
        finished.append(True)

    with pytest.raises(KeyboardInterrupt):
        Compilation.begin(compile_long, "kernel").result()
    assert not finished
    (compilation,) = interrupts.not_waited_for
    released.set()
    compilation.join()
    assert finished


def test_whoever_delays_signals_is_asked_meanwhile(released):
    asked = []

    def may_end():
        asked.append(True)
        raise KeyboardInterrupt

    interrupts.while_compiling.append(may_end)
    try:
        with pytest.raises(KeyboardInterrupt):
            Compilation.begin(released.wait, "kernel").result()
    finally:
        interrupts.while_compiling.remove(may_end)
    assert asked == [True]


def work(cpu_s=0.05):
    until = time.thread_time() + cpu_s
    while time.thread_time() < until:
        pass


def test_what_its_thread_compiles_counts_for_the_one_that_waits():
    def compile_long():
        with COMPILE_CLOCK.compiling():
            work()

    before = COMPILE_CLOCK.seconds, COMPILE_CLOCK.cpu_seconds
    Compilation.begin(compile_long, "kernel").result()
    assert COMPILE_CLOCK.seconds - before[0] >= 0.05
    assert COMPILE_CLOCK.cpu_seconds - before[1] >= 0.05


def test_a_kernel_that_was_on_disk_is_not_compiled():
    before = COMPILE_CLOCK.seconds, COMPILE_CLOCK.cpu_seconds
    Compilation.begin(work, "kernel").result()
    assert before == (COMPILE_CLOCK.seconds, COMPILE_CLOCK.cpu_seconds)


class Dispatcher:
    """What the compiler is asked with: a function, and where it is asked."""

    def __init__(self, module):
        self.py_func = type("function", (), {"__module__": module, "__name__": "f"})
        self.thread = None


def asked_thread(monkeypatch, dispatcher):
    """The thread in which the compiler of ``dispatcher`` works."""

    def compile_here(self, signature):
        self.thread = threading.current_thread()
        return signature

    monkeypatch.setattr(compile_thread, "_compile", compile_here)
    assert compile_thread.compile_and_listen(dispatcher, "signature") == "signature"
    return dispatcher.thread


def test_our_kernels_are_compiled_in_a_thread(monkeypatch):
    ours = Dispatcher("gsfusion_nb.kernels.project.numba")
    assert asked_thread(monkeypatch, ours) is not threading.main_thread()


def test_functions_of_others_are_compiled_as_usual(monkeypatch):
    theirs = Dispatcher("somebody.else")
    assert asked_thread(monkeypatch, theirs) is threading.main_thread()


def test_where_no_thread_can_be_started_the_main_one_compiles(monkeypatch):
    def cannot(self):
        raise RuntimeError("can't start new thread")

    usual_bytes = threading.stack_size()
    monkeypatch.setattr(Compilation, "start", cannot)
    ours = Dispatcher("gsfusion_nb.kernels.project.numba")
    assert asked_thread(monkeypatch, ours) is threading.main_thread()
    assert interrupts.not_waited_for == []
    assert threading.stack_size() == usual_bytes


def test_what_a_function_in_the_compiler_calls_is_compiled_with_it(monkeypatch):
    """The compiler has one lock, which its thread holds."""
    ours = Dispatcher("gsfusion_nb.kernels.project.numba")
    with compile_thread.global_compiler_lock:
        assert asked_thread(monkeypatch, ours) is threading.main_thread()
    assert asked_thread(monkeypatch, ours) is not threading.main_thread()


def test_no_garbage_is_looked_for_while_kernels_are_compiled(monkeypatch):
    ours = Dispatcher("gsfusion_nb.kernels.project.numba")
    monkeypatch.setattr(compile_thread, "_compile", lambda self, signature: gc.isenabled())
    assert not compile_thread.compile_and_listen(ours, "signature")
    assert compile_thread.compile_and_listen(Dispatcher("somebody.else"), "signature")

    def fails(self, signature):
        raise ValueError("no such type")

    monkeypatch.setattr(compile_thread, "_compile", fails)
    with pytest.raises(ValueError, match="no such type"):
        compile_thread.compile_and_listen(ours, "signature")
    assert gc.isenabled()


def test_a_function_of_a_user_may_call_a_kernel():
    process = ended(CALLER, timeout=300)
    assert (process.returncode, process.stdout, process.stderr) == (0, "0.5\n", "")


def test_another_thread_than_the_main_one_compiles_itself(monkeypatch):
    ours = Dispatcher("gsfusion_nb.kernels.project.numba")
    found = []

    def ask():
        found.append(asked_thread(monkeypatch, ours) is threading.current_thread())

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    assert found == [True]


CALLER = """
import numba
import numpy as np
from gsfusion_nb.kernels.runtime.numba.scalars import solve_into

@numba.njit
def solution(H, b):
    x = np.zeros_like(b)
    solve_into(H, b, x)
    return x[0]

print(solution(np.array([[4.0]]), np.array([2.0])))
"""
BEGIN = """
import sys, time
from gsfusion_nb.interrupts import end_process
from gsfusion_nb.kernels.runtime.numba.compile_thread import Compilation
Compilation.begin(lambda: time.sleep({seconds}), "kernel")
print("said", end="")
"""


def ended(script, **options):
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, **options
    )


def test_an_interrupted_program_does_not_wait_for_the_compiler():
    process = ended(BEGIN.format(seconds=600) + "end_process(130)", timeout=300)
    assert (process.returncode, process.stdout) == (130, "said")


def test_a_program_that_ends_by_itself_waits_for_the_compiler():
    process = ended(BEGIN.format(seconds=0.5) + "sys.exit(3)")
    assert (process.returncode, process.stdout, process.stderr) == (3, "said", "")


def test_without_a_compiler_a_process_ends_as_usual():
    process = ended("from gsfusion_nb.interrupts import end_process\nend_process(7)\nprint('on')")
    assert (process.returncode, process.stdout) == (0, "on\n")
