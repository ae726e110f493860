"""A page for each file of source, with a place for every line, so that the text can point at it."""

import os
import posixpath
from collections.abc import Iterable
from html import escape
from pathlib import Path

from .places import Places

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
