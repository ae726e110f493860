"""The text of a page for a reader of the book: links, equations, remarks."""

import posixpath
import re
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path

_PAGES = re.compile(
    r"(README|ARCHITECTURE|CONTRIBUTING)\.md|docs/(measured/|teaching/(quiz/)?)?[^/]+\.md|notebooks/[^/]+\.ipynb"
)

ROOT_PAGES = {"docs/book/index.md": "index.md", "docs/book/splatting.md": "splatting.md"}
"""Pages that stand at the root of the book."""

FILES_OF_REPOSITORY = "/blob/HEAD/"
"""Between the address of a repository and the path of a file."""
WHERE_TO_GET_IT = "<!-- where to get it -->\n"
"""In a page: here the book says where the repository is."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """The project's files, and where each of them is for a reader of the book."""

    root: Path
    files: frozenset[str]
    """Paths of the project's files, below ``root``."""
    repository: str = ""
    """Address below which a repository shows its files, with a slash at its end; "" without a
    repository."""

    def is_page(self, path: str) -> bool:
        """Whether a file is a page of the book; a notebook is."""
        is_name_of_page = path in ROOT_PAGES or bool(_PAGES.fullmatch(path))
        return is_name_of_page and path in self.files

    def source_url(self, path: str, line: int = 0) -> str:
        """Address of a file in the repository; "" if there is none."""
        is_public = self.repository and path in self.files
        return f"{self.repository}{path}{f'#L{line}' if line else ''}" if is_public else ""

    def where_to_get_it(self) -> str:
        """The sentence that stands at ``WHERE_TO_GET_IT``; "" without a repository."""
        home = self.repository.removesuffix(FILES_OF_REPOSITORY).rstrip("/")
        if not home:
            return ""
        return f"The project is at [{home}]({home}), and `git clone {home}` fetches it.\n"


def places_of(root: Path, repository: str = "") -> Places:
    """The files that git knows in a project."""
    process = subprocess.run(
        ["git", "-C", str(root), "ls-files"], capture_output=True, text=True, check=True
    )
    files = frozenset(f for f in process.stdout.splitlines() if (root / f).is_file())
    return Places(root=root, files=files, repository=repository)


_FENCE = re.compile(r"(^```.*?^```[ ]*$)", re.MULTILINE | re.DOTALL)
REMARK = re.compile(r"<!--.*?-->\s*", re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_EQUATION = re.compile(r"^\$\$(.+?)\$\$[ ]*$", re.MULTILINE | re.DOTALL)


def _outside_code(text: str, change: Callable[[str], str]) -> str:
    return "".join(
        piece if piece.startswith("```") else change(piece) for piece in _FENCE.split(text)
    )


def in_the_book(text: str, page: str, places: Places) -> str:
    """A page's Markdown, changed for the book.

    Args:
        text: Markdown.
        page: The page's path in the project.
        places: Where the other files are.
    """

    def link(match: re.Match[str]) -> str:
        bang, words, target = match.groups()
        name, _, anchor = target.partition("#")
        if "://" in target or not name or bang:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page), name))
        if places.is_page(path):
            here = posixpath.dirname(ROOT_PAGES.get(page, page))
            shown = posixpath.relpath(ROOT_PAGES.get(path, path), here or ".")
            shown = f"{shown.removesuffix('.ipynb')}.md" if shown.endswith(".ipynb") else shown
            return f"[{words}]({shown}#{anchor})" if anchor else f"[{words}]({shown})"
        return f"[{words}]({places.source_url(path)})" if places.source_url(path) else words

    placed = text.replace(WHERE_TO_GET_IT, places.where_to_get_it())
    return _outside_code(placed, lambda piece: _LINK.sub(link, REMARK.sub("", piece)))


def numbered(text: str, chapter: str, count: Callable[[], int]) -> str:
    """Equations that stand alone get a number, unless they have one of a paper, and a place that a
    link can name."""

    def number(match: re.Match[str]) -> str:
        name = f"{chapter}.{count()}"
        body = match[1].strip()
        tag = "" if r"\tag{" in body else rf" \tag{{{name}}}"
        anchor = f"eq-{name.replace('.', '-')}"
        link = (
            f'<a href="#{anchor}" title="Link to equation {name}">#<span>equation {name}</span></a>'
        )
        formula = (
            '<div class="math notranslate '
            f'nohighlight">\\[{escape(body, quote=False)}{tag}\\]</div>'
        )
        return raw(f'<div class="gsnb-equation" id="{anchor}">{link}</div>{formula}')

    return _outside_code(text, lambda piece: _EQUATION.sub(number, piece))


def raw(html: str) -> str:
    """HTML in a page in Markdown, whatever it contains."""
    return f"\n``````{{raw}} html\n{html}\n``````\n"


_SOURCE = re.compile(r'<a href="(?:\.\./)+([\w/.-]+)#line=(\d+)"[^>]*>(.*?)</a>')


def source_links(html: str, places: Places) -> str:
    """Links of a notebook to lines of files lead to the repository, or become text; JupyterLab
    counts lines from 0."""

    def link(match: re.Match[str]) -> str:
        url = places.source_url(match[1], int(match[2]) + 1)
        return f'<a href="{url}">{match[3]}</a>' if url else match[3]

    return _SOURCE.sub(link, html)
