"""The learner's edition of the course: no solutions, the stored pictures of what to expect, in a folder that is kept.

A learner's work is never overwritten: a notebook is replaced only if it is, byte for byte, the one that was handed out.
Otherwise a new edition is written beside it, and the message says so.
"""

import copy
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..errors import SequenceError
from ..files import write_file
from ..foreign import read_bytes, read_object
from .course_pages import with_links_to_pages
from .without_solutions import without_solutions

_HANDED_OUT = ".handed_out.json"
"""In the learner's folder: name of a notebook -> SHA-256 of the edition handed out last."""
_SOLUTION = "BEGIN SOLUTION"
_CHECK = re.compile(r"^check\.(?P<name>\w+)\((?P=name)\)$", re.MULTILINE)
_PREDICT, _CAME = (re.compile(rf"\b{word}\(\s*\"(\w+)\"") for word in ("predict", "came"))
_WHOSE = re.compile(r"^\w+: (your code is used\.|the reference's is used: )")

_NOTE = (
    "*The pictures and numbers below were stored: they show what to expect. Running a cell replaces them by yours. An "
    "exercise that you have not solved yet says so, and the reference's code goes on.*"
)

State = Literal["new", "unchanged", "renewed", "beside"]


@dataclass(frozen=True)
class HandedOut:
    """One notebook in the learner's folder, and what happened to it."""

    path: Path
    """The file of the newest edition."""
    state: State

    def __str__(self) -> str:
        said = {
            "new": "written",
            "unchanged": "as before",
            "renewed": "replaced by a newer edition (you had not changed it)",
            "beside": "is a newer edition of a notebook that you have changed; yours was not touched",
        }
        return f"{self.path}: {said[self.state]}"


def learner_copy(notebook: dict[str, Any]) -> dict[str, Any]:
    """A copy of the notebook (as read from JSON) without solutions, with the stored outputs as what to expect.

    What would show the learner's own answer stands as "what you should see" (a verdict) or goes (whose code was used).
    The outputs between a prediction and what came of it are folded.

    Raises:
        ValueError: a marker of a solution without its partner; the message names the cell.
    """
    solved = [_is_solved(cell) for cell in notebook["cells"]]
    marked, unknown = copy.deepcopy(notebook), set()
    for cell, is_solved in zip(marked["cells"], solved, strict=True):
        if cell["cell_type"] == "code":
            cell["outputs"] = [
                _expected(output) if is_solved else output for output in cell["outputs"] if not _says_whose(output)
            ]
            if unknown:  # JupyterLab unfolds them when the cell runs
                cell["metadata"] = cell["metadata"] | {"collapsed": True, "jupyter": {"outputs_hidden": True}}
            source = "".join(cell["source"])
            unknown = (unknown | set(_PREDICT.findall(source))) - set(_CAME.findall(source))
    learner = without_solutions(marked, outputs=True)
    learner["cells"].insert(1, {"cell_type": "markdown", "id": "what-to-expect", "metadata": {}, "source": [_NOTE]})
    return learner


def hand_out(source: Path, target: Path, pages: Mapping[str, bytes] | None = None) -> list[HandedOut]:
    """Write the learner's edition of the notebooks of a folder into the folder ``target``, which may hold earlier work.

    Args:
        source: The solved notebooks.
        target: Where the copies go.
        pages: Pages of the documentation (``course_pages.pages``) to write beside them, which links then lead to. By
            default none: ``target`` is a folder of the project.

    Returns:
        The notebooks.

    Raises:
        ValueError: no notebook in ``source``, ``target`` is ``source``, or unbalanced markers.
    """
    notebooks = sorted(source.glob("*.ipynb"))
    if not notebooks:
        raise ValueError(f"there is no notebook at {source}")
    if target.resolve() == source.resolve():
        raise ValueError(f"the copies would replace the notebooks in {target}; choose another folder")
    target.mkdir(parents=True, exist_ok=True)
    handed_out = _read_handed_out(target / _HANDED_OUT)
    done = []
    for path in notebooks:
        try:
            notebook = learner_copy(read_object(path, "a notebook"))
        except ValueError as e:
            raise ValueError(f"{path}: {e}") from None
        text = json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
        content = (text if pages is None else with_links_to_pages(text)).encode()
        done.append(_place(target / path.name, content, handed_out.get(path.name, "")))
        handed_out[path.name] = _hash(content)
        write_file(target / _HANDED_OUT, json.dumps(handed_out, indent=1) + "\n")
    for name, content in (pages or {}).items():
        _place(target / name, content, handed_out.get(name, ""))
        handed_out[name] = _hash(content)
    write_file(target / _HANDED_OUT, json.dumps(handed_out, indent=1) + "\n")
    return done


def _place(path: Path, content: bytes, handed_out: str) -> HandedOut:
    """Write one notebook, beside the learner's if that has changed."""
    if not path.exists():
        write_file(path, content)
        return HandedOut(path, "new")
    if _hash(content) == handed_out or _bytes(path) == content:
        return HandedOut(path, "unchanged")
    if _hash(_bytes(path)) == handed_out:
        write_file(path, content)
        return HandedOut(path, "renewed")
    number = 2
    while (beside := path.with_name(f"{path.stem}.edition{number}{path.suffix}")).exists():
        if _bytes(beside) == content:
            return HandedOut(beside, "unchanged")
        number += 1
    write_file(beside, content)
    return HandedOut(beside, "beside")


def _read_handed_out(path: Path) -> dict[str, str]:
    """The hashes; empty where the file is missing or damaged, so that every notebook counts as changed."""
    try:
        return {name: str(value) for name, value in read_object(path, "hashes of the notebooks").items()}
    except (SequenceError, OSError):
        return {}


def _is_solved(cell: dict[str, Any]) -> bool:
    source = "".join(cell["source"])
    return cell["cell_type"] == "code" and (_SOLUTION in source or _CHECK.search(source) is not None)


def _expected(output: dict[str, Any]) -> dict[str, Any]:
    """An output that shows a right answer, as text in grey; pictures stay."""
    data = output.get("data", {})
    if any(mime.startswith("image/") for mime in data):
        return output
    text = "".join(data.get("text/plain", output.get("text", ""))).strip()
    words = f"what you should see: {text}"
    escaped = words.replace("&", "&amp;").replace("<", "&lt;").replace("\n", "<br>")
    shown = f'<div class="gsnb-expected" style="color:#6e7781;padding:2px 0 2px 14px">{escaped}</div>'
    return {"output_type": "display_data", "metadata": {}, "data": {"text/html": [shown], "text/plain": [words]}}


def _says_whose(output: dict[str, Any]) -> bool:
    return _WHOSE.match("".join(output.get("data", {}).get("text/plain", ""))) is not None


def _bytes(path: Path) -> bytes:
    return read_bytes(path, "a notebook")


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
