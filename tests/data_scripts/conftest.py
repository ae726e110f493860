"""The scripts as modules, the misbehaving server and the box room of the other tests, and no way to a real host."""

import importlib.util
import socket
import sys
from pathlib import Path
from types import ModuleType

import pytest

TESTS = Path(__file__).resolve().parents[1]
SCRIPTS = TESTS.parent / "data_scripts"


def load(path: Path) -> ModuleType:
    """A Python file as a module under a name of its own."""
    spec = importlib.util.spec_from_file_location(f"loaded_{path.parent.name}_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_hostile = load(TESTS / "data/fetch/conftest.py")
site, archives = _hostile.site, _hostile.archives
box = load(TESTS / "data/conftest.py").box


@pytest.fixture(autouse=True)
def _no_real_host(monkeypatch):
    """Whoever asks for another host than this machine fails, and no person is there to be asked."""
    resolve = socket.getaddrinfo

    def only_here(host, *args, **options):
        assert host in ("127.0.0.1", "localhost"), f"a test asked for {host}"
        return resolve(host, *args, **options)

    monkeypatch.setattr(socket, "getaddrinfo", only_here)
    monkeypatch.setattr(sys, "stdin", None)


@pytest.fixture
def script():
    """``script("tum")`` is data_scripts/tum.py as a module."""
    return lambda name: load(SCRIPTS / f"{name}.py")


@pytest.fixture
def hostile():
    """Faults of the server."""
    return _hostile


@pytest.fixture
def writer():
    """``writer("tum")`` writes the box room in a public layout, as the tests of that reader do."""
    return lambda name: load(TESTS / f"data/readers/test_{name}.py").write


@pytest.fixture
def copied_scene():
    """The module that writes a ScanNet++ scene as it is handed out."""
    return load(TESTS / "data/convert/test_scannetpp_scene.py")


@pytest.fixture
def files():
    """``files(root, "inside")``: the files below ``root`` by their path in an archive."""

    def collect(root: Path, inside: str = "") -> dict[str, bytes]:
        return {f"{inside}{p.relative_to(root).as_posix()}": p.read_bytes() for p in root.rglob("*") if p.is_file()}

    return collect
