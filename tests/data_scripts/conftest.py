"""The scripts as modules, a server on this machine, the box room of the other tests, and no way to
a real host."""

import http.server
import importlib.util
import io
import socket
import stat
import sys
import tarfile
import threading
import time
import zipfile
from pathlib import Path
from types import ModuleType

import pytest
from box_room import box as box

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


class Site:
    """A web server: its files, and what it was asked."""

    def __init__(self):
        self.files: dict[str, bytes] = {}
        self.seen: list[str] = []
        self.address = ""


class Handler(http.server.BaseHTTPRequestHandler):
    site: Site

    def log_message(self, format, *args):
        pass

    def do_GET(self):
        self.site.seen.append(self.path)
        content = self.site.files.get(self.path)
        if content is None:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)


@pytest.fixture
def site(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    site = Site()
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), type("Bound", (Handler,), {"site": site})
    )
    site.address = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(
        target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True
    )
    thread.start()
    yield site
    server.shutdown()
    server.server_close()
    thread.join(5)


class Archives:
    """Makes small archives, good and bad."""

    def zip(
        self,
        files: dict[str, bytes],
        *,
        links: tuple[str, ...] = (),
    ) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as zipped:
            for name, content in files.items():
                info = zipfile.ZipInfo(name)
                info.filename = name  # as it is: the constructor cleans it
                info.external_attr = (
                    (stat.S_IFLNK if name in links else stat.S_IFREG) | 0o644
                ) << 16
                info.compress_type = zipfile.ZIP_DEFLATED
                zipped.writestr(info, content)
        return out.getvalue()

    def tgz(
        self,
        files: dict[str, bytes],
        *,
        links: tuple[str, ...] = (),
    ) -> bytes:
        out = io.BytesIO()
        with tarfile.open(fileobj=out, mode="w:gz") as tar:
            for name, content in files.items():
                info = tarfile.TarInfo(name)
                if name in links:
                    info.type = tarfile.SYMTYPE
                    info.linkname = "/etc/passwd"
                    content = b""
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
        return out.getvalue()


@pytest.fixture
def archives() -> Archives:
    return Archives()


@pytest.fixture(autouse=True)
def _no_real_host(monkeypatch):
    """Whoever asks for another host than this machine fails, and no person is there to be asked."""
    resolve = socket.getaddrinfo

    def only_here(host, *args, **options):
        assert host in ("127.0.0.1", "localhost"), f"a test asked for {host}"
        return resolve(host, *args, **options)

    monkeypatch.setattr(socket, "getaddrinfo", only_here)
    monkeypatch.setattr(sys, "stdin", None)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)


@pytest.fixture
def script():
    """``script("tum")`` is data_scripts/tum.py as a module."""
    return lambda name: load(SCRIPTS / f"{name}.py")


@pytest.fixture
def writer():
    """``writer("tum")`` writes the box room in a public layout, as the tests of that reader do."""
    return lambda name: load(TESTS / f"data/readers/test_{name}.py").write


@pytest.fixture
def files():
    """``files(root, "inside")``: the files below ``root`` by their path in an archive."""

    def collect(root: Path, inside: str = "") -> dict[str, bytes]:
        return {
            f"{inside}{p.relative_to(root).as_posix()}": p.read_bytes()
            for p in root.rglob("*")
            if p.is_file()
        }

    return collect
