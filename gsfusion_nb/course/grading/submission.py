"""Submissions on disk: whose they are, the code in them, and the statements of it that a function
needs."""

import ast
import re
import symtable
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import ArgumentError, SequenceError
from ...files import read_bytes, read_object
from ..attempt import Failed

_OF_CHAPTER = re.compile(r"\d\d[_.]")
_MAGIC = re.compile(r"^(\s*)[%!?].*$", re.MULTILINE)
_KINDS = ("*.ipynb", "*.py")
_LARGEST_BYTES = 64 << 20
_LARGEST_CODE = 4_000_000
"""Characters of a student's code cells; more cannot be sent to its process for certain."""


@dataclass(frozen=True)
class Cell:
    """A code cell, or a file."""

    label: str
    """``cell 7``: 7 counts all cells of the notebook from 1; or the name of the file."""
    source: str


@dataclass(frozen=True, kw_only=True)
class Submission:
    """The files of one student."""

    student: str
    files: tuple[Path, ...]


@dataclass(frozen=True, kw_only=True)
class Code:
    """What a file holds; ``problem`` says why it holds nothing."""

    file: Path
    cells: tuple[Cell, ...] = ()
    problem: str = ""


def find_submissions(paths: Sequence[Path]) -> list[Submission]:
    """The submissions, by student.

    One folder is that of a class: a file in it belongs to the student whom its sub-folder names,
    else its own name. Of several folders, each belongs to the student whom its name says. A file
    with the name of a chapter (``02_tsdf_fusion.ipynb``) belongs to whom its folder names.

    Raises:
        ValueError: there is nothing at a path, or no notebook and no .py file in it.
    """
    files: dict[str, list[Path]] = {}
    for path in paths:
        submissions = [path] if path.is_file() else sorted(_files_in(path))
        submissions = [
            file
            for file in submissions
            if not any(part.startswith((".", "__")) for part in file.parts)
        ]
        if not submissions:
            raise ArgumentError(f"there is no notebook and no .py file at {path}")
        for file in submissions:
            inner = file.relative_to(path).parts if path.is_dir() else ()
            own = file.absolute().parent.name if _OF_CHAPTER.match(file.name) else file.stem
            student = path.name if inner and len(paths) > 1 else inner[0] if len(inner) > 1 else own
            files.setdefault(student, []).append(file)
    return [
        Submission(student=student, files=tuple(sorted(files[student])))
        for student in sorted(files)
    ]


def _files_in(folder: Path) -> Iterator[Path]:
    """Notebooks and .py files of a folder and its sub-folders; a sub-folder that is a link to a
    folder with some stands for itself, so that its student gets a line."""
    for kind in _KINDS:
        yield from folder.rglob(kind)
    for path in folder.glob("*"):
        if path.is_symlink() and any(any(path.resolve().rglob(kind)) for kind in _KINDS):
            yield path


def read_code(file: Path) -> Code:
    """The code cells of a notebook, or a .py file as one cell; nothing is run. A link is not
    followed: it may lead to what somebody else handed in."""
    try:
        if file.is_symlink():
            raise ArgumentError("it is a link to another place; hand in the file itself")
        if file.suffix == ".ipynb":
            cells = _cells(read_object(file, "a notebook", at_most=_LARGEST_BYTES))
        else:
            source = read_bytes(file, "a Python file", at_most=_LARGEST_BYTES).decode("utf-8-sig")
            cells = (Cell(file.name, source),)
        n_characters = sum(len(cell.source) for cell in cells)
        if n_characters > _LARGEST_CODE:
            raise ArgumentError(
                f"its code has {n_characters:,} characters, more than {_LARGEST_CODE:,}"
            )
        return Code(file=file, cells=cells)
    except (SequenceError, ValueError, OSError, RecursionError) as e:
        return Code(file=file, problem=f"{file.name} cannot be read: {e}")


def _cells(notebook: dict[str, Any]) -> tuple[Cell, ...]:
    """The code cells, numbered from 1 among all cells."""
    try:
        cells = enumerate(notebook["cells"], start=1)
        return tuple(
            Cell(f"cell {n}", "".join(c["source"])) for n, c in cells if c["cell_type"] == "code"
        )
    except (KeyError, TypeError):
        raise ArgumentError("it is not a notebook of format 4") from None


def defines(code: Code, name: str) -> bool:
    """Whether the text of the code has a definition of ``name``, as far as a look at it tells."""
    return any(f"def {name}(" in cell.source or f"{name} =" in cell.source for cell in code.cells)


def choose(codes: Iterable[Code], name: str, chapter: int) -> Code | None:
    """Of a student's files, the one that defines ``name``; of several, that of the chapter, else
    the last."""
    having = [code for code in codes if defines(code, name)]
    of_chapter = [code for code in having if code.file.name.startswith(f"{chapter:02}_")]
    return (of_chapter or having or [None])[-1]


def needed(
    cells: Sequence[Cell],
    name: str,
) -> list[tuple[Cell, ast.stmt]]:
    """The top-level statements that give ``name`` its value, and those that they need, in order;
    with their cells.

    So panels, long fits and a cell that raises do not matter. The last definition counts.

    Raises:
        Failed: it is not defined, or the cell that defines it has a syntax error.
    """
    statements: list[tuple[Cell, ast.stmt]] = []
    for cell in cells:
        try:
            body = ast.parse(_MAGIC.sub(r"\1pass", cell.source)).body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as e:
            if f"def {name}(" in cell.source:
                raise Failed("it is defined", "", f"{cell.label} has a syntax error: {e}") from None
            continue
        statements += [(cell, node) for node in body if not _asks_checker(node, name)]
    uses = [_names(node) for _, node in statements]
    if not any(name in binds for binds, _ in uses):
        raise Failed("it is defined", "", f"there is no function {name}")
    names = {name}
    positions = set[int]()
    while more := [i for i, (binds, _) in enumerate(uses) if binds & names and i not in positions]:
        positions.update(more)
        names.update(*(uses[i][1] for i in more))
    return [statements[i] for i in sorted(positions)]


def _asks_checker(node: ast.stmt, name: str) -> bool:
    """Whether a statement is about the checker of ``name``: ``f = check.f.working(f)``. A
    definition is none, whatever its text says."""
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return False
    return any(
        isinstance(each, ast.Attribute)
        and isinstance(each.value, ast.Attribute)
        and each.value.attr == name
        and isinstance(each.value.value, ast.Name)
        and each.value.value.id == "check"
        for each in ast.walk(node)
    )


def _names(node: ast.stmt) -> tuple[set[str], set[str]]:
    """Global names that a statement binds, and those that it, and the functions in it, read."""
    module = symtable.symtable(ast.unparse(node), "cell", "exec")
    binds = {
        s.get_name()
        for s in module.get_symbols()
        if s.is_assigned() or s.is_imported() or s.is_namespace()
    }
    reads = set[str]()
    scopes = [module]
    while scopes:
        scope = scopes.pop()
        reads |= {s.get_name() for s in scope.get_symbols() if s.is_referenced() and s.is_global()}
        scopes += scope.get_children()
    return binds, reads
