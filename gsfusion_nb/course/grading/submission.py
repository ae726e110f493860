"""Submissions on disk: whose they are, and the code in them."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...files import SequenceError, read_bytes, read_object
from .sandbox_program import Cell

_OF_CHAPTER = re.compile(r"\d\d[_.]")
LARGEST_BYTES = 64 << 20
"""Of a submitted file."""


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
    """The submissions in files and folders, by student.

    A file is a submission of the student whom its name says. In a folder, files belong to the student whom their
    sub-folder names, or, without one, their own name; in nbgrader's tree that is the folder under ``submitted``. A file
    with the name of a chapter (``02_tsdf_fusion.ipynb``) names nobody: it belongs to whom its folder names.

    Raises:
        ValueError: there is nothing at a path, or no notebook and no .py file in it; or files of several students
            would be taken for those of one.
    """
    files: dict[str, list[Path]] = {}
    seen: dict[tuple[str, ...], Path] = {}
    for path in paths:
        if not path.exists():
            raise ValueError(f"there is nothing at {path}")
        found = [path] if path.is_file() else _files_in(path)
        if not found:
            raise ValueError(f"there is no notebook and no .py file in {path}")
        root = path / "submitted" if (path / "submitted").is_dir() else path
        for file in found:
            inner = file.relative_to(root).parts if path.is_dir() and file.is_relative_to(root) else (file.name,)
            if len(inner) > 1 and seen.setdefault(inner, path) != path:
                inside = "/".join(inner)
                raise ValueError(f"{inside} is in {seen[inner]} and in {path}: name the folder that holds both of them")
            files.setdefault(inner[0] if len(inner) > 1 else _named_by(file), []).append(file)
    return [Submission(student=student, files=tuple(sorted(files[student]))) for student in sorted(files)]


def _named_by(file: Path) -> str:
    """Whose a file is that lies in no student's sub-folder."""
    return file.resolve().parent.name if _OF_CHAPTER.match(file.name) else file.stem


def _files_in(folder: Path) -> list[Path]:
    root = folder / "submitted" if (folder / "submitted").is_dir() else folder
    found = (p for pattern in ("*.ipynb", "*.py") for p in root.rglob(pattern))
    return sorted(p for p in found if p.is_file() and not any(part.startswith((".", "__")) for part in p.parts))


def read_code(file: Path) -> Code:
    """The code cells of a notebook, or a .py file as one cell; nothing is run."""
    if file.is_symlink():
        return Code(file=file, problem=f"{file.name} is a link to another file")
    try:
        if file.suffix == ".ipynb":
            return Code(file=file, cells=_cells(read_object(file, "a notebook", at_most=LARGEST_BYTES)))
        source = read_bytes(file, "a Python file", at_most=LARGEST_BYTES).decode("utf-8-sig")
        return Code(file=file, cells=(Cell(file.name, source),))
    except UnicodeDecodeError:
        return Code(file=file, problem=f"{file.name} is not text in UTF-8")
    except (SequenceError, ValueError, OSError) as e:
        return Code(file=file, problem=f"{file.name} cannot be read: {_one_line(e)}")


def _cells(notebook: dict[str, Any]) -> tuple[Cell, ...]:
    """The code cells, numbered from 1 among all cells.

    Raises:
        ValueError: it is no notebook, or one in another language.
    """
    cells = notebook.get("cells")
    if not isinstance(cells, list) or not all(isinstance(c, dict) for c in cells):
        raise ValueError("it is not a notebook of format 4: it has no list of cells")
    metadata = notebook.get("metadata")
    language = _language(metadata if isinstance(metadata, dict) else {})
    if language.lower() not in ("", "python", "python3", "ipython"):
        raise ValueError(f"its kernel is for {language}, not for Python")
    found = []
    for number, cell in enumerate(cells, start=1):
        source = cell.get("source", "")
        text = "".join(source) if isinstance(source, list) and all(isinstance(s, str) for s in source) else source
        if cell.get("cell_type") == "code" and isinstance(text, str):
            found.append(Cell(f"cell {number}", text))
    return tuple(found)


def _language(metadata: dict[str, Any]) -> str:
    for section, key in (("language_info", "name"), ("kernelspec", "language")):
        part = metadata.get(section)
        if isinstance(part, dict) and isinstance(part.get(key), str):
            return part[key]
    return ""


def defines(code: Code, name: str) -> bool:
    """Whether the text of the code has a definition of ``name``, as far as a look at it tells."""
    return any(f"def {name}(" in cell.source or f"{name} =" in cell.source for cell in code.cells)


def choose(codes: Iterable[Code], name: str, chapter: int) -> Code | None:
    """Of a student's files, the one that defines ``name``; of several, that of the chapter, else the last."""
    having = [code for code in codes if defines(code, name)]
    of_chapter = [code for code in having if code.file.name.startswith(f"{chapter:02}_")]
    return (of_chapter or having or [None])[-1]


def _one_line(error: BaseException) -> str:
    text = str(error).splitlines()
    return text[0] if text else type(error).__name__
