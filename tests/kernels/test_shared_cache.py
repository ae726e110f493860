"""Several processes that compile the same functions at the same time: each is compiled once, and
none is lost."""

import itertools
import os
import pickle
import subprocess
import sys

import pytest
from trial_kernels import LOAD_TRIAL

pytest.importorskip("numba")
pytestmark = pytest.mark.slow

_KERNELS = """
from numba import njit

from .trial_numbers import START

@njit(cache=True)
def part(x):
    s = x + START
    for i in range(10):
        s = s * x + i
    return s

@njit(cache=True)
def whole(x):
    return part(x) + part(x + x)
"""

_BEFORE = """
import importlib.util, pathlib, sys, time
import numba
import gsfusion_nb.kernels
from numba.core import event
from gsfusion_nb.kernels.runtime import numba as _

folder, types = pathlib.Path(sys.argv[1]), sys.argv[2:]
gsfusion_nb.kernels.__path__.append(str(folder))
"""

_AFTER = """
print("ready", flush=True)
sys.stdin.readline()
for name in types:
    assert trial.whole(getattr(numba, name)(2)) == trial.whole.py_func(2)
print(*(name for name in Count.names if name in ("part", "whole")), flush=True)
"""

_PROCESS = _BEFORE + LOAD_TRIAL + _AFTER


def write_trial(folder, start=0):
    (folder / "trial.py").write_text(_KERNELS)
    (folder / "trial_numbers.py").write_text(f"START = {start}\n")


def run(folder, *types_of_each):
    """Names of the functions that each of several processes compiled, which begin at the same
    time."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", _PROCESS, str(folder), *types],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for types in types_of_each
    ]
    for process in started:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in started:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    said = [process.communicate(timeout=300)[0] for process in started]
    assert [process.returncode for process in started] == [0] * len(started)
    return [words.split() for words in said]


def test_each_function_is_compiled_once_for_each_type(tmp_path):
    write_trial(tmp_path)
    compiled = run(tmp_path, ["int64", "float64"], ["float64", "float32"], ["float32", "int64"])
    assert sorted(itertools.chain(*compiled)) == ["part"] * 3 + ["whole"] * 3
    assert run(tmp_path, ["int64", "float64", "float32"]) == [[]]


def test_a_number_that_changes_in_another_file_is_compiled_in(tmp_path):
    write_trial(tmp_path)
    assert sorted(run(tmp_path, ["int64"])[0]) == ["part", "whole"]
    numbers = tmp_path / "trial_numbers.py"
    before = (tmp_path / "trial_numbers.py").stat().st_mtime
    os.utime(numbers, (before, before + 10))
    assert sorted(run(tmp_path, ["int64"])[0]) == ["part", "whole"]
    assert run(tmp_path, ["int64"]) == [[]]


def test_an_index_that_names_a_module_that_is_gone_is_made_again(tmp_path):
    write_trial(tmp_path)
    run(tmp_path, ["int64"])
    for index in (tmp_path / "cache").rglob("*.nbi"):
        with index.open("rb") as file:
            version = pickle.load(file)
        index.write_bytes(pickle.dumps(version) + b"cgsfusion_nb.kernels.renamed\nLayout\n.")
    assert sorted(run(tmp_path, ["int64"])[0]) == ["part", "whole"]
    assert run(tmp_path, ["int64"]) == [[]]
