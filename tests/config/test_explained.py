"""Every setting is explained where it is defined, with its unit: the command line's help is made of these texts."""

import ast
import dataclasses
import inspect
import itertools
import textwrap
from typing import Any

import pytest

from gsfusion_nb.config import GSFusionConfig, RtgSlamConfig

UNITS = {"_m": "metre", "_deg": "degree", "_px": "pixel"}


def config_classes(cls: type) -> set[type]:
    """A settings class and all that it holds."""
    default = cls()
    held = [getattr(default, f.name) for f in dataclasses.fields(cls)]
    return {cls}.union(*(config_classes(type(value)) for value in held if dataclasses.is_dataclass(value)))


def explanations(cls: type) -> dict[str, str]:
    """The text under each field, inherited ones included."""
    texts = {}
    for base in (base for base in reversed(cls.__mro__) if dataclasses.is_dataclass(base)):
        source: Any = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        for field, text in itertools.pairwise(source.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                texts[field.target.id] = str(text.value.value)  # pyright: ignore[reportAttributeAccessIssue]
    return texts


CLASSES = sorted(config_classes(GSFusionConfig) | config_classes(RtgSlamConfig), key=lambda cls: cls.__name__)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_setting_is_explained_with_its_unit(cls):
    texts, default = explanations(cls), cls()
    for f in dataclasses.fields(cls):
        if dataclasses.is_dataclass(getattr(default, f.name)):
            continue
        assert len(texts.get(f.name, "")) > 20, f"{cls.__name__}.{f.name} has no explanation"
        for ending, unit in UNITS.items():
            assert not f.name.endswith(ending) or unit in texts[f.name], f"{cls.__name__}.{f.name}: no unit"
