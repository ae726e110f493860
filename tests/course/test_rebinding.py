"""Cells of a notebook can be run again in any order: no cell rebinds a name that another cell reads
from elsewhere."""

import ast
import json
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))


class Cell(ast.NodeVisitor):
    """Names that a cell binds, and those that it reads from other cells."""

    def __init__(self, source):
        self.bound = set()
        self.read = set()
        self.later = set()
        self.visit(ast.parse(source))
        self.read |= self.later - self.bound  # functions read when they are called

    def visit_Name(self, node):
        if isinstance(node.ctx, ast.Load):
            self.read |= {node.id} - self.bound
        else:
            self.bound.add(node.id)

    def visit_Assign(self, node):
        for part in (node.value, *node.targets):
            self.visit(part)

    def visit_AugAssign(self, node):
        if isinstance(node.target, ast.Name):
            self.read |= {node.target.id} - self.bound
        self.generic_visit(node)

    def visit_For(self, node):
        for part in (node.iter, node.target, *node.body, *node.orelse):
            self.visit(part)

    def visit_alias(self, node):
        self.bound.add((node.asname or node.name).split(".")[0])

    def visit_FunctionDef(self, node):
        for part in (
            *node.decorator_list,
            *node.args.defaults,
            *filter(None, node.args.kw_defaults),
        ):
            self.visit(part)
        self.bound.add(node.name)
        self.later |= free(node)

    def visit_ClassDef(self, node):
        self.bound.add(node.name)
        self.later |= free(node)

    def visit_Lambda(self, node):
        self.later |= free(node)

    def visit_ListComp(self, node):
        self.read |= free(node) - self.bound

    visit_SetComp = visit_DictComp = visit_GeneratorExp = visit_ListComp  # pyright: ignore[reportAssignmentType]


def free(scope):
    """Names that a function or comprehension reads and does not bind itself."""
    own = {arg.arg for arg in ast.walk(scope) if isinstance(arg, ast.arg)}
    names = [node for node in ast.walk(scope) if isinstance(node, ast.Name)]
    own |= {node.id for node in names if not isinstance(node.ctx, ast.Load)}
    return {node.id for node in names} - own


def rebindings(sources):
    """``name: cells that bind it, cells that read it from another`` where that depends on the order
    of running."""
    cells = [Cell(source) for source in sources]
    found = []
    for name in sorted(set().union(*(cell.bound for cell in cells))):
        binders = [i for i, cell in enumerate(cells) if name in cell.bound]
        readers = [i for i, cell in enumerate(cells) if name in cell.read]
        exercise = (
            all(f"def {name}(" in sources[i] for i in binders)
            and "BEGIN SOLUTION" in sources[binders[-1]]
        )
        if len(binders) > 1 and readers and not exercise:
            found.append(f"{name}: bound in {binders}, read in {readers}")
    return found


def test_the_search_finds_what_breaks():
    assert rebindings(["x = 1", "print(x)", "x = 2"]) == ["x: bound in [0, 2], read in [1]"]
    function = "def f():\n    return x"
    assert rebindings(["x = 1", function, "for x in (1, 2): pass"]) == [
        "x: bound in [0, 2], read in [1]"
    ]
    assert (
        rebindings(["x = 1\nprint(x)", "x = 2\nprint([x for _ in 'a'])", "def g(x):\n    return x"])
        == []
    )
    assert (
        rebindings(
            ["def f(): ...", "### BEGIN SOLUTION\ndef f(): return 1\n### END SOLUTION", "f()"]
        )
        == []
    )


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_cells_can_be_run_again_in_any_order(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    sources = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert rebindings(sources) == []
