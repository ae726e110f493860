"""Settings of Sphinx for the web book; ``python -m book``, in ``tools``, assembles the pages and
passes the title."""

import os
import sys

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


def setup(app):
    app.connect("html-page-context", _no_tree_on_source, priority=100)
    app.connect("html-page-context", _levels, priority=900)
    app.connect("autodoc-process-bases", _without_object)
    app.connect("autodoc-process-docstring", _plain_bars, priority=400)
