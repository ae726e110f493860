"""The pages of the API reference: the public names of each room, which Sphinx fills in from the docstrings."""

import ast
import importlib
import inspect
from collections.abc import Sequence
from importlib.util import resolve_name
from itertools import pairwise
from pathlib import Path
from types import ModuleType

ROOMS = (
    "types", "config", "geometry", "tsdf", "gaussians", "render", "seeding", "optim", "tracking", "export",
    "evaluation", "mapping", "data", "runs", "viz", "teaching", "lab", "backends", "own_code", "observing",
)  # fmt: skip
"""Rooms whose names a reader uses, in the order of the floors; the other rooms serve these."""


def public_names(path: Path) -> dict[str, str]:
    """Name -> module that it comes from, below the file's own ("" for itself), classes first.

    Those that a package passes on (``from .a import b as b``), or that a module defines, without an underscore.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {node.name: "" for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    if path.name == "__init__.py":
        nodes = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level]
        names = {a.name: "." * node.level + (node.module or "") for node in nodes for a in node.names if a.asname}
    public = [name for name in names if not name.startswith("_")]
    return {name: names[name] for name in sorted(public, key=lambda name: (name.islower(), name.lower()))}


def api_page(room: str, package: Path) -> str:
    """A page in Markdown for one room."""
    path = package / room / "__init__.py"
    path = path if path.exists() else package / f"{room}.py"
    name = f"gsfusion_nb.{room}"
    module = importlib.import_module(name)
    parts = [f"# {name}", "", _first_paragraphs(module.__doc__ or "")]
    for entry, source in public_names(path).items():
        thing = getattr(module, entry)
        home = getattr(thing, "__module__", "").split(".")[1:2]
        if inspect.ismodule(thing):
            parts += [_directive("automodule", thing.__name__, ("members",))]
        elif home and home != [room] and home[0] in ROOMS:
            parts += [f"`{entry}`: see [{home[0]}]({home[0]}.md)."]
        elif inspect.isclass(thing):
            parts += [_directive("autoclass", f"{name}.{entry}", ("members",))]
        elif callable(thing):
            parts += [_directive("autofunction", f"{name}.{entry}")]
        elif _explained(importlib.import_module(resolve_name(source or ".", name)), entry):
            parts += [_directive("autodata", f"{resolve_name(source or '.', name)}.{entry}", ("no-value",))]
    return "\n".join(parts) + "\n"


def _explained(module: ModuleType, name: str) -> bool:
    """Whether a constant has a docstring below it."""
    body = ast.parse(inspect.getsource(module)).body
    for node, following in pairwise(body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(t, ast.Name) and t.id == name for t in targets):
            return isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
    return False


def _first_paragraphs(doc: str) -> str:
    return inspect.cleandoc(doc).partition("\n\n")[0]


def _directive(kind: str, name: str, options: Sequence[str] = ()) -> str:
    lines = "".join(f"   :{option}:\n" for option in options)
    return f"\n```{{eval-rst}}\n.. {kind}:: {name}\n{lines}```\n"


def api_index() -> str:
    """The page that lists the rooms."""
    listed = "\n".join(ROOMS)
    return (
        "# API reference\n\nThe public names of each room, from their docstrings: shapes in brackets, units in the "
        "names, the source of a formula with its number.\nWhat a room is for: [architecture](../ARCHITECTURE.md).\n\n"
        f"```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n"
    )
