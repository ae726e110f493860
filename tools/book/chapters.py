"""A notebook as a page: text, code, stored outputs, hints, solutions to unfold, predictions before what came."""

import ast
import base64
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import count
from typing import Any

from gsfusion_nb.course.exercise import exercises

from .pages import Places, in_the_book, numbered, raw

_PICTURES = {"image/png": "png", "image/jpeg": "jpg"}
_SOURCE = re.compile(r'href="(?:\.\./)+([\w/.-]+)#line=(\d+)"')


@dataclass(kw_only=True)
class Files:
    """Files that belong to a page, by their names relative to it."""

    folder: str
    """Where they are put, relative to the page."""
    contents: dict[str, bytes] = field(default_factory=dict)

    def add(self, name: str, content: bytes) -> str:
        """Keep a file; its address relative to the page."""
        address = f"{self.folder}/{name}"
        self.contents[address] = content
        return address


def outputs_html(cell: Mapping[str, Any], page: str, places: Places, files: Files) -> list[str]:
    """HTML of each output of a cell; what it printed in a row is one."""
    found: list[str] = []
    printed = ""
    for number, output in enumerate([*cell.get("outputs", []), None]):
        if output is not None and output["output_type"] == "stream":
            printed += "".join(output["text"])
            continue
        if printed:
            found.append(f'<pre class="gsnb-printed" tabindex="0">{escape(printed.rstrip(), quote=False)}</pre>')
            printed = ""
        if output is not None:
            found.append(_shown(output, f"{cell['id']}-{number}", page, places, files))
    return [html for html in found if html]


def _shown(output: Mapping[str, Any], name: str, page: str, places: Places, files: Files) -> str:
    data, metadata = output.get("data", {}), output.get("metadata", {})
    if "text/html" in data:
        return f'<div class="gsnb-html">{source_links("".join(data["text/html"]), page, places)}</div>'
    for kind, suffix in _PICTURES.items():
        if kind in data:
            content = base64.b64decode("".join(data[kind]))
            words = metadata.get(kind, {})
            return picture_html(files.add(f"{name}.{suffix}", content), content, words, suffix)
    text = "".join(data.get("text/plain", output.get("traceback", "")))
    return f'<pre class="gsnb-printed" tabindex="0">{escape(text, quote=False)}</pre>' if text else ""


def source_links(html: str, page: str, places: Places) -> str:
    """Links of a notebook to lines of files as links to the pages of these files; JupyterLab counts lines from 0."""
    return _SOURCE.sub(
        lambda m: f'href="{places.source_url(m[1], seen_from=page, line=int(m[2]) + 1)}"'
        if places.is_shown(m[1]) else m[0],
        html,
    )  # fmt: skip


def picture_html(address: str, content: bytes, metadata: Mapping[str, Any], suffix: str) -> str:
    """An image with its size, so that the page does not move when it is loaded."""
    width, height = _size(content)
    wide = int(metadata.get("width", width))
    drawing = ' class="gsnb-figure"' if suffix == "png" else ""
    return (
        f'<img{drawing} src="{address}" width="{wide}" height="{round(wide * height / width)}" loading="lazy" '
        f'alt="{escape(str(metadata.get("alt", "")) or "picture")}">'
    )


def _size(content: bytes) -> Sequence[int]:
    import io

    from PIL import Image

    return Image.open(io.BytesIO(content)).size


_SOLUTION = re.compile(r"^### (BEGIN|END) SOLUTION\n*", re.MULTILINE)
_EMPTY = re.compile(r"^def (\w+)\(", re.MULTILINE)
View = Callable[[str], str | None]
"""Id of a cell -> HTML of its recorded view, if there is one."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """A prediction that a chapter asks for."""

    name: str
    text: str
    choices: tuple[Any, ...]
    unit: str


class Chapter:
    """Makes the page of one notebook.

    Args:
        notebook: As nbformat stores it.
        page: Path of the notebook in the project.
        places: Where other files are.
        view: Recorded views of its cells.
        bar: HTML under the title: how to open the chapter.
    """

    def __init__(
        self, notebook: Mapping[str, Any], page: str, places: Places, *, view: View = lambda _: None, bar: str = ""
    ):
        self.cells, self.page, self.places, self.view, self.bar = notebook["cells"], page, places, view, bar
        stem = page.rpartition("/")[2].removesuffix(".ipynb")
        self.number = int(stem.partition("_")[0])
        self.files = Files(folder=f"{stem}_files")
        self._equations = count(1)
        self._asked, self._came = "", False

    def markdown(self) -> str:
        """The page in Markdown; its pictures are then in ``files``."""
        parts = [self._text(c) if c["cell_type"] == "markdown" else self._code(c) for c in self.cells]
        text = "\n\n".join(part for part in parts if part)
        title, _, rest = text.partition("\n")
        return f"{title}\n\n{raw(self.bar) if self.bar else ''}\n\n{rest}\n"

    def _text(self, cell: Mapping[str, Any]) -> str:
        if self._came:  # the outputs between what came and the next text wait for the prediction, too
            self._asked, self._came = "", False
        text = in_the_book("".join(cell["source"]), self.page, self.places)
        return numbered(text, str(self.number), lambda: next(self._equations))

    def _code(self, cell: Mapping[str, Any]) -> str:
        source = "".join(cell["source"]).strip()
        if "course_progress(" in source:
            return ""
        call = _last_call(source)
        if call is not None and _called(call) == "predict" and len(call.args) > 1:
            asked = _question(call)
            self._asked, self._came = asked.name, False
            return raw(question_html(asked))
        if _SOLUTION.search(source):
            code = _SOLUTION.sub("", source).strip()
            opened = raw('<details class="gsnb-solution"><summary>Solution</summary>')
            return f"{opened}\n{_python(code)}\n{raw('</details>')}"
        shown = self._outputs(cell)
        asked = self._asked
        if call is not None and _called(call) == "came":
            self._came = True
            right = _right(call)
            return raw(f'<div class="gsnb-came" data-prediction="{asked}" data-right="{right}">{"".join(shown)}</div>')
        later = f' data-prediction="{asked}"' if asked and shown else ""
        below = f'<div class="gsnb-outputs"{later}>{"".join(shown)}</div>' if shown else ""
        cell_begins = raw(f'<div class="gsnb-cell" id="{cell["id"]}">')
        return f"{cell_begins}\n{_python(source)}\n{raw(f'{below}</div>{_hints(source)}')}"

    def _outputs(self, cell: Mapping[str, Any]) -> list[str]:
        shown = outputs_html(cell, self.page, self.places, self.files)
        view = self.view(cell["id"])
        if view is not None:
            pictures = [html for html in shown if html.startswith("<img")]
            shown = [html for html in shown if html not in pictures[-1:]]
            shown.insert(len(shown) if pictures else 0, view.replace("<!-- picture -->", "".join(pictures[-1:])))
        return shown


def _python(code: str) -> str:
    return f"``````python\n{code}\n``````"


def _called(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")


def _last_call(source: str) -> ast.Call | None:
    """The call that the last line of a cell is, if it is one."""
    try:
        body = ast.parse(source).body
    except SyntaxError:
        return None
    last = body[-1] if body else None
    return last.value if isinstance(last, ast.Expr) and isinstance(last.value, ast.Call) else None


def _question(call: ast.Call) -> Question:
    values = [ast.literal_eval(a) for a in call.args]
    named = {k.arg: ast.literal_eval(k.value) for k in call.keywords}
    choices = values[2] if len(values) > 2 else named.get("choices", ())
    return Question(name=values[0], text=values[1], choices=tuple(choices), unit=str(named.get("unit", "")))


def _right(call: ast.Call) -> str:
    """The right choice where the cell names it."""
    given = [k.value for k in call.keywords if k.arg == "right"]
    return escape(str(ast.literal_eval(given[0]))) if given and isinstance(given[0], ast.Constant) else ""


def question_html(asked: Question) -> str:
    """A form that asks for a prediction; ``book.js`` shows what came after an answer."""
    name = escape(asked.name)

    def words(choice: Any) -> str:
        number = choice if isinstance(choice, str) else f"{choice:,}" if isinstance(choice, int) else f"{choice:,.4g}"
        return escape(number if isinstance(choice, str) else f"{number} {asked.unit}".strip())

    inputs = [
        f'<label><input type="radio" name="{name}" value="{escape(str(choice))}"> {words(choice)}</label>'
        for choice in asked.choices
    ] or [f'<label>your number, {escape(asked.unit) or "any"}: <input type="number" step="any" name="{name}"></label>']
    return (
        f'<form class="gsnb-question" data-prediction="{name}"><fieldset><legend><b>Predict.</b> '
        f'{escape(asked.text)}</legend><div class="gsnb-choices">{"".join(inputs)}</div>'
        '<button type="submit">See what came</button> <button type="button" class="gsnb-skip">Show without a '
        'prediction</button></fieldset><p role="status"></p></form>'
    )


def _hints(source: str) -> str:
    """The hints of the functions that a cell leaves unwritten, to unfold one by one."""
    if not source.endswith("..."):
        return ""
    every = exercises()
    found = ""
    for name in _EMPTY.findall(source):
        for number, hint in reversed(list(enumerate(every[name].hints if name in every else (), 1))):
            later = found if number < len(every[name].hints) else ""
            of = f"Hint {number} of {len(every[name].hints)}"
            found = f'<details class="gsnb-hint"><summary>{of}</summary><p>{escape(hint)}</p>{later}</details>'
    return found
