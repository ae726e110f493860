"""Builds the site: pages, source pages, Sphinx, links checked, one file to download."""

import logging
import os
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Collection
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from ..files import atomic_file
from .assemble import ARCHIVE, Assembly
from .check_links import broken_links
from .places import places_of
from .settings import Settings
from .source_pages import source_css, write_source_pages
from .views.all_chapters import put_views, record_all, view_html
from .views.scripts import front_ends, style_sheet

log = logging.getLogger(__name__)

NEEDED = ("sphinx", "myst_parser", "furo", "mathjax")
_MATHJAX = ("tex-chtml-full.js", "a11y/assistive-mml.js", "output/chtml/fonts/woff-v2")


def missing() -> list[str]:
    """What the extra ``book`` brings and is not installed."""
    return [name for name in NEEDED if find_spec(name) is None]


def build(root: Path, out: Path, settings: Settings, *, views: Collection[str] | None = None) -> list[str]:
    """Build the book.

    Args:
        root: The project.
        out: The site; replaced. Work is kept in the folder ``.OUT_work`` beside it.
        settings: Of the book.
        views: Chapters whose live views are recorded ("03"), all by default; the others have their stored pictures.

    Returns:
        A sentence for each link that leads nowhere.

    Raises:
        RuntimeError: the extra is not installed, a view could not be recorded, or Sphinx failed.
    """
    if lacking := missing():
        raise RuntimeError(f"the book needs {', '.join(lacking)}; install them with: pip install 'gsfusion-nb[book]'")
    began = time.monotonic()
    work = out.parent / f".{out.name}_work"
    places = places_of(root)
    chapters = [root / path for path in sorted(places.files) if path.endswith(".ipynb") and places.is_page(path)]
    recorded = [path for path in chapters if views is None or path.name[:2] in views]
    listed = record_all(recorded, root / "docs/book/views.toml", work / "views")
    pages, extra, static = work / "pages", work / "extra", work / "static"
    Assembly(places, settings, pages, extra, lambda page, cell: view_html(listed, page, cell)).write()
    put_views(listed, work / "views", extra)
    _write_static(static)
    _sphinx(root, pages, extra, static, work / "doctrees", out, settings)
    ours = {path for path in places.files if path.startswith(("gsfusion_nb/", "kernels/")) and places.is_shown(path)}
    count = write_source_pages(places, ours | places.asked, out, settings.files)
    log.info("%d pages of source code", count)
    archive(out)
    wrong = broken_links(out)
    size = sum(f.stat().st_size for f in out.rglob("*") if f.is_file())
    log.info("book: %s, %.1f MB, %.0f s", out / "index.html", size / 1e6, time.monotonic() - began)
    return wrong


def _write_static(folder: Path) -> None:
    """Style sheets, scripts, and MathJax with its fonts, so that no page loads anything from elsewhere."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in files("gsfusion_nb.book").joinpath("static").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / "views.css").write_text(style_sheet(), encoding="utf-8")
    for name, text in front_ends().items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "source.css").write_text(source_css() + (folder / "source.css").read_text())
    mathjax = Path(str(files("mathjax").joinpath("static/mathjax/es5")))
    for name in _MATHJAX:
        target = folder / "mathjax" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (mathjax / name).is_dir() else shutil.copyfile)(mathjax / name, target)


def _sphinx(root: Path, pages: Path, extra: Path, static: Path, doctrees: Path, out: Path, settings: Settings) -> None:
    from .. import __version__

    shutil.rmtree(out, ignore_errors=True)
    environment = {
        **os.environ,
        "GSNB_BOOK_PACKAGE": str(root.resolve()),
        "GSNB_BOOK_STATIC": str(static.resolve()),
        "GSNB_BOOK_EXTRA": str(extra.resolve()),
    }
    options = [f"project={settings.title}", f"release={__version__}", f"html_title={settings.title}"]
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "html", "-c", str(root / "docs/book"), "-d", str(doctrees)]
    command += [part for option in options for part in ("-D", option)]
    done = subprocess.run([*command, str(pages), str(out)], env=environment, text=True, stderr=subprocess.PIPE)
    for line in done.stderr.splitlines():
        log.warning("%s", line)
    if done.returncode:
        raise RuntimeError("Sphinx could not build the book; its messages are above")
    (out / ".nojekyll").touch()  # GitHub Pages would leave out folders that begin with an underscore


def archive(site: Path) -> Path:
    """The whole site as a zip file inside it, to read without internet."""
    target = site / ARCHIVE
    with atomic_file(target) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as z:
        for file in sorted(site.rglob("*")):
            if file.is_file() and file not in (target, temporary):
                z.write(file, f"gsfusion_nb_book/{file.relative_to(site).as_posix()}")
    return target
