"""A learner's function outside the library: where it is, how it is run, and how it comes to the
next chapter.

It runs with a limit of time, and its results become plain values. A chapter goes on with it if it
passes, else with the reference's. An accepted function is kept as source code in the course file,
because a notebook is a process of its own.
"""

import contextlib
import copy
import functools
import inspect
import itertools
import linecache
import signal
import sys
import textwrap
import threading
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from .. import backends
from ..drawing.page import fill
from ..errors import ForeseenError
from ..types import Camera
from .progress import note, now, read_section

LIMIT_S = 60.0
"""How long one call of a learner's function may take, seconds."""
_LONGEST = 10_000
"""Most values that are taken from a generator."""
SECTION = "functions"
"""Of the course file."""


class Failed(ForeseenError):
    """A property does not hold: ``prop`` names it, ``on`` the input, ``detail`` what was returned
    and expected."""

    def __init__(self, prop: str, case: str, detail: str):
        super().__init__(f"{prop} (on {case}): {detail}")
        self.prop = prop
        self.on = case
        self.detail = detail


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


def plain_value(value: Any) -> Any:
    """A copy of a result, made of tensors, numbers, texts, lists, tuples, sets and dicts.

    NumPy arrays become tensors, NumPy numbers and fractions Python's, and what a generator yields a
    list. Objects of the library stay.

    Raises:
        Failed: an object of another kind, or a generator without end.
    """
    if value is None or value is Ellipsis or isinstance(value, (bool, int, float, complex, str)):
        return value
    if isinstance(value, Tensor):
        return value.detach().clone()
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return torch.from_numpy(value.copy())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Fraction):
        return float(value)
    for kind in (list, tuple, set, frozenset):
        if isinstance(value, kind):
            return kind([plain_value(part) for part in value])
    if isinstance(value, dict):
        return {plain_value(key): plain_value(part) for key, part in value.items()}
    if isinstance(value, (Iterator, range)):
        parts = [plain_value(part) for part in itertools.islice(value, _LONGEST + 1)]
        if len(parts) > _LONGEST:
            raise Failed(
                "it comes to an end",
                "",
                f"it returned a generator of more than {_LONGEST:,} values",
            )
        return parts
    if type(value).__module__.startswith(f"{__name__.partition('.')[0]}."):
        return value
    kinds = "tensors, arrays, numbers, texts, lists, tuples"
    raise Failed(
        "it returns plain values", "", f"it returned a {type(value).__name__}; expected {kinds}"
    )


def argument_copy(value: Any) -> Any:
    """A copy of an argument, for those kinds that a learner's function could change."""
    if isinstance(value, Tensor):
        return value.detach().clone()
    return copy.deepcopy(value) if isinstance(value, (np.ndarray, list, dict, Camera)) else value


class _TimeIsUp(BaseException):
    """Raised inside a learner's function that takes too long; no ``except Exception`` of theirs
    catches it."""


@contextlib.contextmanager
def calls_of_library(
    function: Callable[..., Any],
) -> Iterator[list[tuple[int, str, Any]]]:
    """Calls of this package's functions in the learner's file: line, ``full_name``, result; while
    the context is open.

    None for a function of the package itself.
    """
    calls: list[tuple[int, str, Any]] = []
    code: Any = getattr(inspect.unwrap(function), "__code__", None)
    usual = sys.getprofile()

    def watch(frame: Any, event: str, value: Any) -> None:
        # such as len() and [] of a value of the library
        operator = frame.f_code.co_name.startswith("__")
        if (
            event == "return"
            and not operator
            and _is_of_library(frame.f_globals.get("__name__", ""))
        ):
            caller = frame.f_back
            while caller is not None and _passes_on(caller.f_globals.get("__name__", "")):
                caller = caller.f_back
            if caller is not None and caller.f_code.co_filename == code.co_filename:
                module = frame.f_globals.get("__name__", "")
                name = f"{module}.{frame.f_code.co_qualname}"
                calls.append((caller.f_lineno, name, value))

    if code is not None and not _is_of_library(str(function.__module__)):
        sys.setprofile(watch)
    try:
        yield calls
    finally:
        sys.setprofile(usual)


def full_name(function: Callable[..., Any]) -> str:
    """``gsfusion_nb.tsdf.octree.encode``: module and name of a function, without decorators."""
    plain = inspect.unwrap(function)
    return f"{plain.__module__}.{plain.__qualname__}"


def _is_of_library(module: str) -> bool:
    return module.partition(".")[0] == __name__.partition(".")[0]


def _passes_on(module: str) -> bool:
    """Whether frames of a module stand between a learner's call and the library's function."""
    return module == backends.__name__ or module.startswith("jaxtyping")


def run_learner(
    function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]
) -> Any:
    """The result of ``function`` as a plain value. A loop without end is left where the system has
    timers.

    Raises:
        Failed: it took too long, or returned something that is no plain value.
        Exception: what the function raised.
    """
    if not hasattr(signal, "SIGALRM") or threading.current_thread() is not threading.main_thread():
        return plain_value(function(*args, **kwargs))

    def stop(_signal: int, _frame: Any) -> None:
        raise _TimeIsUp

    usual = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
    try:
        return plain_value(function(*args, **kwargs))
    except _TimeIsUp:
        raise endless(LIMIT_S) from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, usual)


def endless(limit_s: float) -> Failed:
    """What is said of a function that did not end within ``limit_s`` seconds."""
    detail = (
        f"it ran for more than {limit_s:g} s. Is there a loop whose condition never becomes false?"
    )
    return Failed("it comes to an end", "", detail)


@dataclass(frozen=True, kw_only=True)
class CodeInUse:
    """One sentence: whose code a chapter uses for an exercise, and why."""

    exercise: str
    state: Literal["yours", "not yet yours", "fails"]
    why: str = ""

    def __repr__(self) -> str:
        if self.state == "yours":
            return f"{self.exercise}: your code is used."
        return f"{self.exercise}: the reference's is used: {self.why}"

    def _repr_html_(self) -> str:
        colours = {"yours": "#1a7f37", "not yet yours": "#6e7781", "fails": "#c62828"}
        return fill("whose_code.html", whose=self, colour=colours[self.state])

    def tell(self) -> None:
        """Show the sentence in the running cell, or print it."""
        ipython = sys.modules.get("IPython")
        if ipython is None or ipython.get_ipython() is None:
            sys.stdout.write(f"{self}\n")
        else:
            ipython.display.display(self)


def with_reference(
    exercise: str, function: Callable[..., Any], reference: Callable[..., Any]
) -> Any:
    """``function``, until a call raises: then a sentence names the line, and ``reference`` answers
    from there on.

    ``function`` gets copies of tensors and arrays. An interrupt is not caught.
    """
    has_failed = False

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal has_failed
        if not has_failed:
            copies = map(argument_copy, args)
            keywords = {name: argument_copy(value) for name, value in kwargs.items()}
            try:
                return plain_value(function(*copies, **keywords))
            except Exception as e:
                has_failed = True
                place = line_of_error(e, function)
                why = f"yours raised {type(e).__name__}{f' in {place}' if place else ''}: {e}"
                CodeInUse(exercise=exercise, state="fails", why=why).tell()
        return reference(*args, **kwargs)

    return call


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
