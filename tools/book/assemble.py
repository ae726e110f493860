"""The folder of pages that Sphinx reads, and the folder of files that the site holds beside
them."""

import ast
import dataclasses
import importlib
import inspect
import json
import posixpath
import re
import shutil
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from quiz import INTRODUCTION, Question

from gsfusion_nb.course.copies import FIRST
from gsfusion_nb.course.course import TITLES
from gsfusion_nb.course.short_path import SHORT_PATH, short_path
from gsfusion_nb.viewer.page_map import waiting_controls

from .chapters import Chapter
from .live_panels import panel_html
from .page_text import ROOT_PAGES, Places, in_the_book, raw

MOVING_MAP = '<div class="gsnb-moving-map"></div>'
"""Where a page of ``docs/book`` has the map of ``moving_map.py``."""


def moving_map_html(root: str) -> str:
    """The map that turns, with its poster; ``root`` is the way from the page to the root."""
    words = "The map of a room, made of Gaussians, seen from above without its ceiling"
    poster = (
        f'<img src="{root}_static/moving_map.webp" width="480" height="360" alt="{words}" '
        'fetchpriority="high">'
    )
    script = f'<script defer src="{root}_static/moving_map.js"></script>'
    return f'<div class="gsnb-moving-map">{poster}{waiting_controls()}</div>{script}'


def opening_bar(notebook: str) -> str:
    """HTML under a chapter's title: how to come from this page, which is read, to a copy in which
    one types; ``notebook`` is its path in the project."""
    name = escape(notebook.rpartition("/")[2])
    short = name == SHORT_PATH
    run = "gsfusion-nb course course --path short --open" if short else "make lab"
    next_step = "" if short else f", then open <code>course/{name}</code>"
    return (
        '<div class="gsnb-open"><span>On this page you read and predict. Where it says '
        "<code>...</code>, you type in JupyterLab.</span> "
        f'<a href="{name}" download>Download this notebook</a> '
        f"<details><summary>Run it in JupyterLab</summary>"
        f"<p>In the project's folder: <code>{run}</code>{next_step}: a copy with "
        f"empty exercises, which is yours to change. With pip: "
        f'<a href="../docs/install.html">installing</a>.</p></details></div>'
    )


def quiz_page(chapter: int, questions: Sequence[Question]) -> str:
    """The questions of a chapter with options to choose; a choice shows its reason."""
    parts = [f"# Quiz, chapter {chapter}: {TITLES[chapter]}\n\n{INTRODUCTION}"]
    for q in questions:
        rows = "".join(
            f'<label data-why="{escape(why)}"><input type="radio" name="{q.name}" value="{key}">'
            f"<span>{key}. {escape(text)}</span></label>"
            for key, text, why in zip("ABCD", q.options, q.reasons, strict=True)
        )
        said = f"{'The checker says: ' if q.code else ''}{escape(q.said)}"
        form = (
            '<form class="gsnb-quiz" '
            f'data-right="{"ABCD"[q.answer]}"><fieldset><legend>{escape(q.prompt)}</legend>{rows}'
            f'</fieldset><p role="status"></p><p class="gsnb-said" hidden>{said}</p></form>'
        )
        about = f"{escape(q.title)}\n\n```python\n{q.code}\n```" if q.code else escape(q.prompt)
        parts.append(f"## {q.name}\n\n{about}\n{raw(form)}")
    return "\n\n".join(parts) + "\n"


ROOMS = (
    "types",
    "config",
    "geometry",
    "tsdf",
    "gaussians",
    "render",
    "seeding",
    "optim",
    "tracking",
    "export",
    "evaluation",
    "mapping",
    "data",
    "recordings",
    "runs",
    "viz",
    "course",
    "compare",
    "backends",
)
"""Rooms whose names a reader uses, in the order of the floors; the other rooms serve these."""


def api_page(room: str, package: Path) -> str:
    """A page in Markdown for one room: the names that it passes on (``from .a import b as b``) or
    defines."""
    path = package / room / "__init__.py"
    name = f"gsfusion_nb.{room}"
    module = importlib.import_module(name)
    if path.exists():
        imports = [
            n
            for n in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(n, ast.ImportFrom)
        ]
        names = [
            alias.name for node in imports for alias in node.names if node.level and alias.asname
        ]
    else:
        names = [n for n, thing in vars(module).items() if getattr(thing, "__module__", "") == name]
    parts = [f"# {name}", "", inspect.cleandoc(module.__doc__ or "").partition("\n\n")[0]]
    for entry in sorted(
        {n for n in names if not n.startswith("_")},
        key=lambda n: (n.islower(), n.lower()),
    ):
        thing = getattr(module, entry)
        home = (
            thing.__name__ if inspect.ismodule(thing) else getattr(thing, "__module__", name)
        ).split(".")[1:2]
        if home != [room] and home and home[0] in ROOMS:
            continue  # passed on from another room
        if inspect.ismodule(thing):
            parts += [_directive("automodule", thing.__name__, ("members",))]
        elif inspect.isclass(thing):
            parts += [_directive("autoclass", f"{name}.{entry}", ("members",))]
        elif callable(thing):
            parts += [_directive("autofunction", f"{name}.{entry}")]
    return "\n".join(parts) + "\n"


def _directive(kind: str, name: str, options: Sequence[str] = ()) -> str:
    lines = "".join(f"   :{option}:\n" for option in options)
    return f"\n```{{eval-rst}}\n.. {kind}:: {name}\n{lines}```\n"


def api_index() -> str:
    """The page that lists the rooms."""
    room_names = "\n".join(ROOMS)
    return (
        "# API reference\n\nThe public names of each room, from their docstrings: shapes in "
        "brackets, units in the names, the source of a formula with its number.\nWhat a room is "
        "for: [architecture](../ARCHITECTURE.md).\n\n"
        f"```{{toctree}}\n:maxdepth: 1\n\n{room_names}\n```\n"
    )


_PANEL = re.compile(r"^!\[panel (\w+)\]\([^)]*\)$", re.MULTILINE)


def root_page(text: str, path: str, places: Places) -> str:
    """A page at the root of the book: its links lead from there, and a picture whose words are
    ``panel NAME`` becomes the panel.

    Args:
        text: Markdown.
        path: The page's path in the project.
        places: Where the other files are.
    """
    first = _PANEL.search(text)
    page = in_the_book(text, path, places).replace(MOVING_MAP, raw(moving_map_html("")))

    def panel(match: re.Match[str]) -> str:
        is_first = first is not None and match[0] == first[0]
        return raw(panel_html(match[1], "", chapter=False, first=is_first))

    return _PANEL.sub(panel, page)


QUIZ = "docs/teaching/quiz"
"""Where the book has the pages of questions, which are made when it is built."""
ARCHIVE = "gsfusion_nb_book.zip"
"""Name of the file with the whole site."""
_SHORT = f"notebooks/{SHORT_PATH}"
"""The notebook of the short path, which is made when the book is built."""
_PICTURES = (".jpg", ".png", ".svg", ".webp")


class Assembly:
    """Writes the pages of the book.

    Args:
        places: The project.
        pages: Folder for the pages; emptied first.
        extra: Folder for other files of the site; emptied first.
        quiz: Questions by chapter.
    """

    def __init__(
        self,
        places: Places,
        pages: Path,
        extra: Path,
        quiz: Mapping[int, Sequence[Question]],
    ):
        self.quiz = {f"{QUIZ}/chapter_{n:02}.md": quiz_page(n, own) for n, own in quiz.items()}
        self.places = dataclasses.replace(places, files=places.files | {*self.quiz, _SHORT})
        self.pages = pages
        self.extra = extra

    def write(self) -> None:
        """Write all of them."""
        for folder in (self.pages, self.extra):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        for path in sorted(self.places.files - ROOT_PAGES.keys()):
            if path.endswith(".ipynb") and self.places.is_page(path):
                self._chapter(path)
            elif self.places.is_page(path):
                text = self.quiz.get(path) or (self.places.root / path).read_text(encoding="utf-8")
                self._put(self.pages / path, in_the_book(text, path, self.places))
            elif path.startswith("docs/images/") and path.endswith(_PICTURES):
                self._put(self.pages / path, (self.places.root / path).read_bytes())
        for room in ROOMS:
            self._put(
                self.pages / f"api/{room}.md", api_page(room, self.places.root / "gsfusion_nb")
            )
        self._put(self.pages / "api/index.md", api_index())
        for path, page in ROOT_PAGES.items():
            text = (self.places.root / path).read_text(encoding="utf-8")
            self._put(self.pages / page, root_page(text, path, self.places))

    def _chapter(self, path: str) -> None:
        file = self.places.root / path
        content = (
            json.dumps(short_path(file.parent)).encode() if path == _SHORT else file.read_bytes()
        )
        opens_with_map = path.endswith((FIRST, SHORT_PATH))
        bar = (moving_map_html("../") if opens_with_map else "") + opening_bar(path)
        chapter = Chapter(json.loads(content), path, self.places, bar=bar)
        self._put(self.pages / f"{path.removesuffix('.ipynb')}.md", chapter.markdown())
        for address, picture in chapter.files.items():
            self._put(self.extra / posixpath.dirname(path) / address, picture)
        self._put(self.extra / path, content)

    def _put(self, path: Path, content: str | bytes) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
