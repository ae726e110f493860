"""Pages in Markdown as the book needs them: links that lead into the book, numbered equations, no remarks for tests."""

import posixpath
import re
from collections.abc import Callable
from html import escape

from .places import Places

_FENCE = re.compile(r"(^```.*?^```[ ]*$)", re.MULTILINE | re.DOTALL)
_REMARK = re.compile(r"<!--.*?-->\s*", re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_FILE = re.compile(r"(?:gsfusion_nb|kernels|tests|data_scripts|notebooks|docs)/[\w/.-]*\.\w+")
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
