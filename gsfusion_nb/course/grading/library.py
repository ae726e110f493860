"""The package as a submission sees it: a copy without the solutions, the checkers, the notebooks,
the documentation and the fast kernels, and without the operation that an exercise's function
becomes."""

import ast
import hashlib
import inspect
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib.util import cache_from_source
from pathlib import Path

from ... import backends
from ..exercise import Exercise, exercises

PACKAGE = "gsfusion_nb"
_ROOT = Path(__file__).resolve().parents[2]
_LEFT_OUT = ("notebooks", "docs", "kernels", "__pycache__", "cli", "compare", "viz")
"""Folders of the package that no submission needs."""
_OF_THE_PROGRAM = ("answering.py", "data.py", "pickled.py", "submission.py")
"""What of this folder runs in the process of a submission."""
_STUB = "without_solutions.py"
_REMOVED = (
    "RuntimeError('this function of the library computes what the exercise asks for; write it "
    "yourself')"
)


def copy_library(folder: Path) -> Path:
    """Write the copy into ``folder``, which becomes a place to import from. Returns it."""
    target = folder / PACKAGE
    for source in sorted(_ROOT.rglob("*")):
        name = source.relative_to(_ROOT)
        if source.is_file() and _is_copied(name):
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target / name)
            _copy_compiled(source, target / name)
    shutil.copy2(_ROOT / "course" / "grading" / _STUB, target / "course" / "__init__.py")
    return folder


def _is_copied(name: Path) -> bool:
    parts = name.parts
    if parts[0] in _LEFT_OUT or "__pycache__" in parts:
        return False
    if parts[:2] == ("course", "grading"):
        return name.name in (*_OF_THE_PROGRAM, "__init__.py")
    if parts[0] != "course":
        return True
    return name not in {Path("course", "__init__.py"), *_modules_of_exercises()}


def _modules_of_exercises() -> Iterator[Path]:
    """Files of this package with judges, solutions and wrong answers."""
    for exercise in exercises().values():
        path = _file_of(exercise.judge)
        if path.is_relative_to(_ROOT):  # a lecturer's own are elsewhere
            yield path.relative_to(_ROOT)


def _file_of(function: Callable) -> Path:
    """Of the module of a function, whatever it is wrapped in."""
    return Path(str(sys.modules[function.__module__].__file__)).resolve()


def _copy_compiled(source: Path, target: Path) -> None:
    """The compiled file too, which saves a second at each start."""
    compiled = Path(cache_from_source(str(source)))
    if source.suffix == ".py" and compiled.is_file():
        copy = Path(cache_from_source(str(target)))
        copy.parent.mkdir(exist_ok=True)
        shutil.copy2(compiled, copy)


def library_for(exercise: Exercise, folder: Path) -> Path:
    """The copy in ``folder`` for one exercise: without the functions of the library that compute
    what it asks for. Made beside it when it is first asked for; shares all other files with it."""
    removed = list(_functions_of(exercise))
    if not removed:
        return folder
    target = folder.with_name(f"{folder.name}-{exercise.name}")
    if target.exists():
        return target
    new = folder.with_name(f"{target.name}.{os.getpid()}")
    shutil.copytree(folder, new, copy_function=os.link)
    for function in removed:
        name = _file_of(function).relative_to(_ROOT)
        _remove(new / PACKAGE / name, function.__name__)
    try:
        new.rename(target)
    except OSError:  # another process was quicker
        shutil.rmtree(new, ignore_errors=True)
    return target


def _functions_of(exercise: Exercise) -> Iterator[Callable]:
    """The plain functions that compute the answer of an exercise."""
    if exercise.becomes is not None:
        yield backends.reference_of(exercise.becomes.operation)
    for function in exercise.replaces:
        yield inspect.unwrap(function)


def _remove(path: Path, name: str) -> None:
    """Replace the body of a function in a file, and the equation in its documentation, by an
    error."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines(keepends=True)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef) and node.name == name:
            first = node.body[0]
            lines[first.lineno - 1 : node.end_lineno] = [
                f"{' ' * first.col_offset}raise {_REMOVED}\n"
            ]
            break
    path.unlink()  # it is shared with the other copies
    path.write_text("".join(lines), encoding="utf-8")
    Path(cache_from_source(str(path))).unlink(missing_ok=True)


def grader_digest() -> str:
    """A hash of the program that marks: the same marks come from the same."""
    digest = hashlib.sha256()
    for path in sorted(_ROOT.rglob("*.py")):
        if path.relative_to(_ROOT).parts[0] not in _LEFT_OUT:
            digest.update(path.read_bytes())
    return digest.hexdigest()
