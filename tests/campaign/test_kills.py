"""A handful of kills in CI, five processes that map; the whole campaign: python
tests/campaign/kills.py."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("kills.py")

pytestmark = pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="needs fork")


def run(*options: str) -> str:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *options],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    return done.stdout


@pytest.mark.ci
def test_a_run_killed_at_a_few_moments_ends_with_the_same_maps():
    text = run("--kills", "1", "--variants", "gsfusion-given")
    assert "kills: 1" in text or "kills: 2" in text
    assert "different or failed: 0" in text


@pytest.mark.slow
def test_many_kills_of_all_systems():
    assert "different or failed: 0" in run("--kills", "40")
