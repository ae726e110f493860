"""Settings of Sphinx for the web book; ``python -m book``, in ``tools``, assembles the pages and
passes the title."""

import os
import sys
from html import escape

from docutils import nodes
from markupsafe import Markup

sys.path.insert(0, os.environ["GSNB_BOOK_PACKAGE"])

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
source_suffix = {".md": "markdown"}
language = "en"

myst_enable_extensions = ["dollarmath", "amsmath", "html_image"]
myst_heading_anchors = 4
myst_dmath_double_inline = True
myst_update_mathjax = False
suppress_warnings = [
    "myst.header",
    "myst.xref_ambiguous",
    "misc.highlighting_failure",
    "ref.python",
]

mathjax_path = "mathjax/tex-chtml-full.js"
mathjax3_config = {
    "tex": {"inlineMath": [["\\(", "\\)"]], "displayMath": [["\\[", "\\]"]]},
    "options": {
        "ignoreHtmlClass": "tex2jax_ignore|mathjax_ignore|document",
        "processHtmlClass": "math",
    },
}

autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
autodoc_default_options = {"show-inheritance": False}
autodoc_preserve_defaults = True
autodoc_inherit_docstrings = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_favicon = "icon.svg"
html_show_sphinx = False
html_show_copyright = False
html_show_sourcelink = False
html_copy_source = False
html_show_search_summary = False  # it reads other pages, which a page opened from a folder may not
html_search_scorer = os.path.join(os.path.dirname(__file__), "scorer.js")
html_permalinks_icon = "#"
html_static_path = [os.environ["GSNB_BOOK_STATIC"]]
html_extra_path = [os.environ["GSNB_BOOK_EXTRA"]]
html_css_files = ["book.css"]
html_js_files = [("book.js", {"defer": "defer"})]
templates_path = ["templates"]
pygments_style = "default"
pygments_dark_style = "github-dark"


def _plain_bars(app, what, name, obj, options, lines):
    """Docstrings write |x| for a length, which Sphinx would take for one of its own marks."""
    for number, line in enumerate(lines):
        parts = line.split("``")
        lines[number] = "``".join(
            p if k % 2 else p.replace("|", "\\|") for k, p in enumerate(parts)
        )


def _without_object(app, name, obj, options, bases):
    """Every class is derived from ``object``: that is no news."""
    bases[:] = [base for base in bases if base is not object]


def _levels(app, pagename, templatename, context, doctree):
    """The theme's captions of lists of pages are headings without a level, which screen readers
    need."""
    if tree := context.get("furo_navigation_tree"):
        context["furo_navigation_tree"] = tree.replace(
            'role="heading"', 'role="heading" aria-level="2"'
        )


def _no_tree_on_source(app, pagename, templatename, context, doctree):
    """Pages of source get no list of all pages: making it for each of them took a third of the
    time."""
    if pagename.startswith("_modules/"):
        context.pop("toctree", None)


HOME_TITLE = "3D Gaussian splatting and RGB-D mapping: a course in your browser"
HOME_DESCRIPTION = (
    "3D Gaussian splatting in six panels to drag, and a course on mapping a room with it: thirteen "
    "chapters in Jupyter, on a laptop without a GPU."
)
_LONGEST_DESCRIPTION = 200
_ADDRESS = os.environ.get("GSNB_BOOK_ADDRESS", "")


def _description(doctree):
    """The first sentences of a page."""
    paragraph = next(iter(doctree.findall(nodes.paragraph)), None) if doctree else None
    words = " ".join(paragraph.astext().split()) if paragraph is not None else ""
    if len(words) <= _LONGEST_DESCRIPTION:
        return words
    sentences = words[:_LONGEST_DESCRIPTION].rpartition(". ")[0]
    return (
        f"{sentences}." if sentences else f"{words[:_LONGEST_DESCRIPTION].rpartition(' ')[0]} ..."
    )


def _share(app, pagename, templatename, context, doctree):
    """What other sites and search engines show of a page: title, description, picture."""
    is_home = pagename == app.config.root_doc
    title = HOME_TITLE if is_home else Markup(context.get("title", "")).striptags()
    tags = {"og:title": title, "og:type": "website", "og:site_name": app.config.project}
    description = HOME_DESCRIPTION if is_home else _description(doctree)
    if description:
        tags["og:description"] = description
    if _ADDRESS:
        tags["og:url"] = f"{_ADDRESS}{pagename}.html" if not is_home else _ADDRESS
        tags["og:image"] = f"{_ADDRESS}_static/share.jpg"
        tags["og:image:width"] = "1200"
        tags["og:image:height"] = "630"
    lines = [f'<meta property="{name}" content="{escape(text)}">' for name, text in tags.items()]
    if _ADDRESS:
        lines.append('<meta name="twitter:card" content="summary_large_image">')
    if description:
        lines.append(f'<meta name="description" content="{escape(description)}">')
    context["metatags"] = context.get("metatags", "") + "".join(lines)
    if is_home:
        context["home_title"] = HOME_TITLE


def setup(app):
    app.connect("html-page-context", _share)
    app.connect("html-page-context", _no_tree_on_source, priority=100)
    app.connect("html-page-context", _levels, priority=900)
    app.connect("autodoc-process-bases", _without_object)
    app.connect("autodoc-process-docstring", _plain_bars, priority=400)
