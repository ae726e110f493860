"""Builds the site: pages, source pages, Sphinx, links checked, one file to download."""

import logging
import os
import posixpath
import re
import shutil
import subprocess
import sys
import time
import urllib.parse
import zipfile
from collections.abc import Collection, Iterable, Mapping
from html import escape
from html.parser import HTMLParser
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from gsfusion_nb.files import atomic_file

from .assemble import ARCHIVE, Assembly, Settings
from .pages import Places, places_of
from .record import put_views, record_all, view_html
from .recorded import STATIC, front_ends, style_sheet

_ELSEWHERE = re.compile(r"^(?:[a-z][a-z0-9+.-]*:|//)", re.IGNORECASE)
_LOADING = {("script", "src"), ("img", "src"), ("link", "href"), ("iframe", "src"), ("source", "src"), ("video", "src")}
_CSS_URL = re.compile(r"""url\(\s*["']?((?:https?:)?//[^"')\s]+)|@import\s+["']((?:https?:)?//[^"']+)""")


class _Page(HTMLParser):
    """Targets and places of one page."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.places: set[str] = set()
        self.targets: list[str] = []
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "link" and not {"stylesheet", "icon", "preload", "script"} & set(
            (dict(attrs).get("rel") or "").split()
        ):
            return
        for name, value in attrs:
            if not value:
                continue
            if name == "id" or (name == "name" and tag == "a"):
                self.places.add(value)
            elif name in ("href", "src") or (name == "data-src" and not value.startswith("data:")):
                elsewhere = bool(_ELSEWHERE.match(value))
                if not elsewhere:
                    self.targets.append(value)
                elif (tag, name) in _LOADING and not value.startswith("data:"):
                    self.loaded.append(value)


def read_page(path: Path) -> _Page:
    """Targets and places of a page."""
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    return page


def broken_links(site: Path) -> list[str]:
    """A sentence for each target inside the site that does not exist, and for each file that comes from elsewhere."""
    site = site.resolve()
    pages = {path: read_page(path) for path in sorted(site.rglob("*.html"))}
    wrong = []
    for path, page in pages.items():
        name = path.relative_to(site).as_posix()
        wrong += [f"{name} loads {address} from another server" for address in page.loaded]
        for target in sorted(set(page.targets)):
            address, _, place = target.partition("#")
            file = (path.parent / urllib.parse.unquote(address.partition("?")[0])).resolve() if address else path
            file = file / "index.html" if file.is_dir() else file
            if not file.is_file():
                wrong.append(f"{name} leads to {target}: no such file")
            elif site not in file.parents:
                wrong.append(f"{name} leads to {target}, outside the site")
            elif place and file in pages and urllib.parse.unquote(place) not in pages[file].places:
                wrong.append(f"{name} leads to {target}: the page has no such place")
    for sheet in sorted(site.rglob("*.css")):
        for found in _CSS_URL.findall(sheet.read_text(encoding="utf-8")):
            wrong.append(f"{sheet.relative_to(site).as_posix()} loads {''.join(found)} from another server")
    return wrong


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{path}</title><link rel="stylesheet" href="{up}_static/source.css">
<script>document.documentElement.dataset.theme = localStorage.getItem("theme") || "auto";</script></head>
<body><header><a href="{up}index.html">The book</a> <h1>{path}</h1>{elsewhere}</header>
<main tabindex="0">{code}</main></body></html>
"""


def write_source_pages(places: Places, paths: Iterable[str], out: Path, repository: str) -> int:
    """Write ``out/source/PATH.html`` for each path; how many.

    Args:
        places: The project.
        paths: Of the files.
        out: Root of the site.
        repository: Address of the files in a repository, ending in "/", or "".
    """
    from pygments import highlight
    from pygments.formatters import HtmlFormatter
    from pygments.lexers import TextLexer, get_lexer_for_filename
    from pygments.util import ClassNotFound

    written = 0
    for path in sorted(paths):
        text = (places.root / path).read_text(encoding="utf-8")
        try:
            lexer = get_lexer_for_filename(path)
        except ClassNotFound:
            lexer = TextLexer()
        look = HtmlFormatter(linenos="inline", linespans="L", anchorlinenos=False, wrapcode=True)
        page = f"source/{path}.html"
        up = os.path.relpath(".", posixpath.dirname(page)).replace(os.sep, "/") + "/"
        there = f' <a href="{escape(repository + path)}">in the repository</a>' if repository else ""
        file = out / page
        file.parent.mkdir(parents=True, exist_ok=True)
        code = highlight(text, lexer, look)
        file.write_text(_PAGE.format(path=escape(path), up=up, elsewhere=there, code=code), encoding="utf-8")
        written += 1
    return written


def source_css() -> str:
    """Colours of the code on a light and on a dark page."""
    from pygments.formatters import HtmlFormatter

    light = HtmlFormatter(style="default").get_style_defs("main")
    dark = HtmlFormatter(style="github-dark").get_style_defs('[data-theme="dark"] main')
    night = HtmlFormatter(style="github-dark").get_style_defs('[data-theme="auto"] main')
    return f"{light}\n{dark}\n@media (prefers-color-scheme: dark) {{\n{night}\n}}\n"


log = logging.getLogger(__name__)

NEEDED = ("sphinx", "myst_parser", "furo", "mathjax")
_MATHJAX = ("tex-chtml-full.js", "a11y/assistive-mml.js", "output/chtml/fonts/woff-v2")


def missing() -> list[str]:
    """What the extra ``book`` brings and is not installed."""
    return [name for name in NEEDED if find_spec(name) is None]


def build(
    root: Path,
    out: Path,
    settings: Settings,
    *,
    views: Collection[str] | None = None,
    quiz: Mapping[str, str] | None = None,
) -> list[str]:
    """Build the book.

    Args:
        root: The project.
        out: The site; replaced. Work is kept in the folder ``.OUT_work`` beside it.
        settings: Of the book.
        views: Chapters whose live views are recorded ("03"), all by default; the others have their stored pictures.
        quiz: Pages of questions, and ``answers.md``, by file name; none by default.

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
    Assembly(places, settings, pages, extra, lambda page, cell: view_html(listed, page, cell), quiz).write()
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
    for file in STATIC.iterdir():
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
    from gsfusion_nb import __version__

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
