"""Copies of the notebooks: for one learner to work in, for students to hand in; and their
documentation.

In a code cell everything from the line ``### BEGIN SOLUTION`` to ``### END SOLUTION`` is a
solution, in a text cell from ``<!-- BEGIN SOLUTION -->`` to ``<!-- END SOLUTION -->``. A cell that
would be empty without it is left out, and so are other comments of text cells, which are for tests.
A student's copy has no outputs, because they would show what the reader is asked to predict. A
learner's copy has the stored pictures of what to expect.

A learner's work is never overwritten: a notebook that is there already stays.
"""

import copy
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import ArgumentError
from ..files import read_object, write_file
from .short_path import SHORT_PATH, short_path

FIRST = "00_quickstart.ipynb"
DOCUMENTATION = "documentation"
"""Folder of the documentation's pages, in the folder of the notebooks."""

_BEGIN = ("### BEGIN SOLUTION", "<!-- BEGIN SOLUTION -->")
_END = ("### END SOLUTION", "<!-- END SOLUTION -->")
_COMMENT = re.compile(r"\s*<!--.*?-->", re.DOTALL)
"""What tests read: which numbers of the outputs the text speaks of."""
_CHECK = re.compile(r"^check\.(?P<name>\w+)\((?P=name)\)$", re.MULTILINE)
_PREDICT, _CAME = (re.compile(rf"\b{word}\(\s*\"(\w+)\"") for word in ("predict", "came"))
_GUESS = re.compile(r"^> \*\*Guess", re.MULTILINE)
"""A text cell that asks before the code below it answers."""
_WHOSE = re.compile(r"^\w+: (your code is used\.|the reference's is used: )")
_TELLS_NOTHING = re.compile(r"^(Predict: |what you should see: ✓ \w+: all checks pass$)")
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)")
_TO_A_PAGE = re.compile(r"\]\(\.\./docs/")
_TO_A_SOURCE_FILE = re.compile(r'<a href=\\"(?:\.\./)+gsfusion_nb/[^>]*>(.*?)</a>')

_NOTE = (
    "*The pictures and numbers below were stored: they show what to expect. Running a cell "
    "replaces them by yours. What answers a question is not shown before. As long as you have "
    "not solved an exercise, the chapter uses the reference's code, and says so.*"
)
_NOT_SHOWN = "Not shown before you run this cell: it answers a question."


def notebooks_folder() -> Path:
    """The folder of the solved notebooks: in an installed package, or in a clone.

    Raises:
        FileNotFoundError: this installation has none.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "notebooks", package.parent / "notebooks"):
        if (folder / FIRST).is_file():
            return folder
    raise FileNotFoundError(
        f"{package} holds no notebooks; expected {FIRST} in its folder notebooks: install it again"
    )


def docs_folder() -> Path | None:
    """The folder of the documentation, in an installed package or in a clone; ``None`` if there is
    none."""
    package = Path(__file__).resolve().parents[1]
    folders = (
        folder
        for folder in (package / "docs", package.parent / "docs")
        if (folder / "index.md").is_file()
    )
    return next(folders, None)


def without_solutions(
    notebook: dict[str, Any],
    *,
    outputs: bool = False,
) -> dict[str, Any]:
    """A copy of the notebook (as read from JSON) without solutions and, unless they are wanted,
    ``outputs``.

    Raises:
        ValueError: a marker without its partner; the message names the cell.
    """
    student = copy.deepcopy(notebook)
    cells = []
    for number, cell in enumerate(student["cells"]):
        lines = "".join(cell["source"]).splitlines(keepends=True)
        open_cells = []
        in_solution = False
        for line in lines:
            if line.strip() in (_END if in_solution else _BEGIN):
                in_solution = not in_solution
            elif line.strip() in (*_BEGIN, *_END):
                raise ArgumentError(
                    f"cell {number} has {line.strip()!r} "
                    f"{'inside' if in_solution else 'outside'} a solution"
                )
            elif not in_solution:
                open_cells.append(line)
        if in_solution:
            raise ArgumentError(f"cell {number} has BEGIN SOLUTION without END SOLUTION")
        if cell["cell_type"] == "code":
            cell |= {"outputs": cell["outputs"] if outputs else [], "execution_count": None}
        text = "".join(open_cells)
        if cell["cell_type"] == "markdown":
            text = _COMMENT.sub("", text)
        if text.strip() or not lines:
            cell["source"] = text.rstrip("\n").splitlines(keepends=True)
            cells.append(cell)
    student["cells"] = cells
    return student


def learner_copy(notebook: dict[str, Any]) -> dict[str, Any]:
    """A copy of the notebook (as read from JSON) without solutions, with the stored outputs as what
    to expect.

    What would show the learner's own answer stands as "what you should see" (a verdict) or goes
    (whose code was used). What answers an open question is left out, because JupyterLab shows the
    first line of a folded output.

    Raises:
        ValueError: a marker of a solution without its partner; the message names the cell.
    """
    notebook_copy = copy.deepcopy(notebook)
    questions = _OpenQuestions()
    for cell in notebook_copy["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] != "code":
            questions.read_text(source)
            continue
        outputs = [output for output in cell["outputs"] if not _WHOSE.match(_text_of(output))]
        if _BEGIN[0] in source or _CHECK.search(source) is not None:
            outputs = [_answer_output(output) for output in outputs]
        if questions.are_open:
            outputs = _without_answers(outputs)
        cell["outputs"] = outputs
        questions.read_code(source, answers=bool(outputs))
    learner = without_solutions(notebook_copy, outputs=True)
    learner["cells"].insert(
        1, {"cell_type": "markdown", "id": "what-to-expect", "metadata": {}, "source": [_NOTE]}
    )
    return learner


class _OpenQuestions:
    """Which questions of a notebook are open, while its cells are read in their order.

    A prediction is open from its cell to the one that compares. A guess, which a text asks for, is
    open from there to the text that follows its first output.
    """

    def __init__(self) -> None:
        self._predictions: set[str] = set()
        self._guess = False
        self._guess_has_output = False

    @property
    def are_open(self) -> bool:
        return self._guess or bool(self._predictions)

    def read_text(self, source: str) -> None:
        """The next cell is a text."""
        if _GUESS.search(source) is not None:
            self._guess = True
            self._guess_has_output = False
        elif self._guess_has_output:
            self._guess = False

    def read_code(self, source: str, *, answers: bool) -> None:
        """The next cell is code; ``answers``: it has outputs."""
        self._guess_has_output |= answers
        self._predictions |= set(_PREDICT.findall(source))
        self._predictions -= set(_CAME.findall(source))


def _text_of(output: dict[str, Any]) -> str:
    return "".join(output.get("data", {}).get("text/plain", ""))


def _without_answers(outputs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of the outputs while a question is open: questions and verdicts, and a note where there
    were others."""
    shown = [output for output in outputs if _TELLS_NOTHING.match(_text_of(output))]
    return shown if len(shown) == len(outputs) else [*shown, _grey(_NOT_SHOWN)]


def _answer_output(output: dict[str, Any]) -> dict[str, Any]:
    """An output that shows a right answer, as text in grey; pictures stay."""
    data = output.get("data", {})
    if any(mime.startswith("image/") for mime in data):
        return output
    text = "".join(data.get("text/plain", output.get("text", ""))).strip()
    return _grey(f"what you should see: {text}")


def _grey(words: str) -> dict[str, Any]:
    """An output of the course's own words, in grey."""
    html = words.replace("&", "&amp;").replace("<", "&lt;").replace("\n", "<br>")
    note = f'<div class="gsnb-expected" style="color:#6e7781;padding:2px 0 2px 14px">{html}</div>'
    return {
        "output_type": "display_data",
        "metadata": {},
        "data": {"text/html": [note], "text/plain": [words]},
    }


def documentation_pages(docs: Path) -> dict[str, bytes]:
    """Path in the folder of the notebooks -> content: the pages of the documentation and their
    pictures.

    A link to anything that is not copied becomes its text.
    """
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(docs.glob("*.md"))}

    def kept(match: re.Match[str]) -> str:
        page = match[2].partition("#")[0]
        return (
            match[0]
            if not page or page in texts or re.match(r"https?://|images/", page)
            else match[1]
        )

    links = {
        f"{DOCUMENTATION}/{name}": _LINK.sub(kept, text).encode() for name, text in texts.items()
    }
    pictures = (path for path in sorted((docs / "images").glob("*")) if path.is_file())
    return links | {f"{DOCUMENTATION}/images/{path.name}": path.read_bytes() for path in pictures}


def copy_for_learner(target: Path, *, short: bool = False) -> list[Path]:
    """The learner's edition of the installed notebooks in the folder ``target``; those that are
    there already stay.

    With ``short`` it is the notebook of the short path. The pages of the documentation come along,
    unless ``target`` is a folder of a clone, whose own pages links lead to. Returns the notebooks
    that were written.

    Raises:
        NotADirectoryError: ``target`` is a file. FileNotFoundError: this installation has no
            notebooks.
    """
    if target.exists() and not target.is_dir():
        raise NotADirectoryError(f"{target} is a file; expected a folder for the notebooks")
    docs = docs_folder()
    notebooks = notebooks_folder()
    in_clone = docs is not None and target.resolve().parent == docs.parent == notebooks.parent
    pages = None if in_clone or docs is None else documentation_pages(docs)
    return hand_out(notebooks, target, pages, short=short)


def hand_out(
    source: Path,
    target: Path,
    pages: Mapping[str, bytes] | None = None,
    *,
    short: bool = False,
) -> list[Path]:
    """Write the learner's edition of the notebooks of a folder into the folder ``target``, which
    may hold earlier work.

    Args:
        source: The solved notebooks.
        target: Where the copies go.
        pages: Pages of the documentation (``documentation_pages``) to write beside them, which
            links then lead to. By default none: ``target`` is a folder of the project.
        short: The notebook of the short path in place of the chapters.

    Returns:
        The notebooks that were written; those that are there already stay.

    Raises:
        ValueError: no notebook in ``source``, ``target`` is ``source``, or unbalanced markers.
    """
    paths = []
    for name, notebook in _notebooks(source, target, short=short).items():
        if (target / name).exists():
            continue
        text = _as_text(name, learner_copy, notebook)
        write_file(target / name, text if pages is None else _with_pages_beside(text))
        paths.append(target / name)
    for name, content in (pages or {}).items():
        write_file(target / name, content)
    return paths


def _with_pages_beside(text: str) -> str:
    """A notebook whose links lead to the pages beside it. Links of stored outputs to source files
    become text; run, they link to installed files."""
    return _TO_A_SOURCE_FILE.sub(r"\1", _TO_A_PAGE.sub(f"]({DOCUMENTATION}/", text))


def copy_for_class(
    source: Path,
    target: Path,
    pages: Mapping[str, bytes] | None = None,
    *,
    short: bool = False,
) -> list[Path]:
    """Write a student's copy of the notebooks of a folder, or of one notebook. Returns the files
    written.

    Args:
        source: A folder of notebooks, or one notebook.
        target: Created if it does not exist. Notebooks of the same name in it are replaced.
        pages: Pages of the documentation (``documentation_pages``) to write beside them, which
            links then lead to.
        short: The notebook of the short path in place of the chapters.

    Raises:
        ValueError: no notebook at ``source``, ``target`` is the source's folder, or unbalanced
            markers.
    """
    paths = []
    for name, notebook in _notebooks(source, target, short=short).items():
        paths.append(target / name)
        text = _as_text(name, without_solutions, notebook)
        write_file(paths[-1], text if pages is None else _with_pages_beside(text))
    for name, content in (pages or {}).items():
        write_file(target / name, content)
    return paths


def _notebooks(
    source: Path,
    target: Path,
    *,
    short: bool,
) -> dict[str, Any]:
    """File name -> the notebook as read from JSON."""
    notebooks = [source] if source.is_file() else sorted(source.glob("*.ipynb"))
    if not notebooks:
        raise ArgumentError(f"there is no notebook at {source}")
    if target.resolve() == notebooks[0].parent.resolve():
        raise ArgumentError(
            f"the copies would replace the notebooks in {target}; choose another folder"
        )
    target.mkdir(parents=True, exist_ok=True)
    if short:
        return {SHORT_PATH: short_path(source)}
    return {path.name: read_object(path, "a notebook") for path in notebooks}


def _as_text(name: str, change: Any, notebook: dict[str, Any]) -> str:
    try:
        return json.dumps(change(notebook), indent=1, ensure_ascii=False) + "\n"
    except ValueError as e:
        raise ArgumentError(f"{name}: {e}") from None
