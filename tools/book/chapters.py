"""A notebook as a page: text, code, stored outputs, hints, solutions to unfold, predictions before
what came."""

import ast
import base64
import io
import posixpath
import re
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import count, groupby
from pathlib import Path
from typing import Any

from PIL import Image

from gsfusion_nb.course.exercise import exercises

from .live_panels import cell_panel_html

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
_REMARK = re.compile(r"<!--.*?-->\s*", re.DOTALL)
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
    return _outside_code(placed, lambda piece: _LINK.sub(link, _REMARK.sub("", piece)))


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


_PICTURES = {"image/png": "png", "image/jpeg": "jpg"}
_SOURCE = re.compile(r'<a href="(?:\.\./)+([\w/.-]+)#line=(\d+)"[^>]*>(.*?)</a>')


def source_links(html: str, places: Places) -> str:
    """Links of a notebook to lines of files lead to the repository, or become text; JupyterLab
    counts lines from 0."""

    def link(match: re.Match[str]) -> str:
        url = places.source_url(match[1], int(match[2]) + 1)
        return f'<a href="{url}">{match[3]}</a>' if url else match[3]

    return _SOURCE.sub(link, html)


_PHONE_PX = 400
"""A picture wider than this is scaled down on a phone, and what is written in it with it."""


def picture_html(
    address: str,
    content: bytes,
    metadata: Mapping[str, Any],
    suffix: str,
) -> str:
    """An image with its size, so that the page does not move when it is loaded.

    A wide one is a link to itself, to be enlarged, and its words stand below it on a narrow page:
    the labels in it are then too small to be read.
    """
    width, height = Image.open(io.BytesIO(content)).size
    wide = int(metadata.get("width", width))
    words = escape(str(metadata.get("alt", "")) or "picture")
    drawing = ' class="gsnb-figure"' if suffix == "png" else ""
    image = (
        f'<img{drawing} src="{address}" width="{wide}" height="{round(wide * height / width)}" '
        f'loading="lazy" alt="{words}">'
    )
    if wide <= _PHONE_PX:
        return image
    # screen readers have the same words from the image
    caption = f'<figcaption aria-hidden="true">{words}</figcaption>'
    return f'<figure class="gsnb-wide"><a href="{address}">{image}</a>{caption}</figure>'


def steps_html(pictures: Sequence[tuple[str, bytes]], metadata: Mapping[str, Any]) -> str:
    """The stills of a stepper: each picture (address, content), with its words as text beside it,
    or below it on a narrow page."""
    width = int(metadata["width"]) // 2
    parts = []
    for (address, content), step in zip(pictures, metadata["steps"], strict=True):
        across, down = Image.open(io.BytesIO(content)).size
        title = escape(step["title"])
        rows = (
            "".join(f"<td>{escape(cell, quote=False)}</td>" for cell in row)
            for row in step["numbers"]
        )
        table = "".join(f"<tr>{row}</tr>" for row in rows)
        parts.append(
            f'<figure class="gsnb-step"><img class="gsnb-figure" src="{address}" width="{width}" '
            f'height="{round(width * down / across)}" loading="lazy" alt="{title}">'
            f"<figcaption><p>{title}</p>"
            f"<p><code>{escape(step['place'], quote=False)}</code></p>"
            f"<pre>{escape(step['code'], quote=False)}</pre>"
            f"<table>{table}</table></figcaption></figure>"
        )
    return "".join(parts)


def cut_steps(still: bytes, n_steps: int) -> list[bytes]:
    """The pictures in a stepper's still, which are its left half, from top to bottom."""
    image = Image.open(io.BytesIO(still))
    width = image.width // 2
    height = image.height // n_steps
    pictures = []
    for k in range(n_steps):
        part = io.BytesIO()
        image.crop((0, k * height, width, (k + 1) * height)).save(part, "PNG", optimize=True)
        pictures.append(part.getvalue())
    return pictures


_ATTACHED = re.compile(r"!\[[^\]]*\]\(attachment:[^)]*\)\s*")
"""A picture that a text cell holds; the book has the map itself in its place."""
_DRAWING = ("show", "show_figure", "show_mesh")
"""A cell that ends in one of these is there for its picture."""
_STILL = (
    '<p class="gsnb-still">A stored picture. Its buttons and sliders are in the notebook: '
    "<code>make lab</code></p>"
)
_SOLUTION = re.compile(r"^### (BEGIN|END) SOLUTION\n*", re.MULTILINE)
_EMPTY = re.compile(r"^def (\w+)\(", re.MULTILINE)


class Chapter:
    """Makes the page of one notebook.

    Args:
        notebook: As nbformat stores it.
        page: Path of the notebook in the project.
        places: Where other files are.
        bar: HTML under the title: how to open the chapter.
    """

    def __init__(
        self,
        notebook: Mapping[str, Any],
        page: str,
        places: Places,
        *,
        bar: str = "",
    ):
        self.cells = notebook["cells"]
        self.page = page
        self.places = places
        self.bar = bar
        self.stem = page.rpartition("/")[2].removesuffix(".ipynb")
        self.files: dict[str, bytes] = {}
        """Address relative to the page -> content of its pictures."""
        self._equations = count(1)
        self._prediction = ""
        self._came = False

    def markdown(self) -> str:
        """The page in Markdown; its pictures are then in ``files``."""
        parts = [
            self._text(c) if c["cell_type"] == "markdown" else self._code(c) for c in self.cells
        ]
        text = "\n\n".join(part for part in parts if part)
        title, _, rest = text.partition("\n")
        return f"{title}\n\n{raw(self.bar) if self.bar else ''}\n\n{rest}\n"

    def _text(self, cell: Mapping[str, Any]) -> str:
        # the outputs between what came and the next text wait for the prediction, too
        if self._came:
            self._prediction = ""
            self._came = False
        text = in_the_book(
            _ATTACHED.sub("", "".join(cell["source"])),
            self.page,
            self.places,
        )
        number = self.stem.partition("_")[0].removeprefix("0")
        return numbered(text, number, lambda: next(self._equations))

    def _code(self, cell: Mapping[str, Any]) -> str:
        source = "".join(cell["source"]).strip()
        if "course_progress(" in source:
            return ""
        call = _last_call(source)
        if call is not None and _call_text(call) == "predict" and len(call.args) > 1:
            self._prediction = ast.literal_eval(call.args[0])
            self._came = False
            return raw(question_html(call))
        if _SOLUTION.search(source):
            code = _SOLUTION.sub("", source).strip()
            details_tag = raw('<details class="gsnb-solution"><summary>Solution</summary>')
            return f"{details_tag}\n{_python(code)}\n{raw('</details>')}"
        outputs = self._outputs(cell)
        prediction = self._prediction
        if call is not None and _call_text(call) == "came":
            self._came = True
            right = _right(call)
            return raw(
                f'<div class="gsnb-came" data-prediction="{prediction}" '
                f'data-right="{right}">{"".join(outputs)}</div>'
            )
        attribute = f' data-prediction="{prediction}"' if prediction and outputs else ""
        output_box = (
            f'<div class="gsnb-outputs"{attribute}>{"".join(outputs)}</div>' if outputs else ""
        )
        begins = f'<div class="gsnb-cell" id="{cell["id"]}">'
        ends = f"{output_box}</div>{_hints(source)}"
        is_folded = cell["metadata"].get("jupyter", {}).get("source_hidden") or (
            call and _call_text(call) in _DRAWING
        )
        if is_folded:
            begins = f'{begins}<details class="gsnb-code"><summary>Code</summary>'
            ends = f"</details>{ends}"
        return f"{raw(begins)}\n{_python(source)}\n{raw(ends + cell_panel_html(cell['id']))}"

    def _outputs(self, cell: Mapping[str, Any]) -> list[str]:
        """HTML of each output of a cell; what it printed in a row is one."""
        parts: list[str] = []
        for is_stream, own in groupby(
            cell.get("outputs", []), key=lambda output: output["output_type"] == "stream"
        ):
            if is_stream:
                parts.append(_printed("".join("".join(output["text"]) for output in own).rstrip()))
            else:
                parts += [
                    self._output_html(output, f"{cell['id']}-{len(parts) + k}")
                    for k, output in enumerate(own)
                ]
        return [html for html in parts if html]

    def _output_html(self, output: Mapping[str, Any], name: str) -> str:
        data = output.get("data", {})
        metadata = output.get("metadata", {})
        if "text/html" in data:
            return (
                "<div "
                f'class="gsnb-html">{source_links("".join(data["text/html"]), self.places)}</div>'
            )
        for kind, suffix in _PICTURES.items():
            if kind in data:
                content = base64.b64decode("".join(data[kind]))
                words = metadata.get(kind, {})
                if "steps" in words:
                    return self._steps_html(content, words, name) + _STILL
                address = f"{self.stem}_files/{name}.{suffix}"
                self.files[address] = content
                picture = (
                    ""
                    if "".join(data.get("text/plain", "<IPython")).startswith("<IPython")
                    else _STILL
                )
                return picture_html(address, content, words, suffix) + picture
        return _printed("".join(data.get("text/plain", output.get("traceback", ""))))

    def _steps_html(self, still: bytes, words: Mapping[str, Any], name: str) -> str:
        contents = cut_steps(still, len(words["steps"]))
        pictures = [
            (f"{self.stem}_files/{name}-{k}.png", content) for k, content in enumerate(contents)
        ]
        self.files |= dict(pictures)
        return steps_html(pictures, words)


def _printed(text: str) -> str:
    return (
        f'<pre class="gsnb-printed" tabindex="0">{escape(text, quote=False)}</pre>' if text else ""
    )


def _python(code: str) -> str:
    return f"``````python\n{code}\n``````"


def _call_text(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")


def _last_call(source: str) -> ast.Call | None:
    """The call that the last line of a cell is, if it is one."""
    try:
        body = ast.parse(source).body
    except SyntaxError:
        return None
    last = body[-1] if body else None
    return last.value if isinstance(last, ast.Expr) and isinstance(last.value, ast.Call) else None


def _right(call: ast.Call) -> str:
    """The right choice where the cell names it."""
    right_values = [k.value for k in call.keywords if k.arg == "right"]
    return (
        escape(str(ast.literal_eval(right_values[0])))
        if right_values and isinstance(right_values[0], ast.Constant)
        else ""
    )


def question_html(call: ast.Call) -> str:
    """The form of a call of ``predict``; ``book.js`` shows what came after an answer."""
    values = dict(
        zip(
            ("name", "question", "choices"),
            map(ast.literal_eval, call.args),
            strict=False,
        )
    )
    values |= {k.arg: ast.literal_eval(k.value) for k in call.keywords}
    name = escape(values["name"])
    unit = values.get("unit", "")

    def words(choice: Any) -> str:
        number = (
            f"{choice:,}"
            if isinstance(choice, int)
            else f"{choice:,.4g}"
            if isinstance(choice, float)
            else ""
        )
        return escape(f"{number} {unit}".strip() if number else choice)

    inputs = [
        f'<label><input type="radio" name="{name}" value="{escape(str(choice))}"> '
        f"{words(choice)}</label>"
        for choice in values.get("choices", ())
    ] or [
        f'<label>your number, {escape(unit) or "any"}: <input type="number" step="any" '
        f'name="{name}"></label>'
    ]
    return (
        f'<form class="gsnb-question" data-prediction="{name}"><fieldset><legend><b>Predict.</b> '
        f'{escape(values["question"])}</legend><div class="gsnb-choices">{"".join(inputs)}</div>'
        '<button type="submit">See what came</button> <button type="button" class="gsnb-skip">Show '
        "without a "
        'prediction</button></fieldset><p role="status"></p></form>'
    )


def _hints(source: str) -> str:
    """The hints of the functions that a cell leaves unwritten, to unfold one by one."""
    if not source.endswith("..."):
        return ""
    every = exercises()
    hints_html = ""
    for name in _EMPTY.findall(source):
        for number, hint in reversed(
            list(enumerate(every[name].hints if name in every else (), 1))
        ):
            next_hints = hints_html if number < len(every[name].hints) else ""
            of = f"Hint {number} of {len(every[name].hints)}"
            hints_html = (
                "<details "
                f'class="gsnb-hint"><summary>{of}</summary><p>{escape(hint)}</p>{next_hints}</details>'
            )
    return hints_html
