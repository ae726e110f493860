"""A second user of a machine compiles nothing: kernels beside their sources are read."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from trial_kernels import LOAD_TRIAL

pytest.importorskip("numba")
pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="owners and modes of POSIX")

from gsfusion_nb.kernels.runtime.numba import installed_cache  # noqa: E402

_TRIAL = """
from numba import njit

@njit(cache=True)
def cube(x):
    return x * x * x
"""

_BEFORE = """
import importlib.util, os, pathlib, sys
import gsfusion_nb.kernels
from numba.core import event
from gsfusion_nb.kernels.runtime import numba as _

folder, may_write = pathlib.Path(sys.argv[1]), sys.argv[2] == "owner"
may = os.access
if not may_write:
    os.access = lambda path, mode: mode != os.W_OK and may(path, mode)
"""

_AFTER = """
for number in (3, 1.5):
    assert trial.cube(number) == number**3
print(Count.names.count("cube"))
"""

_PROCESS = _BEFORE + LOAD_TRIAL + _AFTER


def compiled(folder: Path, user: str) -> int:
    """How often a process compiles the trial: that of the owner of its source, or of one who keeps
    his own in the folder ``home``."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    if user != "owner":
        environment["NUMBA_CACHE_DIR"] = str(folder / "home")
    command = [sys.executable, "-c", _PROCESS, str(folder), user]
    process = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[-2000:]
    return int(process.stdout.split()[-1])


@pytest.mark.ci
def test_another_user_compiles_nothing_and_keeps_nothing(tmp_path):
    (tmp_path / "trial.py").write_text(_TRIAL)
    assert compiled(tmp_path, "owner") == 2
    (tmp_path / "__pycache__").chmod(0o755)
    assert compiled(tmp_path, "other") == 0
    assert not list(tmp_path.glob("home/**/*.nb*"))
    # code that others could have put there is not run
    (tmp_path / "__pycache__").chmod(0o777)
    assert compiled(tmp_path, "other") == 2
    assert list(tmp_path.glob("home/**/*.nb*"))
    # nor that of an older source
    (tmp_path / "__pycache__").chmod(0o755)
    (tmp_path / "trial.py").write_text(_TRIAL + "\n\nTHREE = 3\n")
    assert compiled(tmp_path, "other") == 2


@pytest.mark.parametrize(
    ("mode", "writable", "expected"),
    [(0o755, False, True), (0o755, True, False), (0o775, False, False), (0o757, False, False)],
)
def test_only_what_the_owner_alone_can_write_is_read(
    monkeypatch, tmp_path, mode, writable, expected
):
    source = tmp_path / "kernel.py"
    source.touch()
    folder = tmp_path / "__pycache__"
    folder.mkdir()
    folder.chmod(mode)
    monkeypatch.setattr(installed_cache.os, "access", lambda path, mode: writable)
    assert installed_cache.is_installed(folder, source) is expected


def test_without_a_folder_nothing_is_read(tmp_path):
    (tmp_path / "kernel.py").touch()
    assert not installed_cache.is_installed(tmp_path / "__pycache__", tmp_path / "kernel.py")
