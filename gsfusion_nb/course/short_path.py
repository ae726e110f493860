"""The short path: one notebook of two hours, made of cells of the chapters.

``short_path.toml`` in the folder of the notebooks names the cells, with a text before each part.
"""

import ast
import re
import textwrap
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ..errors import ArgumentError
from ..files import read_object, read_text

Cell = dict[str, Any]

SHORT_PATH = "short_path.ipynb"

_FOLDED = {"source_hidden": True}
"""Of the cell in which a chapter imports."""

_HEADING = re.compile(r"^## (?:\d+\. )?", re.MULTILINE)
"""Of a section of a chapter."""

_SECTION_COMMENT = re.compile(r" *#[^#\n]*\bsection \d+.*$")


def short_path(folder: Path) -> dict[str, Any]:
    """The notebook, solved, with the outputs that its cells have in their chapters, in the form
    that JSON has.

    Args:
        folder: The solved chapters, with ``short_path.toml``.

    Raises:
        ValueError: a cell that ``short_path.toml`` names is not in its chapter.
    """
    plan = folder / "short_path.toml"
    parts = tomllib.loads(read_text(plan, "the parts of the short path"))["part"]
    chapters = {
        path.name[:2]: read_object(path, "a notebook") for path in sorted(folder.glob("*.ipynb"))
    }
    all_cells = {
        f"{number}/{cell['id']}": cell
        for number, chapter in chapters.items()
        for cell in chapter["cells"]
    }
    names = [name for part in parts for name in part["cells"]]
    picture_cells = [part["attachments"] for part in parts if "attachments" in part]
    if missing := [name for name in [*names, *picture_cells] if name not in all_cells]:
        raise ArgumentError(f"{plan} names cells that no chapter has: {', '.join(missing)}")
    cells: list[Cell] = []
    for number, part in enumerate(parts):
        pictures = all_cells[part["attachments"]] if "attachments" in part else {}
        cells.append(_text(f"part-{number}", part["text"], pictures))
        cells += [
            _fitting(all_cells[name], fresh=name in part.get("fresh", ())) for name in part["cells"]
        ]
    cells = [_used_constants(cell, cells) for cell in cells]
    notebooks = [chapters[number] for number in sorted({name[:2] for name in names})]
    return notebooks[0] | {"cells": [cells[0], _imports(notebooks, cells), *cells[1:]]}


def _text(name: str, text: str, pictures: Cell) -> Cell:
    """A cell with the text of a part, and the pictures that are attached to another cell."""
    attachments = {"attachments": pictures["attachments"]} if pictures else {}
    return attachments | {
        "cell_type": "markdown",
        "id": name,
        "metadata": {},
        "source": text.strip().splitlines(keepends=True),
    }


def _fitting(cell: Cell, *, fresh: bool) -> Cell:
    """A chapter's cell below the headings of the parts; ``fresh``: without its outputs."""
    if cell["cell_type"] == "code":
        return cell | {"outputs": []} if fresh else cell
    return cell | {
        "source": _HEADING.sub("### ", "".join(cell["source"])).splitlines(keepends=True)
    }


def _used_constants(cell: Cell, cells: Iterable[Cell]) -> Cell:
    """A chapter's cell of constants with those that ``cells`` use, and without comments that name a
    section of the chapter. Other cells are as they are."""
    if "parameters" not in cell["metadata"].get("tags", ()):
        return cell
    source = "".join(cell["source"])
    others = [other for other in cells if other is not cell]
    used = {
        node.id
        for node in _nodes([*others, cell])
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
    }
    dropped = {
        node.lineno
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign)
        and node.lineno == node.end_lineno
        and not used & {target.id for target in node.targets if isinstance(target, ast.Name)}
    }
    lines = [
        _SECTION_COMMENT.sub("", line)
        for number, line in enumerate(source.splitlines(), 1)
        if number not in dropped
    ]
    text = "\n".join(lines)
    metadata = dict(cell["metadata"])
    if "quick" in metadata:  # pieces of the source, and smaller ones for tests
        pairs = {
            _SECTION_COMMENT.sub("", full): _SECTION_COMMENT.sub("", less)
            for full, less in metadata["quick"].items()
        }
        metadata["quick"] = {full: less for full, less in pairs.items() if full in text}
    return cell | {"source": text.splitlines(keepends=True), "metadata": metadata}


def _imports(
    chapters: Iterable[dict[str, Any]],
    cells: Iterable[Cell],
) -> Cell:
    """A folded cell with what the folded cells of ``chapters`` import and ``cells`` use, each name
    once."""
    used = {node.id for node in _nodes(cells) if isinstance(node, ast.Name)}
    begins: dict[str, str] = {}
    joined_lines = [
        c
        for chapter in chapters
        for c in chapter["cells"]
        if c["metadata"].get("jupyter") == _FOLDED
    ]
    for node in _nodes(joined_lines):
        if isinstance(node, ast.Import | ast.ImportFrom):
            begin = f"from {node.module} import" if isinstance(node, ast.ImportFrom) else "import"
            begins = {
                ast.unparse(a): begin for a in node.names if (a.asname or a.name) in used
            } | begins
    lines = [f"import {name}" for name, begin in sorted(begins.items()) if begin == "import"]
    for begin in sorted({*begins.values()} - {"import"}):
        names = ", ".join(sorted(name for name, its in begins.items() if its == begin))
        lines += [f"{begin} {row.rstrip(',')}" for row in textwrap.wrap(names, 119 - len(begin))]
    source = "\n".join(["# what this page uses", *lines]).splitlines(keepends=True)
    cell = {
        "cell_type": "code",
        "execution_count": None,
        "id": "imports",
        "metadata": {"jupyter": _FOLDED},
    }
    return cell | {"outputs": [], "source": source}


def _nodes(cells: Iterable[Cell]) -> Iterator[ast.AST]:
    """The syntax of the code cells."""
    for cell in cells:
        if cell["cell_type"] == "code":
            yield from ast.walk(ast.parse("".join(cell["source"])))
