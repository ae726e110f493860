"""A short campaign with a seed of its own: no traceback, crash, hang, memory or silent acceptance."""

import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).parent / "fuzz.py"


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is measured as Linux does")
@pytest.mark.parametrize(("inputs", "seed"), [(60, 7), pytest.param(1500, 8, marks=pytest.mark.slow)])
def test_damaged_and_hostile_files(inputs, seed):
    command = [sys.executable, str(FUZZ), "--inputs", str(inputs), "--seed", str(seed)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert f"{inputs:8} inputs" in done.stdout
    assert f"{0:8} silent acceptances" in done.stdout
