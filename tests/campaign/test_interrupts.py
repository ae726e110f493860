"""A short campaign of interrupts; ``interrupts.py`` runs long ones."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("interrupts.py")


@pytest.mark.slow
def test_ctrl_c_at_random_moments_changes_no_map():
    command = [sys.executable, str(SCRIPT), "--tries", "6", "--seed", "1", "--most-s", "0.5"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    presses = re.search(r"(\d+) interrupts", done.stdout)
    assert presses is not None, done.stdout
    assert int(presses[1]) > 20
