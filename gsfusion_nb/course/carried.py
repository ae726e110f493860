"""A learner's accepted functions from one chapter to the next: kept as source code in the course file.

A notebook is a process of its own, so the functions of chapter 2 are not in the memory of chapter 6. The source of an
accepted function is noted together with what it uses: imports, numbers, and other functions of the notebook.
"""

import inspect
import linecache
import textwrap
import types
from collections.abc import Callable, Iterator
from typing import Any

from .progress import note, now, read_section

SECTION = "functions"


def carry(exercise: str, function: Callable[..., Any]) -> None:
    """Note the source of a function of the running notebook in the course file; others are not noted.

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


def carried() -> dict[str, Callable[..., Any]]:
    """Exercise -> the function noted for it, made from its source.

    A source that does not run any more is left out.

    Raises:
        CourseFileError: the file is damaged, or a newer version of the program wrote it.
    """
    functions = {}
    for exercise, entry in read_section(SECTION).items():
        made = _made(exercise, str(entry.get("function")), str(entry.get("source")))
        if made is not None:
            functions[exercise] = made
    return functions


def _made(exercise: str, name: str, source: str) -> Callable[..., Any] | None:
    file = f"<your {exercise}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    try:
        exec(compile(source, file, "exec"), namespace)  # the learner's own code, from the learner's own file
    except Exception:
        return None
    made = namespace.get(name)
    return made if callable(made) else None


def _needed(function: types.FunctionType, seen: set[int]) -> Iterator[str]:
    """Source of a function, after that of everything in its notebook that it uses."""
    seen.add(id(function))
    for name in sorted(_names(function.__code__)):
        if name in function.__globals__:
            yield from _definition(name, function.__globals__[name], seen)
    yield textwrap.dedent(inspect.getsource(function))


def _definition(name: str, value: Any, seen: set[int]) -> Iterator[str]:
    """Lines that define a global of the notebook; none for what has no short definition, such as an image."""
    if isinstance(value, types.ModuleType):
        yield (
            f"import {value.__name__} as {name}"
            if "." not in value.__name__
            else (f"from {value.__name__.rpartition('.')[0]} import {value.__name__.rpartition('.')[2]} as {name}")
        )
        return
    inner = inspect.unwrap(value) if callable(value) else value
    if isinstance(inner, types.FunctionType) and inner.__module__ == "__main__":
        if id(inner) not in seen:
            yield from _needed(inner, seen)
        if inner.__name__ != name:
            yield f"{name} = {inner.__name__}"
    elif getattr(value, "__module__", "") == f"{__package__}.whose":  # the reference's, for one not yet written
        yield f"from {__package__} import exercises; {name} = exercises()[{value.__name__!r}]._solution"
    elif callable(value) and getattr(value, "__qualname__", ".").isidentifier():
        yield f"from {value.__module__} import {value.__qualname__} as {name}"
    elif isinstance(value, (bool, int, float, str)):
        yield f"{name} = {value!r}"


def _names(code: types.CodeType) -> set[str]:
    """Global names that a function and the functions inside it may use."""
    inside = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*(_names(each) for each in inside))
