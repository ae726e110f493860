"""How a learner's function comes to the next chapter: an accepted one is kept as source code in the
course file, because a notebook is a process of its own."""

import inspect
import linecache
import textwrap
import types
from collections.abc import Callable, Iterator
from typing import Any

from .progress import note, now, read_section

SECTION = "functions"
"""Of the course file."""


def keep_source(exercise: str, function: Callable[..., Any]) -> None:
    """Note the source of a function of the running notebook, with what it uses, in the course file.

    Functions that are not a notebook's, or have no source, are not noted.

    Raises:
        CourseFileError: the file cannot be read or written.
    """
    function = inspect.unwrap(function)
    is_plain = isinstance(function, types.FunctionType) and function.__closure__ is None
    if not is_plain or function.__module__ != "__main__" or function.__name__ == "<lambda>":
        return
    try:
        source = "\n".join(_needed(function, set()))
    except (OSError, TypeError):  # typed where Python keeps no source
        return
    note(SECTION, exercise, function=function.__name__, source=source, kept=now())


def functions_of_earlier_chapters() -> dict[str, Callable[..., Any]]:
    """Exercise -> the function noted for it, made from its source; a source that does not run any
    more is left out.

    Raises:
        CourseFileError: the file is damaged, or a newer version of the program wrote it.
    """
    functions = {}
    for exercise, entry in read_section(SECTION).items():
        source = str(entry.get("source"))
        file = f"<your {exercise}>"
        linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
        namespace: dict[str, Any] = {"__name__": "__main__"}
        try:
            # the learner's own code, from the learner's own file
            exec(compile(source, file, "exec"), namespace)
            functions[exercise] = namespace[str(entry.get("function"))]
        except Exception:
            continue
    return {exercise: function for exercise, function in functions.items() if callable(function)}


def _needed(function: types.FunctionType, visited: set[int]) -> Iterator[str]:
    """Source of a function, after that of everything in its notebook that it uses: imports,
    numbers, functions."""
    visited.add(id(function))
    for name in sorted(_names(function.__code__)):
        if name in function.__globals__:
            yield from _definition(name, function.__globals__[name], visited)
    yield textwrap.dedent(inspect.getsource(function))


def _definition(name: str, value: Any, visited: set[int]) -> Iterator[str]:
    """Lines that define a global of the notebook; none for what has no short definition, such as an
    image."""
    if isinstance(value, types.ModuleType):
        package, _, module = value.__name__.rpartition(".")
        yield f"{f'from {package} ' if package else ''}import {module} as {name}"
        return
    inner = inspect.unwrap(value) if callable(value) else value
    if isinstance(inner, types.FunctionType) and inner.__module__ == "__main__":
        if id(inner) not in visited:
            yield from _needed(inner, visited)
        if inner.__name__ != name:
            yield f"{name} = {inner.__name__}"
    elif callable(value) and getattr(value, "__qualname__", ".").isidentifier():
        yield f"from {value.__module__} import {value.__qualname__} as {name}"
    elif isinstance(value, (bool, int, float, str)):
        yield f"{name} = {value!r}"


def _names(code: types.CodeType) -> set[str]:
    """Global names that a function and the functions inside it may use."""
    inner_codes = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*(_names(each) for each in inner_codes))
