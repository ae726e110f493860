"""The help of the command line: the explanation under each field of an options class, as flowing text."""

import ast
import functools
import inspect
import itertools
import textwrap
from dataclasses import is_dataclass
from typing import Annotated, Any, TypeVar, get_args, get_origin

T = TypeVar("T")


def parse_options(options: type[T], *, prog: str, arguments: list[str]) -> T:
    """``tyro.cli`` with help texts that are wrapped to the terminal, not at the line breaks of the source.

    Args:
        options: Dataclass of the options; the text under a field is its help.
        prog: Name of the command in the help.
        arguments: What the user typed after it.
    """
    import tyro

    _explain(options)
    return tyro.cli(options, prog=prog, args=arguments)


@functools.cache
def _explain(options: type) -> None:
    """Attach the explanations to the fields of a dataclass, of its bases, and of the dataclasses in it."""
    import tyro

    for base in options.__mro__:
        if "__dataclass_fields__" not in vars(base):
            continue
        texts = _explanations(base)
        for name, kind in list(inspect.get_annotations(base).items()):
            plain, *marks = get_args(kind) if get_origin(kind) is Annotated else (kind,)
            if is_dataclass(plain):
                _explain(plain)  # pyright: ignore[reportArgumentType]
            elif name in texts:
                metavar = next((mark.metavar for mark in marks if hasattr(mark, "metavar")), None)
                if tyro.conf.Positional in marks and not metavar:
                    metavar = f"[{name.upper()}]" if hasattr(base, name) else name.upper()
                explained = tyro.conf.arg(help=texts[name], metavar=metavar, help_behavior_hint=_default)
                base.__annotations__[name] = Annotated[(plain, *marks, explained)]


def _default(value: str) -> str:
    return "" if value in ("", "''", "{}") else f"(default: {value})"


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
