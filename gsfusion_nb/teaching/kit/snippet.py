"""A wrong answer as a student would have written it: under the exercise's name, without words that give it away."""

import ast
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Callable, Iterator
from typing import Any

from ..exercise import Exercise


def snippet(exercise: Exercise, function: Callable[..., Any]) -> str:
    """Source code of a wrong answer; a call of the course's solution becomes ``correct_<exercise>``."""
    parts = [_plain_source(function)]
    seen = {function, exercise._solution}
    constants: dict[str, Any] = {}
    queue = [function]
    while queue:
        for name, value in _globals_of(queue.pop()):
            if isinstance(value, int | float) and not isinstance(value, bool):
                constants[name] = value
            elif inspect.isfunction(value) and name.startswith("_") and value not in seen:
                seen.add(value)
                parts.insert(0, _plain_source(value))
                queue.append(value)
    if constants:
        parts.insert(0, "\n".join(f"{name} = {value:.5g}" for name, value in sorted(constants.items())))
    code = "\n\n".join(parts)
    code = re.sub(rf"\b{re.escape(exercise._solution.__name__)}\b", f"correct_{exercise.name}", code)
    return re.sub(rf"\b{re.escape(function.__name__)}\b", exercise.name, code)


def _globals_of(function: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    """Names of the function's own module that its code uses, also in its inner functions."""
    module = getattr(inspect.unwrap(function), "__globals__", {})
    codes = [inspect.unwrap(function).__code__]
    while codes:
        code = codes.pop()
        codes += [c for c in code.co_consts if inspect.iscode(c)]
        for name in sorted(code.co_names):
            value = module.get(name)
            if not inspect.isfunction(value) or value.__module__ == function.__module__:
                yield name, value


def _plain_source(function: Callable[..., Any]) -> str:
    """Source code without docstring and comments."""
    source = textwrap.dedent(inspect.getsource(function))
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column].rstrip()
    definition = ast.parse(source).body[0]
    assert isinstance(definition, ast.FunctionDef)
    first = definition.body[0]
    if ast.get_docstring(definition) is not None and len(definition.body) > 1:
        del lines[first.lineno - 1 : first.end_lineno]
    return "\n".join(line for line in lines if line.strip())
