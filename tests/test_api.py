"""The API page is true: its names exist, its examples run, types are shipped."""

import ast
import importlib
import inspect
import re
import tomllib
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/api.md"
TYPES = {"LossFunction", "UpdateFunction"}
"""Stable names that are not functions or classes, so they have no docstring of their own."""


def get(module: str, name: str) -> object:
    """The object of this name, or the module."""
    value = getattr(importlib.import_module(module), name, None)
    return importlib.import_module(f"{module}.{name}") if value is None else value


def test_every_name_of_the_table_imports_and_has_a_docstring():
    rows = re.findall(
        r"^\| `(gsfusion_nb[\w.]*)` \| (.*) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE
    )
    names = [(module, name) for module, cell in rows for name in re.findall(r"`(\w+)`", cell)]
    assert len(names) > 60
    undocumented = {name for module, name in names if not inspect.getdoc(get(module, name))}
    assert undocumented <= TYPES


def test_the_examples_run():
    """The camera finds its pose again, to a tenth of the distance; Gaussians learn labels; the
    mappers say that they are not the default."""
    blocks = re.findall(
        r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    known: dict = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), known)
    true = known["frame"].T_WC
    start = known["T_start"]
    found = known["T_found"]
    assert (found - true).norm() < 0.1 * (start - true).norm()
    seen_labels = known["seen"].argmax(dim=2)
    assert float((seen_labels == known["labelled"][-1].extra["dark"]).float().mean()) > 0.85
    assert known["mapper"].training.names == {"loss": "charbonnier", "optimiser": "sgd"}
    assert len(known["mapper"].gaussians) > 100
    assert bool(
        torch.stack(
            [c.isfinite().all() for c in vars(known["mapper"].gaussians.params).values()]
        ).all()
    )


def test_the_gradient_of_the_examples_loss_is_that_of_its_value():
    known: dict = {"torch": torch}
    block = next(
        b
        for b in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S)
        if "def charbonnier" in b
    )
    functions: list[ast.stmt] = [
        n
        for n in ast.parse(block).body
        if isinstance(n, ast.ImportFrom | ast.Import | ast.FunctionDef)
    ]
    exec(
        compile(ast.Module(body=functions, type_ignores=[]), str(PAGE), "exec"),
        known,
    )

    class Rendered:
        rgb = torch.rand(4, 5, 3, dtype=torch.float64, requires_grad=True)

    class View:
        rgb = torch.rand(4, 5, 3, dtype=torch.float64)
        pixels = torch.arange(20).reshape(4, 5) % 3 > 0

    loss = known["charbonnier"](Rendered, View)
    torch.testing.assert_close(
        loss.v_rgb.detach(),
        torch.autograd.grad(loss.value, Rendered.rgb)[0],
    )


def test_type_checkers_find_the_types():
    assert (ROOT / "gsfusion_nb/py.typed").is_file()
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert "py.typed" in settings["package-data"]["gsfusion_nb"]
