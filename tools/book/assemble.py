"""The folder of pages that Sphinx reads, and the folder of files that the site holds beside them."""

import ast
import dataclasses
import importlib
import inspect
import posixpath
import re
import shutil
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.util import resolve_name
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from urllib.parse import quote

from gsfusion_nb.files import atomic_file, read_object

from .chapters import Chapter
from .pages import Places, in_the_book, raw

_GITHUB = re.compile(r"https://github\.com/([\w.-]+/[\w.-]+)")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of the book."""

    title: str = "gsfusion_nb"
    repository: str = ""
    """Address of the project's repository without a slash at its end; "" leaves all links to it out."""
    branch: str = "main"
    """Branch that the links lead to."""

    def __post_init__(self) -> None:
        if self.repository and not re.fullmatch(r"https?://[^\s]+[^\s/]", self.repository):
            raise ValueError(
                f"repository must be an address such as https://github.com/OWNER/NAME, got {self.repository!r}"
            )

    @property
    def files(self) -> str:
        """Address below which the repository shows its files, with a slash at its end; "" without a repository."""
        return f"{self.repository}/blob/{self.branch}/" if self.repository else ""

    def launches(self, notebook: str) -> dict[str, str]:
        """Name of a service that runs a notebook -> address. Only for a repository on GitHub, which both can read."""
        match = _GITHUB.fullmatch(self.repository)
        if match is None:
            return {}
        return {
            "Binder": f"https://mybinder.org/v2/gh/{match[1]}/{self.branch}?labpath={quote(notebook, safe='')}",
            "Colab": f"https://colab.research.google.com/github/{match[1]}/blob/{self.branch}/{quote(notebook)}",
        }


def read_settings(path: Path, repository: str = "") -> Settings:
    """Settings from a file.

    Args:
        path: The file.
        repository: Takes the place of the file's address, if given.

    Raises:
        ValueError: a setting that does not exist, or a wrong value.
    """
    given = tomllib.loads(path.read_text(encoding="utf-8"))
    known = [field.name for field in dataclasses.fields(Settings)]
    for name, value in given.items():
        if name not in known or not isinstance(value, str):
            raise ValueError(f"{path}: {name} = {value!r}; expected a text for one of {', '.join(known)}")
    return Settings(**{**given, **({"repository": repository} if repository else {})})


def opening_bar(notebook: str, settings: Settings) -> str:
    """HTML under a chapter's title.

    Args:
        notebook: Path of the notebook in the project.
        settings: With a repository, there are links to services.
    """
    name = notebook.rpartition("/")[2]
    links = [f'<a href="{escape(url)}">Open in {service}</a>' for service, url in settings.launches(notebook).items()]
    colab = _COLAB.format(repository=escape(settings.repository)) if links else ""
    return (
        f'<div class="gsnb-open"><a href="{escape(name)}" download>Download this notebook</a> '
        f"{' '.join(links)}<details><summary>Run it in JupyterLab</summary>"
        f"<p>In the project's folder: <code>make lab</code>, then open <code>course/{escape(name)}</code>: a copy with "
        f"empty exercises, which is yours to change. With pip: "
        f'<a href="../docs/install.html">installing</a>.</p>{colab}</details></div>'
    )


_COLAB = (
    "<p>In Colab, first run a new cell with <code>%pip install git+{repository}</code>, and restart the runtime when "
    "it asks. Binder installs the package itself, which takes some minutes at the first start.</p>"
)


_ANSWER = re.compile(r"^\| `([\w-]+)` \| ([A-D]) \| (.+) \|$", re.MULTILINE)
_QUESTION = re.compile(r"^\*\*([\w-]+)\*\*\n(.*?)((?:^- [A-D]\. [^\n]*\n?)+)", re.MULTILINE | re.DOTALL)
_OPTION = re.compile(r"^- ([A-D])\. (.*)$", re.MULTILINE)


def with_answers(questions: str, answers: str) -> str:
    """A page of questions whose options can be chosen; the checker's sentence comes after the choice.

    Args:
        questions: ``chapter_NN.md``.
        answers: ``answers.md``.

    Raises:
        ValueError: a question has no answer.
    """
    from markdown_it import MarkdownIt

    inline = MarkdownIt().renderInline
    known = {name: (letter, said) for name, letter, said in _ANSWER.findall(answers)}

    def form(match: re.Match[str]) -> str:
        name, asked, options = match.groups()
        if name not in known:
            raise ValueError(f"answers.md has no answer to {name}")
        letter, said = known[name]
        rows = "".join(
            f'<label><input type="radio" name="{name}" value="{key}"><span>{key}. {inline(text)}</span></label>'
            for key, text in _OPTION.findall(options)
        )
        said = inline(said.replace(r"\|", "|"))
        return f"### {name}\n{asked}\n" + raw(
            f'<form class="gsnb-quiz" data-right="{letter}"><fieldset><legend>Your answer to {name}</legend>{rows}'
            f'</fieldset><p role="status"></p><p class="gsnb-said" hidden>The checker says: {said}</p></form>'
        )

    return _QUESTION.sub(form, questions)


ROOMS = (
    "types", "config", "geometry", "tsdf", "gaussians", "render", "seeding", "optim", "tracking", "export",
    "evaluation", "mapping", "data", "recordings", "runs", "viz", "course", "compare", "backends",
)  # fmt: skip
"""Rooms whose names a reader uses, in the order of the floors; the other rooms serve these."""


def public_names(path: Path) -> dict[str, str]:
    """Name -> module that it comes from, below the file's own ("" for itself), classes first.

    Those that a package passes on (``from .a import b as b``), or that a module defines, without an underscore.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {node.name: "" for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    if path.name == "__init__.py":
        nodes = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level]
        names = {a.name: "." * node.level + (node.module or "") for node in nodes for a in node.names if a.asname}
    public = [name for name in names if not name.startswith("_")]
    return {name: names[name] for name in sorted(public, key=lambda name: (name.islower(), name.lower()))}


def api_page(room: str, package: Path) -> str:
    """A page in Markdown for one room."""
    path = package / room / "__init__.py"
    path = path if path.exists() else package / f"{room}.py"
    name = f"gsfusion_nb.{room}"
    module = importlib.import_module(name)
    parts = [f"# {name}", "", _first_paragraphs(module.__doc__ or "")]
    for entry, source in public_names(path).items():
        thing = getattr(module, entry)
        home = getattr(thing, "__module__", "").split(".")[1:2]
        if inspect.ismodule(thing):
            parts += [_directive("automodule", thing.__name__, ("members",))]
        elif home and home != [room] and home[0] in ROOMS:
            parts += [f"`{entry}`: see [{home[0]}]({home[0]}.md)."]
        elif inspect.isclass(thing):
            parts += [_directive("autoclass", f"{name}.{entry}", ("members",))]
        elif callable(thing):
            parts += [_directive("autofunction", f"{name}.{entry}")]
        elif _explained(importlib.import_module(resolve_name(source or ".", name)), entry):
            parts += [_directive("autodata", f"{resolve_name(source or '.', name)}.{entry}", ("no-value",))]
    return "\n".join(parts) + "\n"


def _explained(module: ModuleType, name: str) -> bool:
    """Whether a constant has a docstring below it."""
    body = ast.parse(inspect.getsource(module)).body
    for node, following in pairwise(body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(t, ast.Name) and t.id == name for t in targets):
            return isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
    return False


def _first_paragraphs(doc: str) -> str:
    return inspect.cleandoc(doc).partition("\n\n")[0]


def _directive(kind: str, name: str, options: Sequence[str] = ()) -> str:
    lines = "".join(f"   :{option}:\n" for option in options)
    return f"\n```{{eval-rst}}\n.. {kind}:: {name}\n{lines}```\n"


def api_index() -> str:
    """The page that lists the rooms."""
    listed = "\n".join(ROOMS)
    return (
        "# API reference\n\nThe public names of each room, from their docstrings: shapes in brackets, units in the "
        "names, the source of a formula with its number.\nWhat a room is for: [architecture](../ARCHITECTURE.md).\n\n"
        f"```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n"
    )


QUIZ = "docs/teaching/quiz"
"""Where the book has the pages of questions, which are made when it is built."""
ARCHIVE = "gsfusion_nb_book.zip"
"""Name of the file with the whole site."""
_PICTURES = (".jpg", ".png", ".svg")
Views = Callable[[str, str], str | None]
"""Path of a notebook, id of a cell -> HTML of the cell's recorded view."""


class Assembly:
    """Writes the pages of the book.

    Args:
        places: The project.
        settings: Of the book.
        pages: Folder for the pages; emptied first.
        extra: Folder for other files of the site; emptied first.
        views: The recorded views.
        quiz: Pages of questions, and ``answers.md``, by file name.
    """

    def __init__(
        self,
        places: Places,
        settings: Settings,
        pages: Path,
        extra: Path,
        views: Views = lambda _page, _cell: None,
        quiz: Mapping[str, str] | None = None,
    ):
        self.quiz = {f"{QUIZ}/{name}": text for name, text in (quiz or {}).items()}
        self.places = dataclasses.replace(places, files=places.files | frozenset(self.quiz))
        self.settings, self.pages, self.extra, self.views = settings, pages, extra, views

    def write(self) -> None:
        """Write all of them."""
        for folder in (self.pages, self.extra):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        for path in sorted(self.places.files):
            if path.endswith(".ipynb") and self.places.is_page(path):
                self._chapter(path)
            elif self.places.is_page(path):
                self._page(path)
            elif path.startswith("docs/images/") and path.endswith(_PICTURES):
                self._put(self.pages / path, (self.places.root / path).read_bytes())
        for room in ROOMS:
            self._put(self.pages / f"api/{room}.md", api_page(room, self.places.root / "gsfusion_nb"))
        self._put(self.pages / "api/index.md", api_index())
        self._index()

    def _chapter(self, path: str) -> None:
        bar = opening_bar(path, self.settings)
        notebook = self.places.root / path
        chapter = Chapter(
            read_object(notebook, "a notebook"), path, self.places, view=lambda cell: self.views(path, cell), bar=bar
        )
        self._put(self.pages / f"{path.removesuffix('.ipynb')}.md", chapter.markdown())
        for address, content in chapter.files.contents.items():
            self._put(self.extra / posixpath.dirname(path) / address, content)
        self._put(self.extra / path, notebook.read_bytes())

    def _page(self, path: str) -> None:
        text = self.quiz.get(path) or (self.places.root / path).read_text(encoding="utf-8")
        if path in self.quiz and not path.endswith("/answers.md"):
            text = with_answers(text, self.quiz[f"{QUIZ}/answers.md"])
        self._put(self.pages / path, in_the_book(text, path, self.places))

    def _index(self) -> None:
        """The first page; pages of the documentation that it does not name come after the page on the book."""
        text = (self.places.root / "docs/book/index.md").read_text(encoding="utf-8")
        listed = {line.strip() for line in text.splitlines()}
        ours = [p.removesuffix(".md") for p in sorted(self.places.files) if self.places.is_page(p)]
        loose = [p for p in ours if p.startswith("docs/") and p not in listed and not p.startswith(QUIZ)]
        chapters = sorted(path.removesuffix(".md") for path in self.quiz if not path.endswith("/answers.md"))
        toctree = ["```{toctree}", ":caption: Quiz", ":maxdepth: 1", "", *chapters, f"{QUIZ}/answers", "```"]
        text = text.replace("{{quiz}}", "\n".join(toctree) if chapters else "")
        loose = [p for p in loose if p != "docs/index"]
        text = text.replace("docs/book\n```", "\n".join(["docs/book", *loose, "docs/index"]) + "\n```")
        size = f"[Download the whole book]({ARCHIVE}): a folder to read without internet; open its `index.html`."
        text = text.replace("{{download}}", size)
        self._put(self.pages / "index.md", in_the_book(text, "index.md", self.places))

    @staticmethod
    def _put(path: Path, content: str | bytes) -> None:
        data = content.encode() if isinstance(content, str) else content
        with atomic_file(path) as temporary:
            temporary.write_bytes(data)
