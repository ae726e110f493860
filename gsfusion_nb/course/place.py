"""Where a learner's code is, in words: the line that raised an error, the line of a definition."""

import inspect
import linecache
import sys
from collections.abc import Callable
from typing import Any


def place_of(error: BaseException, function: Callable[..., Any]) -> str:
    """``line 3 of cell 7, `u = x / z` ``: the innermost line of the function's file on the error's way; or "".

    A notebook has one file for each cell, so helper functions of the same cell are found too.
    """
    code = getattr(inspect.unwrap(function), "__code__", None)
    line, trace = 0, error.__traceback__
    while trace is not None:
        if code is not None and trace.tb_frame.f_code.co_filename == code.co_filename:
            line = trace.tb_lineno
        trace = trace.tb_next
    return "" if code is None or not line else _in_words(code.co_filename, line)


def definition_of(function: Callable[..., Any]) -> str:
    """``line 1 of cell 7, `def project(xyz_C):` ``: the first line of a function; its type if it has no code."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return type(function).__name__ if code is None else _in_words(code.co_filename, code.co_firstlineno)


def _in_words(file: str, line: int) -> str:
    text = linecache.getline(file, line).strip()
    words = f"line {line}{_cell(file)}"
    return f"{words}, `{text}`" if text else words


def _cell(file: str) -> str:
    """`` of cell 7`` if the file is a cell of the running notebook; 7 is the number in its brackets."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    number = getattr(getattr(shell, "compile", None), "_filename_map", {}).get(file)
    return "" if number is None else f" of cell {number}"
