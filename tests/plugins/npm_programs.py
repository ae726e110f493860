"""Programs from npm that open our files, for tests: where they are, and a small server for pages
that use them.

They are not installed by the tests: install them in any folder and name it in $GSNB_NPM, see
``INSTALL``.
"""

import functools
import http.server
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

INSTALL = (
    "npm install --prefix DIR axe-core playcanvas @babylonjs/core @babylonjs/loaders "
    "gltf-validator @playcanvas/splat-transform"
)
PAGES = Path(__file__).parents[1] / "browser" / "engines"


def npm_folder(*packages: str) -> Path:
    """The folder with these packages; the test is skipped, with the reason, where there is none."""
    folder = Path(os.environ.get("GSNB_NPM", ""), "node_modules")
    lacking = [name for name in packages if not (folder / name / "package.json").is_file()]
    if "GSNB_NPM" not in os.environ or lacking or shutil.which("node") is None:
        pytest.skip(
            f"no {' and '.join(lacking or packages)} from npm here; {INSTALL}, then GSNB_NPM=DIR"
        )
    return folder


def splat_transform(*arguments: str | Path) -> str:
    """Run splat-transform; returns what it printed."""
    folder = npm_folder("@playcanvas/splat-transform")
    command = [
        "node",
        folder / "@playcanvas/splat-transform/bin/cli.mjs",
        *arguments,
        "-w",
        "-g",
        "cpu",
    ]
    done = subprocess.run(
        list(map(str, command)),
        capture_output=True,
        text=True,
        timeout=3600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@contextmanager
def server(files: Path, node_modules: Path) -> Iterator[str]:
    """Address of a server on this machine that has ``/node_modules``, the pages, and ``files`` at
    ``/files``."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            path = path.split("?")[0].lstrip("/")
            for prefix, folder in (("node_modules/", node_modules), ("files/", files)):
                if path.startswith(prefix):
                    return str(folder / path.removeprefix(prefix))
            return str(PAGES / path)

        def log_message(self, format, *args):
            pass

    Handler.extensions_map = {
        **Handler.extensions_map,
        ".mjs": "text/javascript",
        ".js": "text/javascript",
    }
    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Handler)
    ) as http_server:
        threading.Thread(target=http_server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{http_server.server_address[1]}"
        http_server.shutdown()
