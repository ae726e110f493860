"""Where a file of the project is in the book, and pages in Markdown as the book needs them.

Links lead into the book, equations have numbers, and remarks for tests are gone.
"""

import ast
import functools
import os
import posixpath
import re
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

_SHOWN = {".py", ".js", ".css", ".html", ".toml", ".cu", ".cuh", ".h", ".vert", ".frag", ".mjs", ".md", ".yml", ""}
_PAGES = re.compile(
    r"(README|ARCHITECTURE|CONTRIBUTING)\.md|docs/(measured/|teaching/(quiz/)?)?[^/]+\.md|notebooks/[^/]+\.ipynb"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """The project's files, and where each of them is in the book.

    Args:
        root: The project.
        files: Paths of its files, below ``root``.
    """

    root: Path
    files: frozenset[str]
    asked: set[str] = field(default_factory=set)
    """Files that a page has a link to the source of."""

    def is_page(self, path: str) -> bool:
        """Whether a file is a page of the book; a notebook is."""
        return bool(_PAGES.fullmatch(path)) and path in self.files

    def is_shown(self, path: str) -> bool:
        """Whether a file has a page with its source."""
        return path in self.files and Path(path).suffix in _SHOWN and not path.startswith("tests/course/submissions")

    def source_url(self, path: str, *, seen_from: str, line: int = 0) -> str:
        """Address of the source page of a file, relative to the page ``seen_from``."""
        self.asked.add(path)
        up = os.path.relpath(f"source/{path}.html", Path(seen_from).parent.as_posix() or ".")
        return Path(up).as_posix() + (f"#L-{line}" if line else "")

    def line_of(self, path: str, name: str) -> int:
        """Number of the line in which ``name`` (``function``, ``Class`` or ``Class.method``) is defined; 0 if none."""
        return _definitions(self.root / path).get(name, 0)

    def line_with(self, path: str, piece: str) -> int:
        """Number of the only line that contains a text; 0 if there is none, or more than one."""
        lines = (self.root / path).read_text(encoding="utf-8").splitlines()
        found = [number for number, line in enumerate(lines, 1) if piece in line]
        return found[0] if len(found) == 1 else 0


@functools.cache
def _definitions(path: Path) -> dict[str, int]:
    if path.suffix != ".py":
        return {}
    found: dict[str, int] = {}

    def note(nodes: list[ast.stmt], prefix: str) -> None:
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.setdefault(prefix + node.name, node.lineno)
                if isinstance(node, ast.ClassDef):
                    note(node.body, f"{prefix}{node.name}.")

    note(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return {**{name.rpartition(".")[2]: line for name, line in found.items()}, **found}


def places_of(root: Path) -> Places:
    """The files that git knows in a project; without git, those in its folders."""
    try:
        listed = subprocess.run(["git", "-C", str(root), "ls-files"], capture_output=True, text=True, check=True)
        files = listed.stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        files = []
    if not files:
        tops = ("gsfusion_nb", "kernels", "docs", "notebooks", "tests", "tools", "data_scripts")
        found = [p for top in tops for p in (root / top).rglob("*")] + [*root.glob("*.md"), root / "pyproject.toml"]
        files = [p.relative_to(root).as_posix() for p in found if p.is_file() and "__pycache__" not in p.parts]
    return Places(root=root, files=frozenset(f for f in files if (root / f).is_file()))


_FENCE = re.compile(r"(^```.*?^```[ ]*$)", re.MULTILINE | re.DOTALL)
_REMARK = re.compile(r"<!--.*?-->\s*", re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_FILE = re.compile(r"(?:gsfusion_nb|kernels|tests|tools|data_scripts|notebooks|docs)/[\w/.-]*\.\w+")
_EQUATION = re.compile(r"^\$\$(.+?)\$\$[ ]*$", re.MULTILINE | re.DOTALL)


def in_the_book(text: str, page: str, places: Places) -> str:
    """A page's Markdown, changed for the book.

    Args:
        text: Markdown.
        page: The page's path in the project.
        places: Where the other files are.
    """
    pieces = _FENCE.split(text)
    return "".join(piece if piece.startswith("```") else _prose(piece, page, places) for piece in pieces)


def _prose(text: str, page: str, places: Places) -> str:
    text = _REMARK.sub("", text)
    links: list[str] = []

    def keep(match: re.Match[str]) -> str:  # a code span inside a link stays as it is
        links.append(_link(match, page, places))
        return f"\0{len(links) - 1}\0"

    text = _LINK.sub(keep, text)
    text = "\n".join(_line(line, page, places) for line in text.split("\n"))
    return re.sub(r"\0(\d+)\0", lambda match: links[int(match[1])], text)


def _link(match: re.Match[str], page: str, places: Places) -> str:
    bang, words, target = match.groups()
    name, _, anchor = target.partition("#")
    if "://" in target or not name or bang:
        return match[0]
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), name))
    if places.is_page(path):
        shown = f"{name.removesuffix('.ipynb')}.md" if name.endswith(".ipynb") else name
        return f"[{words}]({shown}#{anchor})" if anchor else f"[{words}]({shown})"
    if places.is_shown(path):
        return f'<a href="{places.source_url(path, seen_from=page)}">{words}</a>'
    return words


def _line(line: str, page: str, places: Places) -> str:
    """A line whose code spans that name files lead to them; in a table, the names beside a file lead to their lines."""
    file = ""

    def code(match: re.Match[str]) -> str:
        nonlocal file
        words, number = match[1], 0
        if _FILE.fullmatch(words) and places.is_shown(words):
            file = words
        elif file and line.startswith("|"):
            number = places.line_of(file, words.removesuffix("()")) or places.line_with(file, words)
        else:
            return match[0]
        if file != words and not number:
            return match[0]
        url = places.source_url(file, seen_from=page, line=number)
        return f'<a href="{url}"><code class="docutils literal">{escape(words, quote=False)}</code></a>'

    return _CODE.sub(code, line)


def numbered(text: str, chapter: str, count: Callable[[], int]) -> str:
    """Equations that stand alone get a number, unless they have one of a paper, and a place that a link can name."""

    def number(match: re.Match[str]) -> str:
        name = f"{chapter}.{count()}"
        body = match[1].strip()
        tag = "" if r"\tag{" in body else rf" \tag{{{name}}}"
        anchor = f"eq-{name.replace('.', '-')}"
        link = f'<a href="#{anchor}" title="Link to equation {name}">#<span>equation {name}</span></a>'
        formula = f'<div class="math notranslate nohighlight">\\[{escape(body, quote=False)}{tag}\\]</div>'
        return raw(f'<div class="gsnb-equation" id="{anchor}">{link}</div>{formula}')

    return "".join(piece if piece.startswith("```") else _EQUATION.sub(number, piece) for piece in _FENCE.split(text))


def raw(html: str) -> str:
    """HTML in a page in Markdown, whatever it contains."""
    return f"\n``````{{raw}} html\n{html}\n``````\n"
