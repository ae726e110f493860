"""The folder of pages that Sphinx reads, and the folder of files that the site holds beside them."""

import posixpath
import shutil
from collections.abc import Callable
from pathlib import Path

from ..files import atomic_file
from ..strict_json import read_object
from .api_pages import ROOMS, api_index, api_page
from .chapters import Chapter
from .launch import opening_bar
from .pages import in_the_book
from .places import Places
from .quiz import with_answers
from .settings import Settings

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
    """

    def __init__(
        self, places: Places, settings: Settings, pages: Path, extra: Path, views: Views = lambda _page, _cell: None
    ):
        self.places, self.settings, self.pages, self.extra, self.views = places, settings, pages, extra, views

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
        text = (self.places.root / path).read_text(encoding="utf-8")
        folder, _, name = path.rpartition("/")
        if folder.endswith("/quiz") and name.startswith("chapter_"):
            answers = (self.places.root / folder / "answers.md").read_text(encoding="utf-8")
            text = with_answers(text, answers)
        self._put(self.pages / path, in_the_book(text, path, self.places))

    def _index(self) -> None:
        """The first page; pages of the documentation that it does not name come after the page on the book."""
        text = (self.places.root / "docs/book/index.md").read_text(encoding="utf-8")
        listed = {line.strip() for line in text.splitlines()}
        ours = [p.removesuffix(".md") for p in sorted(self.places.files) if self.places.is_page(p)]
        loose = [p for p in ours if p.startswith("docs/") and p not in listed and "/quiz/chapter_" not in p]
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
