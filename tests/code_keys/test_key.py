"""The key of a rule: each way to change what it does without changing its own text is seen, or it
cannot be kept.

Every case gives the same thing twice, and another thing once: the first two have one key, the third
another.
"""

import array
import base64
import collections
import contextlib
import contextvars
import dataclasses
import datetime
import decimal
import enum
import fractions
import functools
import hashlib
import importlib
import itertools
import json
import math
import operator
import os
import random
import re
import subprocess
import sys
import threading
import types
import uuid
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
import torch
from torch.nn.modules.module import register_module_forward_hook
from torch.overrides import TorchFunctionMode

from gsfusion_nb import backends
from gsfusion_nb.code_keys import CodeKey, code_key, installed
from gsfusion_nb.code_keys.digest import UnhashableError
from gsfusion_nb.code_keys.key import differing, loaded_values
from gsfusion_nb.code_keys.patches import (
    changed_values,
    changes_since,
    library_state,
    patches,
    switches,
)
from gsfusion_nb.code_keys.values import ValueHash
from gsfusion_nb.seeding import SeedContext, is_built_in, registered
from gsfusion_nb.seeding.rule_code import load_rule_file


class Slots:
    """Values in slots."""

    __slots__ = ("step",)

    def __init__(self, step):
        self.step = step


class Plain:
    """Values in a dict."""

    def __init__(self, step):
        self.step = step


class SlotsThatHide(Slots):
    """Leaves out its slot where it is pickled."""

    __slots__ = ()

    def __getstate__(self):
        return None


class Named(Plain):
    """Is pickled by a name, as if it were the only one."""

    def __reduce__(self):
        return "NAMED"


class Hides(Plain):
    """Leaves out its value where it is pickled."""

    def __getstate__(self):
        return {}


class Called(Plain):
    """A rule's helper that is an object."""

    def __call__(self, x):
        return x * self.step


class Point(NamedTuple):
    """A named tuple."""

    x: int
    y: int


@dataclasses.dataclass
class Settings:
    """A dataclass."""

    step: int = 3


@dataclasses.dataclass(frozen=True, slots=True)
class FrozenSettings:
    """A frozen one with slots."""

    step: int = 3


class Mode(enum.Enum):
    """An enumeration."""

    FEW = 1
    MANY = 2


class Net(torch.nn.Module):
    """A network whose forward depends on more than its parameters."""

    def __init__(
        self,
        step=2,
        weight=1.0,
        buffer=0.0,
        *,
        training=True,
        hook=None,
        unsaved=0.0,
    ):
        super().__init__()
        self.step = step
        self.layer = torch.nn.Linear(2, 2)
        torch.nn.init.constant_(self.layer.weight, weight)
        torch.nn.init.zeros_(self.layer.bias)
        self.register_buffer("shift", torch.full((2,), buffer))
        self.register_buffer("unsaved", torch.full((2,), unsaved), persistent=False)
        self.train(training)
        if hook is not None:
            self.layer.register_forward_hook(hook)


def doubled(module, inputs, output):
    return output * 2


def tripled(module, inputs, output):
    return output * 3


def with_counter(n):
    counter = itertools.count()
    for _ in range(n):
        next(counter)
    return counter


def with_attribute(value):
    def helper(x):
        return x

    helper.step = value
    return helper


def nested(value):
    def outer():
        def inner():
            return value

        return inner

    return outer()


def with_default(value):
    def helper(x, step=value, *, other=1):
        return x * step * other

    return helper


def with_keyword(value):
    def helper(x, *, step=value):
        return x * step

    return helper


def wrapped(value):
    """A decorator as functools.wraps makes them, with a value that only the wrapper has."""

    def plain(x):
        return x

    @functools.wraps(plain)
    def wrapper(x):
        return plain(x) * value

    return wrapper


class Decorator:
    """A decorator that is an object."""

    def __init__(self, function, step):
        functools.update_wrapper(self, function)
        self.function = function
        self.step = step

    def __call__(self, x):
        return self.function(x) * self.step


def made_class(**members):
    return type("Made", (), members)


def subclass_of(step):
    base = type("Base", (), {"step": step})
    return type("Made", (base,), {})


def property_of(step):
    return type("Made", (), {"step": property(lambda self: step)})


def static_of(step):
    return type(
        "Made",
        (),
        {"step": staticmethod(lambda: step), "other": classmethod(lambda cls: step)},
    )


def cached_of(step):
    @functools.lru_cache(maxsize=step)
    def helper(x):
        return x

    return helper


def cell_later(value):
    def rule():
        return later

    if value:
        later = value
    return rule


def descriptor_of(step):
    class Descriptor:
        def __get__(self, instance, owner):
            return step

    return type("Made", (), {"step": Descriptor()})


def torch_generator(seed):
    return torch.Generator().manual_seed(seed)


def circle(value):
    found = [value]
    found.append(found)
    return found


def set_in_reverse(values):
    """An equal set that was filled in another order."""
    found = set()
    for value in sorted(values, reverse=True):
        found.add(value)
    return found


NET = Net(hook=doubled)
"""Its hook has a number that no second one has."""
VALUES: dict[str, Any] = {
    "int": (3, 3, 4),
    "bool or int": (True, True, 1),
    "float": (0.1, 0.1, 0.1 + 1e-17 + 1e-16),
    "negative zero": (0.0, 0.0, -0.0),
    "complex": (1j, 1j, 2j),
    "text": ("a", "a", "b"),
    "bytes": (b"a", b"a", b"b"),
    "bytearray": (bytearray(b"a"), bytearray(b"a"), bytearray(b"b")),
    "None": (None, None, 0),
    "ellipsis": (..., ..., NotImplemented),
    "range": (range(3), range(3), range(0, 3, 2)),
    "slice": (slice(1, 9), slice(1, 9), slice(1, 9, 2)),
    "list": ([1, 2], [1, 2], [2, 1]),
    "tuple or list": ((1, 2), (1, 2), [1, 2]),
    "dict": ({"a": 1}, {"a": 1}, {"a": 2}),
    "order of a dict": ({"a": 1, "b": 2}, {"a": 1, "b": 2}, {"b": 2, "a": 1}),
    "set": ({"a", "b", "c"}, set_in_reverse({"a", "b", "c"}), {"a", "b", "d"}),
    "frozenset": (frozenset({1, 2}), frozenset({2, 1}), frozenset({1, 3})),
    "set of functions": ({doubled, tripled}, {tripled, doubled}, {doubled}),
    "list in itself": (circle(1), circle(1), circle(2)),
    "SimpleNamespace": (
        types.SimpleNamespace(s=20),
        types.SimpleNamespace(s=20),
        types.SimpleNamespace(s=5),
    ),
    "mapping proxy": (*(types.MappingProxyType({"a": v}) for v in (1, 1, 2)),),
    "ChainMap": (*(collections.ChainMap({"a": v}, {"b": 0}) for v in (1, 1, 2)),),
    "deque": (collections.deque([1]), collections.deque([1]), collections.deque([1], maxlen=4)),
    "Counter": (collections.Counter("aab"), collections.Counter("aab"), collections.Counter("abb")),
    "factory of a defaultdict": (*(collections.defaultdict(kind) for kind in (int, int, list)),),
    "array": (array.array("f", [1]), array.array("f", [1]), array.array("f", [2])),
    "memoryview": (memoryview(b"a"), memoryview(b"a"), memoryview(b"b")),
    "Path": (Path("a"), Path("a"), Path("b")),
    "Fraction": (fractions.Fraction(1, 3), fractions.Fraction(1, 3), fractions.Fraction(1, 4)),
    "Decimal": (decimal.Decimal("1.0"), decimal.Decimal("1.0"), decimal.Decimal("1.1")),
    "date": (*(datetime.date(2026, 1, day) for day in (1, 1, 2)),),
    "UUID": (uuid.UUID(int=1), uuid.UUID(int=1), uuid.UUID(int=2)),
    "compiled pattern": (re.compile("a+"), re.compile("a+"), re.compile("a*")),
    "flags of a pattern": (re.compile("a"), re.compile("a"), re.compile("a", re.IGNORECASE)),
    "enumeration": (Mode.FEW, Mode.FEW, Mode.MANY),
    "named tuple": (Point(1, 2), Point(1, 2), Point(1, 3)),
    "dataclass": (Settings(3), Settings(3), Settings(4)),
    "frozen dataclass with slots": (FrozenSettings(3), FrozenSettings(3), FrozenSettings(4)),
    "object": (Plain(3), Plain(3), Plain(4)),
    "object with slots": (Slots(3), Slots(3), Slots(4)),
    "object that hides its state": (Hides(3), Hides(3), Hides(4)),
    "object with slots that hides its state": (
        SlotsThatHide(3),
        SlotsThatHide(3),
        SlotsThatHide(4),
    ),
    "object that is pickled by a name": (Named(3), Named(3), Named(4)),
    "callable object": (Called(3), Called(3), Called(4)),
    "object in an object": (Plain(Plain(3)), Plain(Plain(3)), Plain(Plain(4))),
    "method of an object": (Called(3).__call__, Called(3).__call__, Called(4).__call__),
    "partial": (*(functools.partial(pow, v) for v in (2, 2, 3)),),
    "keyword of a partial": (*(functools.partial(int, base=v) for v in (2, 2, 3)),),
    "itemgetter": (operator.itemgetter(0), operator.itemgetter(0), operator.itemgetter(1)),
    "methodcaller": (*(operator.methodcaller("add", v) for v in (1, 1, 2)),),
    "count": (with_counter(1), with_counter(1), with_counter(2)),
    "Python's random numbers": (random.Random(1), random.Random(1), random.Random(2)),
    "function of a library": (math.sin, math.sin, math.cos),
    "method of a number": ((3).__add__, (3).__add__, (4).__add__),
    "function that NumPy vectorises": (*(np.vectorize(with_default(v)) for v in (1, 1, 2)),),
    "function that numba compiles": (*(numba.njit(f) for f in (nested(1), nested(1), nested(2))),),
    "options of numba": (*(numba.njit(nested(1), fastmath=v) for v in (False, False, True)),),
    "documentation of a class": (*(made_class(__doc__=text) for text in ("3", "3", "4")),),
    "method of a text": ("a".join, "a".join, "b".join),
    "NumPy scalar": (np.float64(1.5), np.float64(1.5), np.float64(2.5)),
    "type of a NumPy scalar": (np.float64(1), np.float64(1), np.float32(1)),
    "array of NumPy": (np.arange(3), np.arange(3), np.arange(3) + 1),
    "shape of an array": (np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((3, 2))),
    "array of objects": (*(np.array([v, "x"], dtype=object) for v in (1, 1, 2)),),
    "structured array": (*(np.array([(v, 2.0)], dtype="i4,f8") for v in (1, 1, 2)),),
    "type of an array": (np.dtype("f4"), np.dtype("f4"), np.dtype(">f4")),
    "function of NumPy": (np.maximum, np.maximum, np.minimum),
    "NumPy's random numbers": (*(np.random.default_rng(seed) for seed in (1, 1, 2)),),
    "tensor": (torch.ones(3), torch.ones(3), torch.zeros(3)),
    "one bit of a tensor": (torch.ones(3), torch.ones(3), torch.tensor([1.0, 1.0, 1.0000001])),
    "strides of a tensor": (torch.ones(2, 2), torch.ones(2, 2), torch.ones(2, 2).T),
    "sparse tensor": (*(torch.eye(2).mul(v).to_sparse() for v in (1, 1, 2)),),
    "dtype of torch": (torch.float32, torch.float32, torch.float64),
    "function of torch": (torch.sum, torch.sum, torch.mean),
    "torch's random numbers": (torch_generator(1), torch_generator(1), torch_generator(2)),
    "weights of a network": (Net(), Net(), Net(weight=1.5)),
    "buffer of a network": (Net(), Net(), Net(buffer=1.0)),
    "buffer that is not saved": (Net(), Net(), Net(unsaved=1.0)),
    "attribute of a network": (Net(), Net(), Net(step=3)),
    "network that trains": (Net(), Net(), Net(training=False)),
    "hook of a network": (NET, NET, Net(hook=tripled)),
    "stride of a layer": (*(torch.nn.MaxPool2d(3, stride=s) for s in (1, 1, 2)),),
    "default": (with_default(1), with_default(1), with_default(2)),
    "keyword default": (with_keyword(1), with_keyword(1), with_keyword(2)),
    "attribute of a function": (with_attribute(1), with_attribute(1), with_attribute(2)),
    "closure in a closure": (nested(1), nested(1), nested(2)),
    "name that is not assigned yet": (cell_later(0), cell_later(0), cell_later(1)),
    "wrapper of functools.wraps": (wrapped(1), wrapped(1), wrapped(2)),
    "decorator that is an object": (*(Decorator(doubled, v) for v in (1, 1, 2)),),
    "function under torch.no_grad": (*(torch.no_grad()(f) for f in (doubled, doubled, tripled)),),
    "function in an lru_cache": (*(functools.cache(f) for f in (doubled, doubled, tripled)),),
    "size of an lru_cache": (cached_of(1), cached_of(1), cached_of(2)),
    "attribute of a class": (made_class(step=1), made_class(step=1), made_class(step=2)),
    "base class": (subclass_of(1), subclass_of(1), subclass_of(2)),
    "property": (property_of(1), property_of(1), property_of(2)),
    "static method": (static_of(1), static_of(1), static_of(2)),
    "descriptor": (descriptor_of(1), descriptor_of(1), descriptor_of(2)),
}


def rule_with(value):
    """A rule that uses a value."""

    def rule(ctx):
        return ctx.seeds_at(ctx.pixels(), value)

    return rule


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES)
def test_values_of_every_kind_are_seen(values):
    first, same, other = (loaded_values(rule_with(value)) for value in values)
    assert [len(digest) for digest in (first, same, other)] == [32] * 3
    assert first == same
    assert first != other


UNHASHABLE = {
    "lock": (threading.Lock, "cannot pickle"),
    "generator": (lambda: (x for x in ()), "generator"),
    "local of a thread": (threading.local, "cannot pickle"),
    "context variable": (lambda: contextvars.ContextVar("x"), "ContextVar"),
    "open file": (lambda: open(os.devnull), "cannot be hashed"),  # noqa: SIM115
    "lock in an object": (lambda: Plain([threading.Lock()]), "cannot pickle"),
    "function that NumPy wraps": (lambda: np.frompyfunc(doubled, 3, 1), "it is not"),
    "hash in the making": (hashlib.sha256, "cannot pickle"),
}


@pytest.mark.parametrize(("make", "reason"), UNHASHABLE.values(), ids=UNHASHABLE)
def test_what_cannot_be_hashed_is_said_with_its_place(make, reason):
    value = make()
    key = code_key(rule_with(value))
    assert "value, around rule," in key.reason
    assert reason in key.reason
    if hasattr(value, "close"):
        value.close()


def test_lookups_by_name_in_a_notebook_are_no_key(monkeypatch):
    cell = types.ModuleType("__main__")
    exec(
        "STEP = 3\ndef rule(ctx):\n    return globals()['STEP']\ndef net(ctx):\n    return "
        "ctx.eval()\n",
        vars(cell),
    )
    monkeypatch.setitem(sys.modules, "__main__", cell)
    assert "looks names up by globals()" in code_key(cell.rule).reason
    assert code_key(cell.net).reason == ""


HELPER = """
import math
import torch
STEP = 3
CFG = {"step": 20}
def radius(x):
    return x * STEP
class Grid:
    step = 4
    def size(self):
        return self.step
GRID = Grid()
"""
RULE = (
    "{imports}\ndef rule(ctx):\n    {inside}\n    return ctx.seeds_at(ctx.pixels()[::{use}], 1.0)\n"
)


@pytest.fixture
def files(tmp_path):
    """``files(name=text, ...)`` writes modules beside ``rule.py`` and gives the rule, loaded
    anew."""

    def write(**texts):
        for name, text in texts.items():
            path = tmp_path / f"{name.replace('__', '/')}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        return load_rule_file(f"{tmp_path / 'rule.py'}:rule")

    return write


IMPORTS = {
    "module": ("import helper", "pass", "helper.STEP"),
    "name": ("from helper import STEP", "pass", "STEP"),
    "function": ("from helper import radius", "pass", "radius(2)"),
    "alias": ("import helper as h", "pass", "h.GRID.size()"),
    "star": ("from helper import *", "pass", "GRID.step"),
    "inside": ("", "import helper", "helper.radius(1)"),
    "by getattr": ("import helper", "pass", "getattr(helper, 'ST' + 'EP')"),
    "by vars": ("import helper", "pass", "vars(helper)['STEP']"),
    "by import_module": (
        "import importlib",
        "helper = importlib.import_module('helper')",
        "helper.STEP",
    ),
    "if it is there": (
        "try:\n    import helper\nexcept ImportError:\n    helper = None",
        "pass",
        "helper.STEP",
    ),
}


@pytest.mark.parametrize(
    ("imports", "inside", "use"),
    IMPORTS.values(),
    ids=IMPORTS,
)
def test_an_edited_helper_is_seen_however_it_is_imported(files, imports, inside, use):
    text = RULE.format(imports=imports, inside=inside, use=use)
    first = code_key(files(rule=text, helper=HELPER))
    again = code_key(files(rule=text, helper=HELPER))
    edited = code_key(files(helper=HELPER.replace("STEP = 3", "STEP = 5")))
    assert first.digest == again.digest != edited.digest
    assert "file helper" in differing(first.parts, edited.parts)


CHANGES_OF_A_LOADED_MODULE = {
    "constant": ("helper.STEP", lambda helper: setattr(helper, "STEP", 5)),
    "item of a dict": ("helper.CFG['step']", lambda helper: helper.CFG.update(step=5)),
    "function": ("helper.radius(1)", lambda helper: setattr(helper, "radius", lambda x: x + 9)),
    "method": ("helper.GRID.size()", lambda helper: setattr(helper.Grid, "size", lambda self: 9)),
    "attribute of a class": ("helper.GRID.size()", lambda helper: setattr(helper.Grid, "step", 9)),
    "attribute of an object": (
        "helper.GRID.size()",
        lambda helper: setattr(helper.GRID, "step", 9),
    ),
    "global of a function": ("helper.radius(1)", lambda helper: setattr(helper, "STEP", 9)),
    "name that is made": (
        "getattr(helper, 'ST' + 'EP')",
        lambda helper: setattr(helper, "STEP", 9),
    ),
    "code of a function": ("helper.radius(1)", lambda helper: set_code(helper.radius)),
    "default of a function": (
        "helper.radius(1)",
        lambda helper: setattr(helper.radius, "__defaults__", (9,)),
    ),
}


def set_code(function):
    function.__code__ = (lambda x: x + 9).__code__


@pytest.mark.parametrize(
    ("use", "change"), CHANGES_OF_A_LOADED_MODULE.values(), ids=CHANGES_OF_A_LOADED_MODULE
)
def test_a_change_of_a_loaded_module_is_seen(files, use, change):
    """As a worker has it that loaded an older file, or a notebook that sets a value."""
    rule = files(
        rule=RULE.format(imports="import helper", inside="pass", use=use),
        helper=HELPER,
    )
    before = code_key(rule)
    change(vars(sys.modules[rule.__module__])["helper"])
    after = code_key(rule)
    assert before.digest != after.digest
    assert "file helper" not in differing(before.parts, after.parts)


HELPERS: dict[str, tuple[str, str, Any]] = {
    "value of an enumeration": (
        "import enum\nclass Mode(enum.Enum):\n    FEW = 3\n",
        "helper.Mode.FEW.value",
        lambda helper: setattr(helper.Mode.FEW, "_value_", 5),
    ),
    "default of a named tuple": (
        "import collections\nP = collections.namedtuple('P', 'step', defaults=(3,))\n",
        "helper.P().step",
        lambda helper: setattr(helper.P.__new__, "__defaults__", (5,)),
    ),
    "class that has a function of a library": (
        "import torch\nclass A:\n    act = torch.nn.functional.relu\n    step = 3\n",
        "helper.A.step",
        lambda helper: setattr(helper.A, "step", 5),
    ),
    "module of another class": (
        "import types\nclass M(types.ModuleType):\n    step = property(lambda self: 5)\n",
        "getattr(helper, 'step', 3)",
        lambda helper: setattr(helper, "__class__", helper.M),
    ),
    "attribute of the class of a module": (
        "import sys, types\nclass M(types.ModuleType):\n    kept = 3\n"
        "    step = property(lambda self: self.kept)\n",
        "(setattr(helper, '__class__', helper.M), helper.step)",
        lambda helper: setattr(helper.M, "kept", 5),
    ),
    "default of a lambda in a dict": (
        "F = {'f': lambda x, step=3: x * step}\n",
        "helper.F['f'](1)",
        lambda helper: setattr(helper.F["f"], "__defaults__", (5,)),
    ),
    "content of a cell": (
        "def made(step):\n    return lambda: step\nf = made(3)\n",
        "helper.f()",
        lambda helper: setattr(helper.f.__closure__[0], "cell_contents", 5),
    ),
    "keyword in a partial": (
        "import functools\nf = functools.partial(dict, step=3)\n",
        "helper.f()['step']",
        lambda helper: helper.f.keywords.update(step=5),
    ),
    "class of an object": (
        "class A:\n    step = 3\nclass B:\n    step = 5\na = A()\n",
        "helper.a.step",
        lambda helper: setattr(helper.a, "__class__", helper.B),
    ),
    "bases of a class": (
        "class A:\n    step = 3\nclass B:\n    step = 5\nclass C(A):\n    pass\n",
        "helper.C.step",
        lambda helper: setattr(helper.C, "__bases__", (helper.B,)),
    ),
    "attribute of a metaclass": (
        "class Meta(type):\n    step = 3\nclass A(metaclass=Meta):\n    pass\n",
        "helper.A.step",
        lambda helper: setattr(helper.Meta, "step", 5),
    ),
    "classes that register themselves": (
        "class A:\n    known = []\n    def __init_subclass__(cls):\n        A.known.append(cls)\n",
        "len(helper.A.known)",
        lambda helper: type("B", (helper.A,), {}),
    ),
    "globals of a function": (
        "import types\nf = types.FunctionType((lambda: STEP).__code__, {'STEP': 3})\n",
        "helper.f()",
        lambda helper: helper.f.__globals__.update(STEP=5),
    ),
    "global that shadows a builtin": (
        "def f():\n    return abs(-3)\n",
        "helper.f()",
        lambda helper: setattr(helper, "abs", lambda x: 5),
    ),
    "global that shadowed a builtin": (
        "def abs(x):\n    return 5\ndef f():\n    return abs(-3)\n",
        "helper.f()",
        lambda helper: delattr(helper, "abs"),
    ),
    "text that is evaluated": (
        "CODE = '3'\n",
        "eval(helper.CODE)",
        lambda helper: setattr(helper, "CODE", "5"),
    ),
    "cached property": (
        "import functools\nclass A:\n    @functools.cached_property\n    def step(self):\n"
        "        return 3\na = A()\n",
        "helper.a.step",
        lambda helper: vars(helper.a).update(step=5),
    ),
    "factory of a dataclass": (
        "import dataclasses\nSTEP = 3\n@dataclasses.dataclass\nclass A:\n"
        "    step: int = dataclasses.field(default_factory=lambda: STEP)\n",
        "helper.A().step",
        lambda helper: setattr(helper, "STEP", 5),
    ),
    "function that gives a context": (
        "import contextlib\nSTEP = 3\n@contextlib.contextmanager\ndef held():\n    yield STEP\n",
        "helper.held().__enter__()",
        lambda helper: setattr(helper, "STEP", 5),
    ),
    "forward of one network": (
        "import torch\nnet = torch.nn.Identity()\n",
        "helper.net(3)",
        lambda helper: setattr(helper.net, "forward", lambda x: 5),
    ),
    "array under a view": (
        "import numpy as np\nall_rows = np.full(4, 3)\nrows = all_rows[:2]\n",
        "helper.rows[0]",
        lambda helper: helper.all_rows.fill(5),
    ),
    "number of C": (
        "import ctypes\nstep = ctypes.c_int(3)\n",
        "helper.step.value",
        lambda helper: setattr(helper.step, "value", 5),
    ),
    "operator of a class": (
        "class A:\n    def __mul__(self, x):\n        return 3\na = A()\n",
        "helper.a * 1",
        lambda helper: setattr(helper.A, "__mul__", lambda self, x: 5),
    ),
}
"""A helper module, what the rule uses of it, and a change of the module after it was loaded."""


@pytest.mark.parametrize(("helper", "use", "change"), HELPERS.values(), ids=HELPERS)
def test_what_changes_in_a_helper_is_seen(files, helper, use, change):
    rule = files(rule=f"import helper\ndef rule(ctx):\n    return {use}\n", helper=helper)
    first_value = rule(None)
    keys = [code_key(rule), code_key(rule)]
    change(vars(sys.modules[rule.__module__])["helper"])
    keys.append(code_key(rule))
    assert rule(None) != first_value
    assert [key.reason for key in keys] == [""] * 3
    assert keys[0].digest == keys[1].digest != keys[2].digest


DECORATOR = """
import functools
def NAME(f):
    @functools.wraps(f)
    def g(ARGS):
        return RESULT
    return g
"""
MODULES = {
    "helper of a helper": {
        "helper": "import deeper\nSTEP = deeper.STEP\n",
        "deeper": "STEP = {}\n",
    },
    "package": {
        "helper": "from parts.deep import STEP\n",
        "parts/__init__": "",
        "parts/deep": "STEP = {}\n",
    },
    "relative import": {
        "helper": "from parts import STEP\n",
        "parts/__init__": "from .deep import STEP\n",
        "parts/deep": "STEP = {}\n",
    },
    "beginning of a package": {
        "helper": "from parts.deep import STEP\n",
        "parts/__init__": "X = {}\n",
        "parts/deep": "STEP = 3\n",
    },
    "folder without a beginning": {
        "helper": "from loose.deep import STEP\n",
        "loose/deep": "STEP = {}\n",
    },
    "import in a function that is not called": {
        "helper": "STEP = 3\ndef f():\n    import deeper\n",
        "deeper": "X = {}\n",
    },
    "modules that import each other": {
        "helper": "import deeper\nSTEP = 3\n",
        "deeper": "import helper\nX = {}\n",
    },
    "decorator in a helper": {
        "helper": "from deco import more\n@more\ndef f():\n    return 3\nSTEP = f()\n",
        "deco": DECORATOR.replace("NAME", "more").replace("ARGS", "").replace("RESULT", "f() + {}"),
    },
}


@pytest.mark.parametrize("modules", MODULES.values(), ids=MODULES)
def test_all_modules_that_are_imported_are_seen(tmp_path, modules):
    keys = []
    (tmp_path / "rule.py").write_text(
        RULE.format(imports="import helper", inside="pass", use="helper.STEP")
    )
    for value in (1, 1, 2):
        for name, text in modules.items():
            path = tmp_path / f"{name}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text.replace("{}", str(value)))
        keys.append(code_key(load_rule_file(f"{tmp_path / 'rule.py'}:rule")).digest)
    assert keys[0] == keys[1] != keys[2]


def test_a_decorator_of_the_rule_itself_is_seen(files):
    deco = (
        DECORATOR.replace("NAME", "thin").replace("ARGS", "ctx").replace("RESULT", "f(ctx)[::{}]")
    )
    text = (
        "from deco import thin\n@thin\ndef rule(ctx):\n    return ctx.seeds_at(ctx.pixels(), 1.0)\n"
    )
    keys = [code_key(files(rule=text, deco=deco.format(n))).parts["values"] for n in (2, 2, 3)]
    assert keys[0] == keys[1] != keys[2]


def test_a_rule_of_this_package_in_somebodys_wrapper_is_not_of_this_package():
    rule: Any = registered()["uniform"]

    @functools.wraps(rule)
    def mine(ctx, **options):
        return rule(ctx, **options)[::2]

    assert is_built_in(rule)
    assert not is_built_in(mine)
    assert not is_built_in(torch.no_grad()(mine))


def test_an_edit_within_the_same_second_of_the_same_length_is_executed(files):
    """Python would take its compiled copy of the helper, which has the same time and size."""
    text = RULE.format(imports="import helper", inside="pass", use="helper.STEP")
    values = []
    for step in (3, 5):
        rule = files(rule=text, helper=f"STEP = {step}\n")
        file = Path(sys.modules[rule.__module__].__file__ or "").parent / "helper.py"
        os.utime(file, (1_700_000_000, 1_700_000_000))
        values.append(vars(sys.modules[rule.__module__])["helper"].STEP)
    assert values == [3, 5]


LATE = "import helper\ndef rule(ctx):\n    import helper as late\n    return late.STEP\n"


def test_two_folders_may_have_modules_of_one_name(tmp_path):
    rules = []
    for name, step in (("a", 3), ("b", 5)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "helper.py").write_text(f"STEP = {step}\n")
        (folder / "rule.py").write_text(LATE)
        rules.append(load_rule_file(f"{folder / 'rule.py'}:rule"))
    assert [rule(None) for rule in (*rules, *rules)] == [3, 5, 3, 5]  # type: ignore[arg-type]
    assert "helper" not in sys.modules
    assert code_key(rules[0]).digest != code_key(rules[1]).digest


def test_a_module_that_appears_is_seen(files):
    text = (
        "try:\n    import not_there_yet\nexcept ImportError:\n    pass\ndef rule(ctx):\n    "
        "return None\n"
    )
    before = code_key(files(rule=text))
    assert "missing not_there_yet" in before.parts
    assert code_key(files(not_there_yet="X = 1\n")).digest != before.digest


REFUSED_IMPORTS = {
    "import_module": "import importlib\ndef rule(ctx):\n    return "
    "importlib.import_module(ctx.name)\n",
    "__import__": "def rule(ctx):\n    return __import__('hel' + ctx.name)\n",
    "run_path": "import runpy\ndef rule(ctx):\n    return runpy.run_path(ctx.name)\n",
}


@pytest.mark.parametrize("text", REFUSED_IMPORTS.values(), ids=REFUSED_IMPORTS)
def test_modules_whose_names_are_made_are_no_key(files, text):
    assert "a module whose name is made while it runs" in code_key(files(rule=text)).reason


@pytest.fixture
def site(tmp_path, monkeypatch):
    """``site(name, text, version, requires)`` installs a package of one file; gives the file."""
    folder = tmp_path / "lib" / "site-packages"
    monkeypatch.syspath_prepend(folder)

    def install(name, text="X = 1\n", version="1.0", requires=()):
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob(f"{name}-*"):
            for file in old.iterdir():
                file.unlink()
            old.rmdir()
        file = folder / f"{name}.py"
        file.write_text(text)
        info = folder / f"{name}-{version}.dist-info"
        info.mkdir()
        needs = "".join(f"Requires-Dist: {other}\n" for other in requires)
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{needs}"
        )
        digest = (
            base64.urlsafe_b64encode(hashlib.sha256(file.read_bytes()).digest())
            .rstrip(b"=")
            .decode()
        )
        (info / "RECORD").write_text(f"{name}.py,sha256={digest},{len(text)}\n")
        for cache in (
            installed._records,
            installed.distribution_of,
            installed._requirements,
            installed.state_of,
        ):
            cache.cache_clear()
        importlib.invalidate_caches()
        sys.modules.pop(name, None)
        return file

    yield install
    for cache in (
        installed._records,
        installed.distribution_of,
        installed._requirements,
        installed.state_of,
    ):
        cache.cache_clear()
    for name in ("bought", "needed"):
        sys.modules.pop(name, None)


def locked(f):
    lock = threading.Lock()

    @functools.wraps(f)
    def g():
        with lock:
            return f()

    return g


LOCKED_HERE = locked(lambda: 3)
USES_BOUGHT = "import bought\ndef rule(ctx):\n    return bought.X\n"


def test_the_version_of_an_installed_package_is_seen(files, site):
    site("bought", version="1.0")
    before = code_key(files(rule=USES_BOUGHT))
    assert before.parts["package bought"] == "1.0"
    site("bought", version="1.1")
    after = code_key(files(rule=USES_BOUGHT))
    assert differing(before.parts, after.parts) == "package bought (1.0, 1.1)"


LOCKED = """
import functools
import threading
def locked(f):
    lock = threading.Lock()
    @functools.wraps(f)
    def g():
        with lock:
            return f()
    return g
@locked
def X():
    return 3
"""


def test_of_a_packages_own_function_the_version_says_all(files, site):
    """It is not looked into: a lock around it, which cannot be hashed, leaves the key complete."""
    site("bought", LOCKED, version="1.0")
    key = code_key(files(rule="from bought import X\ndef rule(ctx):\n    return X()\n"))
    assert key.reason == ""
    assert key.parts["package bought"] == "1.0"
    assert code_key(LOCKED_HERE).reason != ""


def test_a_key_prints_its_parts_and_no_objects_or_paths():
    """Objects and paths are others in every process; the same key reads the same in a notebook."""
    key = CodeKey(parts={"values": "1"}, files=(Path("a.py"),), caches=(print,), walks_sets=True)
    assert repr(key) == "CodeKey(parts={'values': '1'}, reason='')"


def test_the_version_of_what_a_package_requires_is_seen(files, site):
    site("bought", requires=["needed>=1"])
    site("needed", version="2.0")
    before = code_key(files(rule=USES_BOUGHT))
    site("needed", version="2.1")
    assert (
        differing(before.parts, code_key(files(rule=USES_BOUGHT)).parts)
        == "package needed (2.0, 2.1)"
    )


BY_NAME = """
from gsfusion_nb.seeding import get_rule
def rule(ctx):
    return get_rule("bought_rule")(ctx)
"""


def test_the_version_of_a_rule_that_is_asked_for_by_its_name_is_seen(files, site):
    """The package is imported by nobody but ``get_rule``."""
    text = "def bought_rule(ctx):\n    return None\n"
    keys = []
    for version in ("1.0", "1.0", "1.1"):
        info = site("bought", text, version=version).with_name(f"bought-{version}.dist-info")
        (info / "entry_points.txt").write_text(
            "[gsfusion_nb.rules]\nbought_rule = bought:bought_rule\n"
        )
        importlib.invalidate_caches()
        keys.append(code_key(files(rule=BY_NAME)))
    assert keys[0].parts["package bought"] == "1.0"
    assert keys[0].digest == keys[1].digest
    assert differing(keys[1].parts, keys[2].parts) == "package bought (1.0, 1.1)"
    names_it_only = "def rule(ctx):\n    return 'bought_rule'\n"
    assert "package bought" not in code_key(files(rule=names_it_only)).parts


def test_an_edited_file_of_an_installed_package_is_seen(files, site):
    """The process may have loaded the file as it was, so the key is one that no other process
    has."""
    file = site("bought")
    before = code_key(files(rule=USES_BOUGHT))
    file.write_text("X = 2\n")
    installed.look_again()
    after = code_key(files(rule=USES_BOUGHT))
    assert "edited" in after.parts["package bought"]
    assert before.digest != after.digest


def test_a_file_that_was_deleted_before_this_process_began_has_one_key(site, monkeypatch):
    """An environment may lack a file since long; each process that uses it is alike."""
    file = site("bought")
    file.unlink()
    changed_ns = file.parent.stat().st_ctime_ns
    for began_ns, is_one in ((changed_ns + 1, True), (changed_ns - 1, False)):
        monkeypatch.setattr(installed, "BEGAN_NS", began_ns)
        states = []
        for process in ("a", "b"):
            monkeypatch.setattr(installed, "ONLY_HERE", process)
            installed.look_again()
            states.append(installed.state_of("bought"))
        assert "edited" in states[0]
        assert (states[0] == states[1]) == is_one


def test_a_package_that_is_used_from_its_sources_is_seen_by_its_files(
    files, site, tmp_path, monkeypatch
):
    """As ``pip install -e`` leaves it: among the packages is only the list of its files."""
    sources = tmp_path / "sources"
    sources.mkdir()
    monkeypatch.syspath_prepend(sources)
    site("bought").unlink()
    (sources / "bought.py").write_text("X = 1\n")
    before = code_key(files(rule=USES_BOUGHT))
    (sources / "bought.py").write_text("X = 2\n")
    after = code_key(files(rule=USES_BOUGHT))
    assert "file bought" in differing(before.parts, after.parts)


def test_the_order_of_folders_is_seen(files, tmp_path, monkeypatch):
    """Of two modules of one name, Python takes that of the first folder."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "bought.py").write_text(f"X = '{name}'\n")
    keys = []
    for order in ("ab", "ab", "ba"):
        with monkeypatch.context() as patch:
            for name in reversed(order):
                patch.syspath_prepend(tmp_path / name)
            patch.delitem(sys.modules, "bought", raising=False)
            rule = files(rule=USES_BOUGHT)
            keys.append(code_key(rule))
            for name in ("bought", rule.__module__):  # as another process begins
                del sys.modules[name]
    assert keys[0].digest == keys[1].digest != keys[2].digest


def test_a_file_among_the_packages_that_none_installed_is_seen(files, site):
    file = site("needed").with_name("dropped.py")
    file.write_text("X = 1\n")
    text = USES_BOUGHT.replace("bought", "dropped")
    before = code_key(files(rule=text))
    assert "file dropped" in before.parts
    file.write_text("X = 2\n")
    sys.modules.pop("dropped", None)
    assert code_key(files(rule=text)).digest != before.digest


def mine(*args, **kwargs):
    return None


PATCHES = {
    "function of torch": (torch, "sum", mine),
    "method of a tensor": (torch.Tensor, "median", mine),
    "function of NumPy": (np, "median", mine),
    "function of Python": (math, "sqrt", lambda x: x),
    "method of the context": (SeedContext, "cells", mine),
    "object that can be called": (torch, "sum", Called(1)),
    "object as a method of the context": (SeedContext, "edges", Called(1)),
    "function of one's own in a cache": (torch, "sum", functools.lru_cache(mine)),
    "partial with a function of one's own": (torch, "sum", functools.partial(mine, 1)),
    "property of the context": (SeedContext, "has_map", property(mine)),
    "wrapper of the function itself": (torch, "sum", functools.wraps(torch.sum)(mine)),
}


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    PATCHES.values(),
    ids=PATCHES,
)
def test_a_function_of_a_library_that_is_replaced_is_seen(monkeypatch, owner, name, value):
    before = patches()
    monkeypatch.setattr(owner, name, value)
    assert any(key.endswith(f".{name}") for key in patches().keys() - before.keys())


def executed(text: str, **names: Any) -> Any:
    """The function ``f`` of a text, executed in a namespace without a name."""
    exec(text, names)
    function = names["f"]
    function.__module__ = "torch.functional"
    return function


def test_a_function_that_a_library_executed_is_no_patch(monkeypatch):
    """``prometheus_client``, which Dask and Jupyter load, decorates by executing a text."""
    decorate = executed("def f(x): return g(x)", g=torch.functional.norm)
    monkeypatch.setattr(torch.functional, "norm", decorate)
    assert "torch.functional.norm" not in patches()
    for names in ({}, {"g": torch}, {"g": mine}, {"g": torch.nn.functional.relu}):
        own = executed("def f(x): return x", **names)
        monkeypatch.setattr(torch.functional, "norm", own)
        assert "torch.functional.norm" in patches(), names


def test_methods_that_attrs_wrote_are_no_patches():
    """Jupyter and the browsers of tests load it; a process that has not has the same key."""
    attr = pytest.importorskip("attr")
    assert "__eq__" in vars(attr.Attribute)
    assert [name for name in patches() if name.startswith("attr.")] == []


SWAPS = {
    "another function of torch": (torch, "median", torch.mean),
    "another method of a tensor": (torch.Tensor, "median", torch.Tensor.mean),
    "another method of the context": (SeedContext, "edges", SeedContext.pixels),
    "constant": (math, "pi", 3.0),
    "code of a function": (backends.chosen, "__code__", (lambda *args: None).__code__),
    "default of a method": (SeedContext.edges, "__defaults__", (5,)),
    "new attribute of the context": (SeedContext, "step", 5),
    "operator of a tensor": (torch.Tensor, "__mul__", torch.Tensor.__add__),
}


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    SWAPS.values(),
    ids=SWAPS,
)
def test_a_name_of_a_library_that_leads_elsewhere_is_seen(monkeypatch, owner, name, value):
    before = library_state("torch.", "math.", "gsfusion_nb.seeding.", "gsfusion_nb.backends.")
    monkeypatch.setattr(owner, name, value, raising=False)
    is_of_function = isinstance(owner, types.FunctionType)
    changed = owner.__name__ if is_of_function else name
    assert any(key.endswith(f".{changed}") for key in changes_since(before))


def test_what_a_name_of_a_library_leads_to_is_part_of_the_key(monkeypatch):
    """Not only that it was changed."""
    before = library_state("gsfusion_nb.seeding.context.", "math.")
    for owner, name, values in (
        (SeedContext, "edges", (SeedContext.pixels, SeedContext.normals)),
        (SeedContext.edges, "__defaults__", ((5,), (6,))),
        (math, "pi", (3.0, 3.1)),
    ):
        found = []
        for value in values:
            monkeypatch.setattr(owner, name, value)
            found.append(changed_values(before))
        monkeypatch.undo()
        assert found[0].keys() == found[1].keys() != set()
        assert found[0] != found[1]


def test_a_text_that_a_function_of_a_library_holds_is_part_of_what_it_is(monkeypatch):
    monkeypatch.setattr(backends.chosen, "mode", "near", raising=False)
    before = library_state("gsfusion_nb.backends.")
    for text, is_seen in (("".join(["ne", "ar"]), False), ("far", True)):
        monkeypatch.setattr(backends.chosen, "mode", text)
        assert any(key.endswith(".chosen") for key in changes_since(before)) == is_seen


def test_the_same_function_under_another_name_of_a_library_is_seen(monkeypatch):
    def rule(ctx):
        return math.floor(ctx.depth) + math.ceil(ctx.depth)

    hashes = []
    for name in ("floor", "ceil"):
        with monkeypatch.context() as patch:
            patch.setattr(math, name, mine)
            hashes.append(loaded_values(rule))
    assert hashes[0] != hashes[1]


def test_cached_functions_that_code_reaches_are_known():
    """Also in a set, whose items are hashed by themselves."""

    @functools.cache
    def read():
        return 3

    @functools.lru_cache(maxsize=2)
    def read_again():
        return 4

    held = {read_again}
    assert set(code_key(lambda: [read(), *held]).caches) == {read, read_again}
    assert code_key(lambda: 3).caches == ()


def test_a_message_names_the_place_of_its_value_alone(tmp_path):
    values = ValueHash()
    values.add([1], "default of f")
    with (
        (tmp_path / "open").open("w") as file,
        pytest.raises(UnhashableError, match=r"^global FILE\.file is a TextIOWrapper"),
    ):
        values.add(types.SimpleNamespace(file=file), "global FILE")


def test_a_swapped_function_that_the_rule_names_is_seen(monkeypatch):
    def rule(ctx):
        return torch.median(ctx.depth) * math.pi

    keys = [loaded_values(rule)]
    for owner, name, value in ((torch, "median", torch.mean), (math, "pi", 3.0)):
        monkeypatch.setattr(owner, name, value)
        keys.append(loaded_values(rule))
    assert len(set(keys)) == 3


@contextlib.contextmanager
def default_dtype():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextlib.contextmanager
def benchmark():
    torch.backends.cudnn.benchmark = True
    try:
        yield
    finally:
        torch.backends.cudnn.benchmark = False


@contextlib.contextmanager
def global_hook(hook):
    handle = register_module_forward_hook(hook)
    try:
        yield
    finally:
        handle.remove()


@contextlib.contextmanager
def trap():
    with decimal.localcontext() as context:
        context.traps[decimal.Inexact] = True
        yield


class AddsOne(TorchFunctionMode):
    """Changes what functions of torch give."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        return func(*args, **(kwargs or {}))


SWITCHES = {
    "no gradients": torch.no_grad,
    "inference": torch.inference_mode,
    "mixed precision": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "default dtype": default_dtype,
    "default device": lambda: torch.device("meta"),
    "mode of functions": AddsOne,
    "cuDNN": benchmark,
    "hook of all networks": lambda: global_hook(doubled),
    "errors of NumPy": lambda: np.errstate(divide="raise"),
    "precision of decimal numbers": lambda: decimal.localcontext(prec=5),
    "rounding of decimal numbers": lambda: decimal.localcontext(rounding=decimal.ROUND_UP),
    "trap of decimal numbers": trap,
}


@pytest.mark.parametrize("switch", SWITCHES.values(), ids=SWITCHES)
def test_settings_of_the_whole_process_are_seen(switch):
    before = switches()
    with switch():
        assert switches() != before
    assert switches() == before


def test_what_a_setting_of_the_process_is_counts():
    """Not only that there is one."""
    found = []
    for hook in (doubled, doubled, tripled):
        with global_hook(hook):
            found.append(switches())
    assert found[0] == found[1] != found[2]


def test_signals_of_decimal_numbers_are_no_setting():
    with decimal.localcontext() as context:
        context.clear_flags()
        before = switches()
        assert decimal.Decimal(1) / 3
        assert context.flags[decimal.Inexact]
        assert switches() == before


A_DATACLASS = """
from dataclasses import dataclass, field
@dataclass(frozen=True)
class C:
    a: int = 1
    b: list = field(default_factory=list)
MADE = C()
"""
KEY_OF_A_FILE = """
import json
import sys
from gsfusion_nb.code_keys import code_key
from gsfusion_nb.seeding.rule_code import load_rule_file
print(json.dumps(dict(code_key(load_rule_file(sys.argv[1])).parts)))
"""


def test_the_key_is_the_same_in_every_process(files, tmp_path):
    """Sets of words have another order in each process, and identities are others."""
    helper = (
        HELPER
        + "WORDS = {'a', 'b', 'c', 'd'}\nMIXED = {radius, math.sin, torch.sum}\nKINDS = [Grid(), "
        "Grid()]\n"
    )
    imports = f"import helper{A_DATACLASS}"
    use = "helper.STEP + len(helper.WORDS | helper.MIXED) + MADE.a + len(helper.KINDS)"
    here = code_key(
        files(
            rule=RULE.format(imports=imports, inside="pass", use=use),
            helper=helper,
        )
    ).parts
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    command = [sys.executable, "-c", KEY_OF_A_FILE, f"{tmp_path / 'rule.py'}:rule"]
    there = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert json.loads(there) == here


@pytest.mark.parametrize("n", [0, 1])
def test_a_column_of_one_value_is_hashed(n):
    """It counts as contiguous whatever its stride is, and was refused."""
    hashes = []
    for number in (1.0, 1.0, 2.0):
        values = ValueHash()
        values.add(torch.full((n, 64), number)[:, 0])
        hashes.append(values.hexdigest())
    assert hashes[0] == hashes[1]
    assert (hashes[0] != hashes[2]) == (n == 1)
