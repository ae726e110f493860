"""A web server on this machine that misbehaves on request, and archives that do."""

import http.server
import io
import re
import stat
import tarfile
import threading
import zipfile
from collections.abc import Callable

import pytest

from gsfusion_nb.data.fetch.download import Transfer

Fault = Callable[["Handler", bytes], None]


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves ``site.files`` with entity tags and ranges, unless a fault is planned for the request."""

    site: "Site"

    def log_message(self, format, *args):
        pass

    def do_HEAD(self):
        self.site.seen.append(("HEAD", self.path, None))
        if self.path in self.site.moved:
            return self.head(302, 0, Location=self.site.moved[self.path])
        content = self.site.files.get(self.path)
        if content is None:
            return self.send_error(404)
        return self.head(200, len(content))

    def do_GET(self):
        self.site.seen.append(("GET", self.path, self.headers.get("Range")))
        faults = self.site.faults.get(self.path, [])
        fault = faults.pop(0) if len(faults) > 1 else faults[0] if faults else None  # the last one stays
        content = self.site.files.get(self.path)
        if fault is not None:
            return fault(self, content or b"")
        if content is None:
            return self.send_error(404)
        return self.send(content)

    def head(self, status: int, length: int | None, **headers: str) -> None:
        self.send_response(status)
        headers = {"Content-Type": "application/octet-stream", "ETag": self.site.tag(self.path), **headers}
        if length is not None:
            headers["Content-Length"] = str(length)
        for name, value in headers.items():
            if value:
                self.send_header(name.replace("_", "-"), value)
        self.end_headers()

    def send(self, content: bytes, *, stop: int | None = None) -> None:
        """The range that was asked for, if the file is still the same; only up to byte ``stop`` of the file."""
        start = self.start()
        if start >= len(content) and start:
            return self.head(416, 0, Content_Range=f"bytes */{len(content)}")
        place = f"bytes {start}-{len(content) - 1}/{len(content)}"
        self.head(206 if start else 200, len(content) - start, Content_Range=place if start else "")
        self.wfile.write(content[start:stop])
        return None

    def start(self) -> int:
        found = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        return int(found[1]) if found and self.headers.get("If-Range") == self.site.tag(self.path) else 0


class Site:
    """What the server holds, what goes wrong, and what it was asked."""

    def __init__(self):
        self.files: dict[str, bytes] = {}
        self.faults: dict[str, list[Fault | None]] = {}
        """Per path, one fault per request; None behaves; the last one is for all requests that follow."""
        self.seen: list[tuple[str, str, str | None]] = []
        self.moved: dict[str, str] = {}
        """Where a question for the size is sent on to."""
        self.tagged = True
        self.address = ""
        self.closing = threading.Event()

    def tag(self, path: str) -> str:
        return f'"{hash(self.files.get(path))}"' if self.tagged else ""

    def ranges(self) -> list[str | None]:
        """The ranges asked for, request by request."""
        return [asked for method, _, asked in self.seen if method == "GET"]


def cut(after: int) -> Fault:
    """The connection ends at a byte of the file."""
    return lambda handler, content: handler.send(content, stop=max(after, handler.start()))


def status(code: int, **headers: str) -> Fault:
    """An error."""
    return lambda handler, content: handler.head(code, 0, **headers)


def redirect(to: str) -> Fault:
    """Somewhere else."""
    return status(302, Location=to)


def corrupt(handler: Handler, content: bytes) -> None:
    """One bit is another."""
    handler.send(content[:5] + bytes([content[5] ^ 1]) + content[6:])


def no_ranges(handler: Handler, content: bytes) -> None:
    """Always the whole file."""
    handler.head(200, len(content))
    handler.wfile.write(content)


def no_ranges_cut(handler: Handler, content: bytes) -> None:
    """Always from the beginning, never to the end."""
    handler.head(200, len(content))
    handler.wfile.write(content[: len(content) // 2])


def longer(handler: Handler, content: bytes) -> None:
    """Promises ten bytes more than there are."""
    start = handler.start()
    if start >= len(content):
        return handler.head(416, 0, Content_Range=f"bytes */{len(content)}")
    total = len(content) + 10
    handler.head(
        206 if start else 200, total - start, Content_Range=f"bytes {start}-{total - 1}/{total}" if start else ""
    )
    handler.wfile.write(content[start:])
    return None


def shorter(handler: Handler, content: bytes) -> None:
    """Promises ten bytes less than it sends."""
    handler.head(200, len(content) - 10)
    handler.wfile.write(content)


def unsized(handler: Handler, content: bytes) -> None:
    """Does not say how much comes."""
    handler.head(200, None)
    handler.wfile.write(content)


def chunked_cut(handler: Handler, content: bytes) -> None:
    """In chunks, the first of which is not whole."""
    handler.protocol_version, handler.close_connection = "HTTP/1.1", True
    handler.head(200, None, Transfer_Encoding="chunked")
    handler.wfile.write(b"%x\r\n" % len(content) + content[:1000])


def endless(handler: Handler, content: bytes) -> None:
    """Does not say how much comes, and does not end."""
    handler.head(200, None)
    try:
        while not handler.site.closing.is_set():
            handler.wfile.write(bytes(1 << 16))
    except OSError:
        pass


def stall(after: int) -> Fault:
    """Silence from a byte of the file on."""

    def fault(handler: Handler, content: bytes) -> None:
        handler.send(content, stop=max(after, handler.start()))
        handler.wfile.flush()
        handler.site.closing.wait(5)

    return fault


def drip(handler: Handler, content: bytes) -> None:
    """A byte now and then, never silent for long."""
    handler.head(200, len(content))
    for i in range(len(content)):
        if handler.site.closing.wait(0.05):
            return
        try:
            handler.wfile.write(content[i : i + 1])
        except OSError:
            return


def wrong_place(handler: Handler, content: bytes) -> None:
    """Another range than was asked for."""
    start = handler.start()
    handler.head(206, len(content), Content_Range=f"bytes {start + 1}-{len(content) - 1}/{len(content)}")
    handler.wfile.write(content)


def web_page(handler: Handler, content: bytes) -> None:
    """A login page, as hotels and moved files give."""
    page = b"<html>Please log in</html>"
    handler.head(200, len(page), **{"Content-Type": "text/html; charset=utf-8"})
    handler.wfile.write(page)


def encoded(handler: Handler, content: bytes) -> None:
    """Compressed on the way, though nobody asked."""
    handler.head(200, len(content), Content_Encoding="gzip")
    handler.wfile.write(content)


@pytest.fixture
def site(monkeypatch):
    """A web server with files and faults."""
    monkeypatch.setenv("no_proxy", "*")
    site = Site()
    handler = type("Bound", (Handler,), {"site": site})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    site.address = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    yield site
    site.closing.set()
    server.shutdown()
    server.server_close()
    thread.join(5)


@pytest.fixture
def waits() -> list[float]:
    """The waits that a transfer asked for, seconds."""
    return []


@pytest.fixture
def transfer(waits):
    """A transfer that does not really wait between attempts."""
    return Transfer(timeout_s=0.4, attempts=3, sleep=waits.append)


class Archives:
    """Makes small archives, good and bad."""

    def zip(self, files: dict[str, bytes], *, modes: dict[str, int] | None = None) -> bytes:
        """A zip; ``modes``: type bits of members that are not a regular files."""
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as zipped:
            for name, content in files.items():
                self.add(zipped, name, content, (modes or {}).get(name, stat.S_IFREG))
        return out.getvalue()

    def add(self, zipped: zipfile.ZipFile, name: str, content: bytes, mode: int = stat.S_IFREG) -> None:
        info = zipfile.ZipInfo(name)
        info.filename = name  # as it is: the constructor cleans it
        info.external_attr = (mode | 0o644) << 16
        info.compress_type = zipfile.ZIP_DEFLATED
        zipped.writestr(info, content)

    def tgz(self, files: dict[str, bytes], *, kinds: dict[str, bytes] | None = None) -> bytes:
        """A gzipped tar; ``kinds``: tarfile types of members that are not a regular files."""
        out = io.BytesIO()
        with tarfile.open(fileobj=out, mode="w:gz") as tar:
            for name, content in files.items():
                info = tarfile.TarInfo(name)
                info.type = (kinds or {}).get(name, tarfile.REGTYPE)
                info.linkname = "../../etc/passwd" if info.type != tarfile.REGTYPE else ""
                info.size = len(content) if info.type == tarfile.REGTYPE else 0
                tar.addfile(info, io.BytesIO(content))
        return out.getvalue()


@pytest.fixture
def archives() -> Archives:
    """Makes archives."""
    return Archives()
