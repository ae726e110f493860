"""JupyterLab on localhost and a headless Chromium, for tests that use a notebook as a person does.

Screenshots go to $GSNB_SCREENSHOTS.
"""

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from quick_run import quick

_PROJECT = Path(__file__).resolve().parents[2]
_NOTEBOOKS = _PROJECT / "notebooks"
_SETTINGS = {
    "@jupyterlab/apputils-extension/notification.jupyterlab-settings": '{"fetchNews": "false", '
    '"checkForUpdates": false, "doNotDisturbMode": true}',
    "@jupyterlab/notebook-extension/tracker.jupyterlab-settings": '{"windowingMode": "none"}',
}
_CHROMIUM_OPTIONS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-gpu",
]

_IDLE = "app?.shell.currentWidget?.sessionContext?.session?.kernel?.status === 'idle'"
_DONE = (
    "cells.filter(c => c.type === 'code').every(c => c.executionCount !== null && "
    "c.executionState !== 'running')"
)


def pytest_collection_modifyitems(items):
    """A test in a browser that fails is run once more, because a browser may stumble."""
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.flaky(reruns=1))


class Lab:
    """One server and one browser. ``open(cells)`` runs a new notebook and gives its page."""

    def __init__(
        self,
        browser: Any,
        folder: Path,
        port: int,
        token: str,
        *,
        under: str = "",
    ):
        self.browser = browser
        self.folder = folder
        self.port = port
        self.token = token
        self.under = under
        self.errors: list[str] = []
        """Uncaught errors of the pages."""
        self.requests: list[str] = []
        """Addresses outside this machine that a page asked for."""

    def open(self, cells: list[str], *, timeout_s: float = 180) -> Any:
        """A page with these code cells, all run without an error."""
        import nbformat

        notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(c) for c in cells])
        notebook.metadata["kernelspec"] = {
            "name": "python3",
            "display_name": "Python 3",
            "language": "python",
        }
        return self.open_notebook(notebook, timeout_s=timeout_s)

    def open_notebook(
        self,
        notebook: Any,
        *,
        timeout_s: float = 180,
        before: Callable[[Any], object] | None = None,
    ) -> Any:
        """A page with a notebook, all of its cells run without an error.

        Args:
            notebook: As nbformat reads it.
            timeout_s: For all cells together.
            before: What is done with the page before the cells run.
        """
        # it loads jsonschema: three seconds, in processes that only collect these tests, too
        import nbformat

        name = f"{uuid.uuid4().hex[:8]}.ipynb"
        nbformat.write(notebook, self.folder / name)
        page = self.browser.new_page(viewport={"width": 1280, "height": 1000})
        page.on("pageerror", lambda e: self.errors.append(str(e)))
        page.on("request", lambda r: self._note(r.url))
        page.goto(
            f"http://127.0.0.1:{self.port}/lab/tree/{self.under}{name}?reset&token={self.token}"
        )
        wait(page, _IDLE, timeout_s, "the kernel to be idle")
        if before is not None:
            before(page)
        page.evaluate("window.jupyterapp.commands.execute('notebook:run-all-cells')")
        wait(page, f"{_DONE} && {_IDLE} || failed", timeout_s, "all cells to have run")
        wrong = page.evaluate(f"(() => {{ {_PRELUDE} return failed; }})()")
        assert not wrong, f"a cell failed: {wrong}"
        return page

    def run(self, page: Any, code: str, *, timeout_s: float = 60) -> str:
        """Run code in the kernel of the page, out of sight; what it prints."""
        script = """async (code) => {
            const kernel = window.jupyterapp.shell.currentWidget.sessionContext.session.kernel;
            const future = kernel.requestExecute({ code, store_history: false });
            let text = "";
            future.onIOPub = ({ content }) => { text += content.text ?? content.evalue ?? ""; };
            await future.done;
            return text;
        }"""
        page.set_default_timeout(timeout_s * 1000)
        return page.evaluate(script, code).strip()

    def value(self, page: Any, expression: str) -> Any:
        """What a Python expression is in the kernel of the page."""
        return json.loads(self.run(page, f"import json; print(json.dumps({expression}))"))

    def chapter(
        self,
        name: str,
        until: str,
        *,
        without: tuple[str, ...] = (),
        changes: Mapping[str, str] | None = None,
    ) -> list[str]:
        """The student's code cells of a chapter in its quick version, up to the one that contains
        ``until``.

        Args:
            name: File in ``notebooks``.
            until: Words of the last cell.
            without: Cells with one of these words are left out.
            changes: Pieces of the cells -> what stands there instead.
        """
        chosen = []
        for cell in quick(json.loads((_NOTEBOOKS / name).read_text(encoding="utf-8")))["cells"]:
            source = "".join(cell["source"])
            for old, new in (changes or {}).items():
                source = source.replace(old, new)
            if cell["cell_type"] == "code" and not any(
                words in source for words in ("BEGIN SOLUTION", *without)
            ):
                chosen.append(source)
                if until in source:
                    return chosen
        raise AssertionError(f"no cell of {name} has {until!r}")

    @staticmethod
    def wait_for(
        condition: Callable[[], bool],
        what: str,
        timeout_s: float = 90,
    ) -> None:
        """Until a condition is true; the test fails when that takes too long."""
        until = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < until, f"waited {timeout_s} s for {what}"
            time.sleep(0.1)

    @staticmethod
    def screenshot(locator: Any, name: str) -> np.ndarray:
        """Bytes of what is shown of an element, also written to $GSNB_SCREENSHOTS/name.png. [H, W,
        3], blue first."""
        locator.scroll_into_view_if_needed()
        png = locator.screenshot()
        if folder := os.environ.get("GSNB_SCREENSHOTS"):
            Path(folder).mkdir(parents=True, exist_ok=True)
            (Path(folder) / f"{name}.png").write_bytes(png)
        return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)).astype(int)

    @staticmethod
    def move_slider(slider: Any, steps: int) -> None:
        """With the arrow keys, so many steps up, or down."""
        handle = slider.locator(".noUi-handle").first
        handle.scroll_into_view_if_needed()
        handle.focus()
        for _ in range(abs(steps)):
            slider.page.keyboard.press("ArrowRight" if steps > 0 else "ArrowLeft")

    def _note(self, url: str) -> None:
        server = (f"http://127.0.0.1:{self.port}/", f"ws://127.0.0.1:{self.port}/")
        in_page = ("data:", "blob:", "attachment:")  # an attachment is a part of its notebook
        if not url.startswith((*server, *in_page)):
            self.requests.append(url)


_PRELUDE = """
    const app = window.jupyterapp;
    const cells = [...(app?.shell.currentWidget?.content?.model?.cells ?? [])];
    const outputs = cells.flatMap(c => c.outputs?.toJSON() ?? []);
    const failed = outputs.find(o => o.output_type === "error")?.evalue;
"""


def wait(page: Any, condition: str, timeout_s: float, what: str) -> None:
    """Until a JavaScript expression over ``app``, ``cells`` and ``failed`` is true."""
    until = time.monotonic() + timeout_s
    while time.monotonic() < until:
        if page.evaluate(f"(() => {{ {_PRELUDE} return Boolean({condition}); }})()"):
            return
        time.sleep(0.1)
    pytest.fail(f"waited {timeout_s} s for {what}")


@pytest.fixture(scope="session")
def launch():
    """``launch(options)`` starts Chromium; a process has one playwright. Skips the test where
    either is missing."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    if chromium is None:
        pytest.skip("no chromium here (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as p:
        yield lambda options: p.chromium.launch(executable_path=chromium, args=options)


@pytest.fixture(scope="session")
def lab(launch, tmp_path_factory):
    """A ``Lab``; the test is skipped, with the reason, where its parts are missing."""
    pytest.importorskip("jupyterlab", reason="jupyterlab is not installed")
    home = tmp_path_factory.mktemp("lab")
    with _server(home) as (port, token):
        browser = launch(_CHROMIUM_OPTIONS)
        yield Lab(browser, home / "work", port, token)
        browser.close()


@pytest.fixture(scope="session")
def project_lab(lab, tmp_path_factory):
    """A ``Lab`` as ``make lab`` starts it: the root of its server is the project; notebooks go to a
    folder in it."""
    folder = _PROJECT / "runs" / f"browser-{uuid.uuid4().hex[:8]}"
    folder.mkdir(parents=True)
    with _server(tmp_path_factory.mktemp("project_lab"), _PROJECT) as (port, token):
        yield Lab(
            lab.browser, folder, port, token, under=folder.relative_to(_PROJECT).as_posix() + "/"
        )
    shutil.rmtree(folder)


@contextlib.contextmanager
def _server(home: Path, root: Path | None = None):
    """A JupyterLab of our own: free port, fresh settings, its own process group, which ends with
    it."""
    for name, text in _SETTINGS.items():
        path = home / "settings" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (home / "work").mkdir()
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    token = uuid.uuid4().hex
    places = {
        "JUPYTER_CONFIG_DIR": "config",
        "JUPYTER_DATA_DIR": "data",
        "JUPYTER_RUNTIME_DIR": "runtime",
        "JUPYTERLAB_SETTINGS_DIR": "settings",
        "JUPYTERLAB_WORKSPACES_DIR": "workspaces",
        "GSNB_COURSE_FILE": "course.json",
    }
    env = {k: v for k, v in os.environ.items() if k not in ("GSNB_VIEW", "GSNB_SMOKE")}
    env |= {name: str(home / folder) for name, folder in places.items()}
    command = [
        sys.executable,
        "-m",
        "jupyter",
        "lab",
        "--no-browser",
        "--allow-root",
        "--ip=127.0.0.1",
        f"--port={port}",
        "--ServerApp.port_retries=0",
        f"--IdentityProvider.token={token}",
        "--expose-app-in-browser",
        f"--ServerApp.root_dir={root or home / 'work'}",
        "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate",
    ]
    with (home / "server.log").open("w") as output:
        server = subprocess.Popen(
            command, env=env, stdout=output, stderr=output, start_new_session=True
        )
        try:
            _wait_for_server(f"http://127.0.0.1:{port}/api?token={token}", home / "server.log")
            yield port, token
        finally:
            os.killpg(server.pid, signal.SIGTERM)
            server.wait(timeout=20)


def _wait_for_server(url: str, output: Path) -> None:
    until = time.monotonic() + 90
    while time.monotonic() < until:
        with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=2):
            return
        time.sleep(0.2)
    pytest.fail(f"JupyterLab did not start in 90 s:\n{output.read_text()[-2000:]}")


@pytest.fixture(scope="session")
def book_site(tmp_path_factory) -> Path:
    """The web book: that of $GSNB_BOOK, or one that is built with the quiz of chapter 0."""
    from book.__main__ import build
    from quiz import bank, by_chapter

    if ready := os.environ.get("GSNB_BOOK"):
        return Path(ready).resolve()
    out = tmp_path_factory.mktemp("book") / "site"
    build(
        _PROJECT,
        out,
        "",
        by_chapter(q for q in bank() if q.chapter == 0),
    )
    return out


@pytest.fixture(scope="session")
def book_browser(launch):
    """A browser for pages that are files."""
    browser = launch(["--no-sandbox", "--disable-gpu"])
    yield browser
    browser.close()
