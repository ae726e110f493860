"""A notebook as a page: text, code, stored outputs, hints, solutions to unfold, predictions before
what came."""

import ast
import base64
import re
from collections.abc import Mapping
from html import escape
from itertools import count, groupby
from typing import Any

from .live_panels import cell_panel_html
from .page_text import Places, in_the_book, numbered, raw, source_links
from .pictures import cut_steps, picture_html, steps_html
from .questions import call_text, hints_html, last_call, question_html, right_choice

_PICTURES = {"image/png": "png", "image/jpeg": "jpg"}


_ATTACHED = re.compile(r"!\[[^\]]*\]\(attachment:[^)]*\)\s*")
"""A picture that a text cell holds; the book has the map itself in its place."""
_DRAWING = ("show", "show_figure", "show_mesh")
"""A cell that ends in one of these is there for its picture."""
_STILL = (
    '<p class="gsnb-still">A stored picture. Its buttons and sliders are in the notebook: '
    "<code>make lab</code></p>"
)
_SOLUTION = re.compile(r"^### (BEGIN|END) SOLUTION\n*", re.MULTILINE)


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
        call = last_call(source)
        if call is not None and call_text(call) == "predict" and len(call.args) > 1:
            self._prediction = ast.literal_eval(call.args[0])
            self._came = False
            return raw(question_html(call))
        if _SOLUTION.search(source):
            code = _SOLUTION.sub("", source).strip()
            details_tag = raw('<details class="gsnb-solution"><summary>Solution</summary>')
            return f"{details_tag}\n{_python(code)}\n{raw('</details>')}"
        outputs = self._outputs(cell)
        prediction = self._prediction
        if call is not None and call_text(call) == "came":
            self._came = True
            right = right_choice(call)
            return raw(
                f'<div class="gsnb-came" data-prediction="{prediction}" '
                f'data-right="{right}">{"".join(outputs)}</div>'
            )
        attribute = f' data-prediction="{prediction}"' if prediction and outputs else ""
        output_box = (
            f'<div class="gsnb-outputs"{attribute}>{"".join(outputs)}</div>' if outputs else ""
        )
        begins = f'<div class="gsnb-cell" id="{cell["id"]}">'
        ends = f"{output_box}</div>{hints_html(source)}"
        is_folded = cell["metadata"].get("jupyter", {}).get("source_hidden") or (
            call and call_text(call) in _DRAWING
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
