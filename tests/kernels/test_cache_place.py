"""Where compiled kernels are kept when neither the package nor a home can be written."""

import os
import stat
from typing import Any

import pytest

pytest.importorskip("numba")

from numba import njit
from numba.core import config
from numba.core.caching import NullCache

from gsfusion_nb.kernels.runtime.numba import cache_place, shared_cache


@pytest.fixture(autouse=True)
def _numba_has_no_place(monkeypatch, tmp_path):
    """Only what is in the test's own folder can be written."""
    writable = cache_place._is_writable
    monkeypatch.setattr(config, "CACHE_DIR", "")
    monkeypatch.setattr(
        cache_place,
        "_is_writable",
        lambda folder: folder.is_relative_to(tmp_path) and writable(folder),
    )
    monkeypatch.setattr(cache_place.tempfile, "gettempdir", lambda: str(tmp_path / "tmp"))


def chosen() -> str:
    return getattr(config, "CACHE_DIR")  # noqa: B009 - numba makes its settings at run time


def test_the_toolkits_cache_is_next(monkeypatch, tmp_path, caplog):
    monkeypatch.setenv("GSFUSION_CACHE", str(tmp_path / "cache"))
    assert cache_place.choose_place() == str(tmp_path / "cache/kernels") == chosen()
    assert "compiled kernels are kept in" in caplog.text


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="modes of POSIX")
def test_then_a_temporary_folder_of_the_user_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("GSFUSION_CACHE", "/proc/nothing")
    folder = tmp_path / f"tmp/gsfusion_nb-{os.getuid()}/kernels"
    assert cache_place.choose_place() == str(folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    monkeypatch.setattr(config, "CACHE_DIR", "")
    folder.chmod(0o777)  # others could put machine code there
    assert cache_place.choose_place() == ""


def test_a_place_that_numba_is_given_stays(monkeypatch, tmp_path):
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    assert cache_place.choose_place() == ""
    assert chosen() == str(tmp_path)


def test_without_any_place_nothing_is_kept(monkeypatch):
    def refuse(*arguments):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(shared_cache.SharedCache, "__init__", refuse)
    add: Any = njit(cache=True)(lambda x: x + 1)
    assert add(1) == 2
    assert isinstance(add._cache, NullCache)
