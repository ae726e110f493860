"""Lines of a learner's function, and the values that it returns, in words."""

import inspect
import linecache
import sys
from collections.abc import Callable
from typing import Any

from torch import Tensor


def line_of_error(error: BaseException, function: Callable[..., Any]) -> str:
    """``line 3 of cell 7, `u = x / z` ``: the innermost line of the function's file on the error's
    way; or "".

    A notebook has one file for each cell, so helper functions of the same cell are found too.
    """
    code = getattr(inspect.unwrap(function), "__code__", None)
    line = 0
    trace = error.__traceback__
    while trace is not None:
        if code is not None and trace.tb_frame.f_code.co_filename == code.co_filename:
            line = trace.tb_lineno
        trace = trace.tb_next
    return "" if code is None or not line else line_in_words(code.co_filename, line)


def line_of_definition(function: Callable[..., Any]) -> str:
    """``line 1 of cell 7, `def project(xyz_C):` ``: the first line of a function; its type if it
    has no code."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return (
        type(function).__name__
        if code is None
        else line_in_words(code.co_filename, code.co_firstlineno)
    )


def line_in_words(file: str, line: int) -> str:
    """The line, the number in the brackets of its cell, if it is one of the running notebook, and
    its text."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    cell = getattr(getattr(shell, "compile", None), "_filename_map", {}).get(file)
    text = linecache.getline(file, line).strip()
    return f"line {line}{'' if cell is None else f' of cell {cell}'}{f', `{text}`' if text else ''}"


def kind_of(tensor: Tensor) -> str:
    """Shape and type of a tensor."""
    return f"{list(tensor.shape)} {str(tensor.dtype).removeprefix('torch.')}"


def in_words(value: Any) -> str:
    """A value in a few words: a small one in full, a tensor by shape, type and range."""
    if isinstance(value, (bool, int, float, str)) or value is None:
        return repr(value)
    if not isinstance(value, Tensor):
        count = f" of {len(value)}" if isinstance(value, (list, tuple)) else ""
        return f"a {type(value).__name__}{count}"
    if value.numel() <= 4 and value.ndim <= 1:
        return str(value.tolist())
    words = kind_of(value)
    finite = value[value.isfinite()].double()
    if finite.numel():
        words += f", {float(finite.min()):.4g} to {float(finite.max()):.4g}"
    missing = value.numel() - finite.numel()
    return words + (f", {missing} not finite" if missing else "")
