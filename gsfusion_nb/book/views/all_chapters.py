"""Records the views of all chapters, two at a time, each in a process of its own, and only what has changed."""

import hashlib
import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from typing import Any

from ...strict_json import read_object
from .record import cells_to_run, kernel_views, wanted_views
from .recorded import needs_kernel, placeholder

log = logging.getLogger(__name__)

Listed = dict[str, dict[str, dict[str, Any]]]
"""Name of a notebook -> id of a cell -> kind, words and size of its view."""


def record_all(notebooks: Iterable[Path], views: Path, out: Path, *, jobs: int = 2) -> Listed:
    """Record the views of some chapters.

    Args:
        notebooks: Their files.
        views: ``views.toml``.
        out: Folder with a folder for each chapter, kept between builds.
        jobs: Processes at the same time.

    Raises:
        RuntimeError: a view could not be recorded; the message has the last lines of the process.
    """
    package = _fingerprint()

    def one(notebook: Path) -> tuple[str, dict[str, Any]]:
        folder = out / notebook.stem
        wanted = wanted_views(views, notebook.name[:2])
        still = {cell: {"kernel": why} for cell, why in kernel_views(views, notebook.name[:2]).items()}
        if not wanted:
            return notebook.name, still
        asked = json.dumps([package, wanted, cells_to_run(read_object(notebook, "a notebook"), wanted)])
        key = hashlib.sha256(asked.encode()).hexdigest()
        mark = folder / "key"
        if not mark.exists() or mark.read_text() != key:
            _record(notebook, views, folder)
            mark.write_text(key)
        return notebook.name, {**json.loads((folder / "views.json").read_text(encoding="utf-8")), **still}

    with ThreadPoolExecutor(jobs) as pool:
        return dict(pool.map(one, notebooks))


def _record(notebook: Path, views: Path, folder: Path) -> None:
    command = [sys.executable, "-m", "gsfusion_nb.book.views.record", *map(str, (notebook, views, folder))]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, text=True, stderr=subprocess.PIPE)
    if done.returncode:
        last = "\n".join(done.stderr.splitlines()[-12:])
        raise RuntimeError(f"the views of {notebook.name} could not be recorded ({views}):\n{last}")
    log.info("%s", done.stderr.strip().splitlines()[-1])


def _fingerprint() -> str:
    """Of the package's code, without that of the pages: what a view shows depends on it."""
    root = Path(str(files("gsfusion_nb")))
    found = hashlib.sha256()
    for path in sorted([*root.rglob("*.py"), *root.parent.joinpath("kernels").rglob("*.py")]):
        name = path.relative_to(root.parent).as_posix()
        if not name.startswith("gsfusion_nb/book/") or "/views/" in name:
            found.update(name.encode() + path.read_bytes())
    return found.hexdigest()


def put_views(listed: Listed, recorded: Path, extra: Path) -> None:
    """Link or copy the files of the views to where the pages look for them."""
    for notebook, cells in listed.items():
        stem = Path(notebook).stem
        for source in (recorded / stem).rglob("*") if any("kind" in cell for cell in cells.values()) else ():
            if source.is_file() and source.name not in ("key", "views.json"):
                target = extra / "notebooks" / f"{stem}_files" / source.relative_to(recorded / stem)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(source.read_bytes())


def view_html(listed: Listed, page: str, cell: str) -> str | None:
    """HTML of a view that was recorded, or needs a kernel, for ``Chapter``."""
    notebook = page.rpartition("/")[2]
    found = listed.get(notebook, {}).get(cell)
    if found is None:
        return None
    return (
        needs_kernel(found["kernel"]) if "kernel" in found else placeholder(found, f"{Path(notebook).stem}_files", cell)
    )
