"""However code gets at what it uses, a change of that is seen, or the code has no key."""

import builtins
import sys
import types

import pytest
import torch

from gsfusion_nb.code_keys import code_key
from gsfusion_nb.code_keys.names import looks_up, names_of, walks_sets, words_of
from gsfusion_nb.seeding.rule_code import load_rule_file


@pytest.fixture
def cell(monkeypatch):
    """``cell(source)``: the names of a notebook with this cell."""

    def run(source):
        notebook = types.ModuleType("__main__")
        monkeypatch.setitem(sys.modules, "__main__", notebook)
        exec(source, vars(notebook))
        return notebook

    return run


USES = {
    "a name with underscores": ("__STEP", lambda notebook: vars(notebook).update({"__STEP": 5})),
    "a builtin of one's own": ("MAGIC", lambda notebook: setattr(builtins, "MAGIC", 5)),
    "a value in a library": (
        "torch.MINE['step']",
        lambda notebook: vars(torch)["MINE"].update(step=5),
    ),
    "an object in a library": (
        "torch.OBJECT.step",
        lambda notebook: setattr(notebook.kept, "step", 5),
    ),
    "the notebook as a module": (
        "__import__('__main__').STEP",
        lambda notebook: setattr(notebook, "STEP", 5),
    ),
}


@pytest.mark.parametrize(("use", "change"), USES.values(), ids=USES)
def test_what_a_notebook_sets_is_seen(cell, monkeypatch, use, change):
    monkeypatch.setattr(builtins, "MAGIC", 3, raising=False)
    monkeypatch.setattr(torch, "MINE", {"step": 3}, raising=False)
    body = (
        f"    return {use}\n"
        if "__main__" not in use
        else "    import __main__\n    return __main__.STEP\n"
    )
    source = (
        "import torch\n__STEP = STEP = 3\nclass Kept:\n    pass\nkept = Kept()\nkept.step = 3\n"
    )
    notebook = cell(f"{source}def rule(ctx):\n{body}")
    monkeypatch.setattr(torch, "OBJECT", notebook.kept, raising=False)
    keys = [code_key(notebook.rule), code_key(notebook.rule)]
    change(notebook)
    keys.append(code_key(notebook.rule))
    assert [key.reason for key in keys] == [""] * 3
    assert keys[0].digest == keys[1].digest != keys[2].digest


LOOKUPS = {
    "sys.modules": "sys.modules['helper'].STEP",
    "sys.argv": "int(sys.argv[1])",
    "_getframe": "sys._getframe(1).f_globals['STEP']",
    "currentframe": "inspect.currentframe().f_back",
    "__globals__": "rule.__globals__['STEP']",
    "get_objects": "len(gc.get_objects())",
    "__subclasses__": "len(SeedContext.__subclasses__())",
    "sys.stdin": "int(sys.stdin.readline())",
}


@pytest.mark.parametrize(("by", "use"), LOOKUPS.items(), ids=LOOKUPS)
def test_what_is_looked_up_anywhere_is_no_key(cell, by, use):
    notebook = cell(f"import gc, inspect, sys\nSTEP = 3\ndef rule(ctx):\n    return {use}\n")
    assert f"looks names up by {by}" in code_key(notebook.rule).reason


def test_a_library_that_looks_names_up_does_not_end_the_search_for_patches(monkeypatch):
    from gsfusion_nb.code_keys.patches import patches

    monkeypatch.setattr(torch, "sum", lambda *_: sys._getframe(1))
    assert "torch.sum" in patches()


WAYS = {
    "attrgetter": ("import operator\nGET = operator.attrgetter('STEP')", "GET(helper)"),
    "attrgetter inside": ("import operator", "operator.attrgetter('STEP')(helper)"),
    "attrgetter with a dot": ("import operator", "operator.attrgetter('CFG.step')(helper)"),
    "module in a dict": ("HELD = {'m': helper}", "HELD['m'].STEP"),
    "module as an argument": ("def use(module):\n    return module.STEP", "use(helper)"),
    "module as an attribute": ("class Holds:\n    module = helper", "Holds().module.STEP"),
    "__dict__": ("", "helper.__dict__['STEP']"),
    "getattr": ("", "getattr(helper, 'STEP')"),
    "__getattr__ of the module": ("", "helper.late"),
    "match": ("", "[0 for _ in 'x' if type(ctx) is not helper.STEP]"),
    "a lambda in a list": ("", "[(lambda: helper.STEP)() for _ in 'x']"),
}
HELPER = """
import types
STEP = 3
CFG = types.SimpleNamespace(step=3)
def __getattr__(name):
    if name == "late":
        return STEP
    raise AttributeError(name)
"""


@pytest.mark.parametrize(("before", "use"), WAYS.values(), ids=WAYS)
def test_a_change_of_a_module_is_seen_however_the_rule_got_it(tmp_path, before, use):
    (tmp_path / "helper.py").write_text(HELPER)
    (tmp_path / "rule.py").write_text(
        f"import helper\n{before}\ndef rule(ctx):\n    return {use}\n"
    )
    rule = load_rule_file(f"{tmp_path / 'rule.py'}:rule")
    helper = vars(sys.modules[rule.__module__])["helper"]
    keys = [code_key(rule), code_key(rule)]
    helper.STEP = helper.CFG.step = 5
    keys.append(code_key(rule))
    assert [key.reason for key in keys] == [""] * 3
    assert keys[0].digest == keys[1].digest != keys[2].digest


def test_other_values_of_a_notebook_are_no_part_of_the_key(cell):
    """A notebook has variables of all kinds, and an attribute may have the name of one."""
    notebook = cell("frame = 3\ndef rule(ctx):\n    return ctx.frame\n")
    before = code_key(notebook.rule).digest
    notebook.frame = 5
    assert code_key(notebook.rule).digest == before


def test_lookups_by_name_count_in_a_notebook_only():
    """Of a module everything can be hashed."""

    def rule(ctx):
        return globals()["STEP"]

    assert looks_up(rule, in_a_module=False) == "globals()"
    assert looks_up(rule, in_a_module=True) == ""
    assert looks_up(lambda net: net.eval(), in_a_module=False) == ""


def test_names_and_words():
    assert names_of((lambda x: [torch.sum(y.rows) for y in x]).__code__) == {"torch", "sum", "rows"}
    assert words_of("grid.step") == {"grid", "step"}
    assert words_of("a sentence of words.") == set()


MADE = {"a": 1}
SETS = {
    "literal": lambda: {"a", MADE["a"]},
    "constant": lambda: [x for x in {"a", "b"}],  # noqa: C416
    "set": lambda: set(MADE),
    "frozenset": lambda: frozenset(MADE),
    "comprehension": lambda: {x for x in MADE},  # noqa: C416
    "keys of two": lambda: MADE.keys() & MADE,
    "hash": lambda: hash("a"),
    "inside": lambda: lambda: {*MADE},
}


@pytest.mark.parametrize("function", SETS.values(), ids=SETS)
def test_code_with_sets_is_known(function):
    assert walks_sets(function.__code__)


def test_code_without_sets_is_known():
    assert not walks_sets((lambda x: [x + 1, {"a": x}, (x, "a")]).__code__)
    # of images
    assert not walks_sets((lambda mask, other: (mask & ~other) | (mask ^ other)).__code__)
    assert code_key(lambda: MADE).walks_sets is False
    assert code_key(lambda held=(frozenset("ab"),): held).walks_sets is True
