"""Every setting is explained where it is defined, with its unit: the command line's help is made of
these texts."""

import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
import typing
from typing import Any

import pytest

from gsfusion_nb.mapping import SYSTEMS

UNITS = {"_m": "metre", "_deg": "degree", "_px": "pixel"}


def config_classes(cls: type) -> set[type]:
    """A settings class and all that it holds."""
    default = cls()
    held = [getattr(default, f.name) for f in dataclasses.fields(cls)]
    return {cls}.union(
        *(config_classes(type(value)) for value in held if dataclasses.is_dataclass(value))
    )


def explanations(cls: type) -> dict[str, str]:
    """The text under each field, inherited ones included, and under each value without a type."""
    texts = {}
    for base in (base for base in reversed(cls.__mro__) if dataclasses.is_dataclass(base)):
        source: Any = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        for field, text in itertools.pairwise(source.body):
            if (
                isinstance(field, ast.AnnAssign | ast.Assign)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                target = field.target if isinstance(field, ast.AnnAssign) else field.targets[0]
                texts[ast.unparse(target)] = str(text.value.value)
    return texts


CLASSES = sorted(
    {cls for mapper in SYSTEMS.values() for cls in config_classes(mapper.config_type)},
    key=lambda cls: cls.__name__,
)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_setting_is_explained_with_its_unit(cls):
    texts = explanations(cls)
    default = cls()
    for f in dataclasses.fields(cls):
        if dataclasses.is_dataclass(getattr(default, f.name)):
            continue
        assert len(texts.get(f.name, "")) > 20, f"{cls.__name__}.{f.name} has no explanation"
        for ending, unit in UNITS.items():
            assert not f.name.endswith(ending) or unit in texts[f.name], (
                f"{cls.__name__}.{f.name}: no unit"
            )


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_words_that_a_text_quotes_are_allowed(cls):
    texts = explanations(cls)
    kinds = typing.get_type_hints(cls)
    for f in dataclasses.fields(cls):
        if typing.get_origin(kinds[f.name]) is typing.Literal:
            quoted = set(re.findall(r'"(\w+)"', texts[f.name]))
            assert quoted <= set(typing.get_args(kinds[f.name])), f"{cls.__name__}.{f.name}"


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_what_is_explained_as_a_setting_can_be_set(cls):
    assert set(explanations(cls)) <= {f.name for f in dataclasses.fields(cls)}
