"""The help of the command line: the explanation under each field of an options class, as flowing text."""

import ast
import contextlib
import functools
import inspect
import itertools
import shutil
import sys
import textwrap
from dataclasses import is_dataclass
from typing import Annotated, Any, TextIO, TypeVar, cast, get_args, get_origin

T = TypeVar("T")


def parse_options(options: type[T], *, prog: str, arguments: list[str]) -> T:
    """``tyro.cli`` with help texts wrapped to the width of the terminal.

    Args:
        options: Dataclass of the options; the text under a field is its help.
        prog: Name of the command in the help.
        arguments: What the user typed after it.
    """
    import tyro

    _explain(options)
    with contextlib.redirect_stdout(cast(TextIO, _Wrapped(sys.stdout))):
        return tyro.cli(options, prog=prog, args=arguments)


class _Wrapped:
    """A stream that wraps long lines of plain text: tyro prints the description of a command as one line."""

    def __init__(self, stream: Any):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        width = shutil.get_terminal_size().columns
        lines = text.split("\n")
        plain = [line[:1].isalpha() and len(line) > width for line in lines]  # tables begin with a frame or a colour
        wrapped = [textwrap.fill(line, width) if p else line for line, p in zip(lines, plain, strict=True)]
        return self._stream.write("\n".join(wrapped))


def _explain(options: type) -> None:
    """Attach the explanations to the fields of a dataclass, of its bases, and of the dataclasses in it."""
    for base in options.__mro__:
        if "__dataclass_fields__" in vars(base):
            _explain_own_fields(base)


@functools.cache
def _explain_own_fields(cls: type) -> None:
    import tyro

    texts = _explanations(cls)
    for name, kind in list(inspect.get_annotations(cls).items()):
        plain, *marks = get_args(kind) if get_origin(kind) is Annotated else (kind,)
        if is_dataclass(plain):
            _explain(plain)  # pyright: ignore[reportArgumentType]
        elif name in texts:
            metavar = next((mark.metavar for mark in marks if hasattr(mark, "metavar")), None)
            if tyro.conf.Positional in marks and not metavar:
                metavar = f"[{name.upper()}]" if hasattr(cls, name) else name.upper()
            hint = functools.partial(_default, text=texts[name])
            explained = tyro.conf.arg(help=texts[name], metavar=metavar, help_behavior_hint=hint)
            cls.__annotations__[name] = Annotated[(plain, *marks, explained)]


def _default(value: str, text: str) -> str:
    """The default value after an explanation that does not give it."""
    return "" if value in ("", "''", "{}") or "default" in text.lower() else f"(default: {value})"


def _explanations(cls: type) -> dict[str, str]:
    """The text under each field of a dataclass, on one line."""
    try:
        source: Any = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError):  # made at run time, such as the options of one system
        return {}
    return {
        field.target.id: " ".join(text.value.value.split())  # pyright: ignore
        for field, text in itertools.pairwise(source.body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }
