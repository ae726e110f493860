"""A campaign with a seed of its own: no traceback, crash, hang, memory or silent acceptance.

It takes eleven seconds before its first input; ``.ci/run`` runs a thousand inputs beside lint.
"""

import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).parent / "fuzz.py"


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="memory is measured as Linux does"
)
def test_damaged_and_hostile_files():
    command = [sys.executable, str(FUZZ), "--inputs", "1500", "--seed", "8"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert f"{1500:8} inputs" in done.stdout
    assert f"{0:8} silent acceptances" in done.stdout


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="memory is measured as Linux does"
)
def test_altered_checkpoints_with_right_checksums():
    command = [sys.executable, str(FUZZ), "--inputs", "1200", "--seed", "1", "--target", "altered"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert f"{0:8} silent acceptances" in done.stdout
