"""A dataclass of options as a command line: ``tyro`` with the texts under the fields as help."""

import ast
import contextlib
import dataclasses
import functools
import inspect
import itertools
import textwrap
import typing
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, is_dataclass
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import tyro

T = TypeVar("T")


EVERYDAY = (
    "system",
    "preset",
    "fidelity",
    "rule_options",
    "device",
    "data",
    "out",
    "reader",
    "onto",
    "resume",
    "evaluate",
    "watch",
    "sh_degree",
    "seed",
    "keyframe_every",
    "data.width",
    "data.stop",
    "data.stride",
    "data.depth_max_m",
    "data.hold_out_every",
    "tsdf.voxel_size_m",
    "tsdf.far_m",
    "seeding.rule",
    "seeding.quadtree_threshold",
    "tracking.poses",
    "tracking.back_end",
    "optim.global_iterations",
    "optim.refine_poses",
    "optim.fit_exposure",
    "final.passes",
)
"""The options that people change, by dotted name, of all systems. ``--help`` of a command with
settings shows only these, ``--help-all`` every one."""


HELP = frozenset({"-h", "--help", "--help-all"})
"""The options that show a help and do nothing else."""


def parse_options(
    options: type[T],
    *,
    prog: str,
    arguments: list[str],
    everyday: Collection[str] = (),
) -> T:
    """``tyro.cli`` with the texts under the fields as help.

    Args:
        options: Dataclass of the options; the text under a field is its help.
        prog: Name of the command in the help.
        arguments: What the user typed after it.
        everyday: Dotted names of the options that ``--help`` shows, all by default; ``--help-all``
            shows every one.
    """
    _explain(options)
    if "--help-all" in arguments:
        arguments = ["--help"]
    elif everyday and HELP & set(arguments):
        options = _options_of_names(everyday, options)
        options.__doc__ = f"{(options.__doc__ or '').strip()} --help-all shows every option."
    return tyro.cli(options, prog=prog, args=arguments)


@dataclass(frozen=True)
class _NotLoaded:
    """Stands for the options of a command in a help that lists none."""


def print_names(prog: str, about: str, lines: Mapping[str, str]) -> None:
    """Print the help of a program that takes one of several commands, as one union of tyro.

    Args:
        prog: Name of the program.
        about: What it does.
        lines: Name of a command -> what it does.
    """
    members = [
        Annotated[_NotLoaded, tyro.conf.subcommand(name, description=" ".join(line.split()))]
        for name, line in lines.items()
    ]
    union: Any = Union[tuple(members)]  # noqa: UP007
    with contextlib.suppress(SystemExit):
        tyro.cli(union, prog=prog, description=about, args=["--help"])


def _options_of_names(
    names: Collection[str],
    options: type[T],
    default: Any = None,
    path: str = "",
) -> type[T]:
    """A dataclass for a help text: the fields of ``options`` that have these dotted names, with
    their defaults."""
    hints = typing.get_type_hints(options, include_extras=True)
    fields = []
    for f in dataclasses.fields(options):  # pyright: ignore[reportArgumentType]
        value = f.default if default is None else getattr(default, f.name)
        if value is dataclasses.MISSING and f.default_factory is not dataclasses.MISSING:
            value = f.default_factory()
        kind = hints[f.name]
        if is_dataclass(value):
            # the settings of a system are at the top
            prefix = path if f.name == "config" else f"{path}{f.name}."
            if any(name.startswith(prefix) for name in names):
                group = _options_of_names(names, type(value), value, prefix)
                kind = (
                    Annotated[(group, *get_args(kind)[1:])]
                    if get_origin(kind) is Annotated
                    else group
                )
                fields.append((f.name, kind, field(default_factory=group)))
        elif path + f.name in names:
            fields.append((f.name, kind, field(default_factory=lambda value=value: value)))
    short_options: Any = dataclasses.make_dataclass(options.__name__, fields, kw_only=True)
    short_options.__doc__ = options.__doc__
    return short_options


def _explain(options: type) -> None:
    """Attach the explanations to the fields of a dataclass, of its bases, and of the dataclasses in
    it."""
    for base in options.__mro__:
        if "__dataclass_fields__" in vars(base):
            _explain_own_fields(base)


@functools.cache
def _explain_own_fields(cls: type) -> None:
    texts = _explanations(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}
    for name, kind in [(n, k) for n, k in inspect.get_annotations(cls).items() if n in fields]:
        plain, *marks = get_args(kind) if get_origin(kind) is Annotated else (kind,)
        if is_dataclass(plain):
            _explain(plain)  # pyright: ignore[reportArgumentType]
        elif name in texts:
            metavar = next((mark.metavar for mark in marks if hasattr(mark, "metavar")), None)
            if tyro.conf.Positional in marks and not metavar:
                metavar = f"[{name.upper()}]" if hasattr(cls, name) else name.upper()
            text = texts[name]
            if "names" in fields[name].metadata:
                text = f"{text} Known: {', '.join(fields[name].metadata['names']())}."
            argument = tyro.conf.arg(help=text, metavar=metavar, help_behavior_hint=_default)
            cls.__annotations__[name] = Annotated[(plain, *marks, argument)]


def _default(value: str) -> str:
    """The default value after an explanation; an empty one says nothing, and the explanation says
    what it means."""
    return "" if value in ("", "''", "{}") else f"(default: {value})"


def _explanations(cls: type) -> dict[str, str]:
    """The text under each field of a dataclass, on one line."""
    try:
        source: Any = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError):  # made at run time, such as the options of one system
        return {}
    return {
        each.target.id: " ".join(text.value.value.split())  # pyright: ignore
        for each, text in itertools.pairwise(source.body)
        if isinstance(each, ast.AnnAssign)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }
