"""Where a program can be mutated and how: the operators of Cosmic Ray, and one more that takes a
statement out."""

import ast
import random
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import parso.python.tree
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Example, Operator
from cosmic_ray.plugins import get_operator

OPPOSITES = {
    "Binary": "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Mul Mod_FloorDiv Pow_Mul BitOr_BitAnd "
    "BitAnd_BitOr BitXor_BitAnd LShift_RShift RShift_LShift",
    "Comparison": "Eq_NotEq NotEq_Eq Lt_LtE Lt_GtE LtE_Lt LtE_Gt Gt_GtE Gt_LtE GtE_Gt GtE_Lt "
    "Is_IsNot IsNot_Is",
    "Unary": "USub_UAdd Delete_Not Delete_Invert",
}
"""Replacements that give a program which still runs; Cosmic Ray also has those that end in a
TypeError at once."""
OTHERS = (
    "AddNot ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd "
    "ReplaceBreakWithContinue "
    "ReplaceContinueWithBreak ExceptionReplacer NumberReplacer ZeroIterationForLoop"
)


PRODUCTS = ("arith_expr", "term", "expr", "xor_expr", "and_expr", "shift_expr", "power", "operator")
"""What a binary operator is part of; a star in a list of arguments is not."""
CONTENT = tuple(
    f"gsfusion_nb/data/room/{name}.py"
    for name in (
        "drawings",
        "book_drawings",
        "thing_drawings",
        "furniture",
        "fittings",
        "books",
        "small_things",
        "materials",
        "interior",
        "scene",
        "camera",
    )
)
"""What the built-in room looks like and how one walks through it: with another number it is another
room, and none is right."""


class RemoveStatement(Operator):
    """Takes out a statement that changes something: ``x[i] = 0``, ``self.x = 1``, ``x += 1``, or a
    call."""

    def mutation_positions(self, node):
        if node.type == "simple_stmt" and self._changes_something(node.children[0]):
            yield node.children[0].start_pos, node.children[0].end_pos

    @staticmethod
    def _changes_something(statement) -> bool:
        if statement.type == "atom_expr":
            return statement.children[-1].children[0] == "("
        if statement.type != "expr_stmt":
            return False
        target, sign = statement.children[:2]
        augmented = not target.type.endswith("list") and getattr(sign, "value", "=") != "="
        return target.type in ("atom_expr", "power") or augmented

    def mutate(self, node, index):
        first = node.get_first_leaf()
        node.children[0] = parso.python.tree.Keyword("pass", first.start_pos, prefix=first.prefix)
        return node

    @classmethod
    def examples(cls):
        return (
            Example("x[0] = 1\n", "pass\n"),
            Example("x.y = 1\n", "pass\n"),
            Example("x += 1\n", "pass\n"),
            Example("f(x)\n", "pass\n"),
            Example("x.f(y)\n", "pass\n"),
        )


def operators() -> dict[str, Any]:
    """The operators in use, by name."""
    pairs = [
        f"Replace{kind}Operator_{pair}" for kind, all_ in OPPOSITES.items() for pair in all_.split()
    ]
    found = {name: get_operator(f"core/{name}")() for name in (*pairs, *OTHERS.split())}
    return {**found, "RemoveStatement": RemoveStatement()}


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One change of one file."""

    file: str
    """Path in the repository."""
    operator: str
    occurrence: int
    """Which of the places in the file where the operator applies, from 0."""
    line: int
    """First line of the change, from 1."""
    runs_with: tuple[int, ...]
    """Lines of the file with one of which a test executes what is changed; empty where only an
    import does."""
    original: str
    """The changed lines before, without indentation."""
    changed: str
    """And after."""

    @property
    def key(self) -> tuple[str, str, str]:
        """What names it as long as its line is the same, wherever that line has moved to."""
        return self.file, self.original, self.changed

    def __str__(self) -> str:
        return (
            f"{self.file}:{self.line} {self.operator}\n    - {self.original}\n    + {self.changed}"
        )


Site = tuple[int, int]
"""Line, from 1, and column, from 0."""


def sites(source: str) -> dict[Site, list[tuple[str, int]]]:
    """Place in a module -> operator and occurrence of each mutant there.

    Left out is what is no behaviour: annotations, decorators, messages of errors, ``strict`` of
    ``zip``; and the stars of arguments, which are no products.
    """
    nodes = list(ast_nodes(get_ast(source)))
    silent = _silent_ranges(ast.parse(source))
    found = defaultdict(list)
    for name, operator in operators().items():
        occurrence = -1
        for node in nodes:
            star = (
                name.startswith("ReplaceBinary")
                and node.parent is not None
                and node.parent.type not in PRODUCTS
            )
            for start, _ in operator.mutation_positions(node):
                occurrence += 1
                if not star and not any(low <= start < high for low, high in silent):
                    found[start].append((name, occurrence))
    return dict(sorted(found.items()))


def _silent_ranges(tree: ast.Module) -> list[tuple[Site, Site]]:
    silent = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            silent += [*node.decorator_list, node.returns]
        elif isinstance(node, ast.ClassDef):
            silent += node.decorator_list
        elif isinstance(node, ast.arg | ast.AnnAssign):
            silent.append(node.annotation)
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            silent += node.exc.args
        elif isinstance(node, ast.keyword) and node.arg == "strict":
            silent.append(node.value)
    ends = [node for node in silent if node is not None]
    return [
        ((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0))
        for node in ends
    ]


def mutated(source: str, operator: str, occurrence: int) -> str:
    """The source with one change."""
    return mutate_code(source, operators()[operator], occurrence) or source


def sample(
    root: Path,
    folder: str,
    count: int,
    seed: int,
) -> list[Mutant]:
    """Mutants at ``count`` random places of a folder, at each place one."""
    rng = random.Random(f"{seed} {folder}")
    files = [path.relative_to(root).as_posix() for path in sorted((root / folder).rglob("*.py"))]
    sources = {file: (root / file).read_text("utf-8") for file in files if file not in CONTENT}
    all_sites = [
        (file, site, kinds)
        for file, source in sources.items()
        for site, kinds in sites(source).items()
    ]
    drawn = rng.sample(all_sites, min(count, len(all_sites)))
    return [described(file, sources[file], site, *rng.choice(kinds)) for file, site, kinds in drawn]


def described(
    file: str,
    source: str,
    site: Site,
    operator: str,
    occurrence: int,
) -> Mutant:
    """The mutant of an operator's n-th occurrence."""
    before = source.splitlines()
    after = mutated(source, operator, occurrence).splitlines()
    head = next(
        (i for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b),
        len(before) - 1,
    )
    ends = zip(
        reversed(before[head:]),
        reversed(after[head:]),
        strict=False,
    )
    tail = next(
        (i for i, (a, b) in enumerate(ends) if a != b),
        0,
    )
    texts = (" ".join(text[head : len(text) - tail]) for text in (before, after))
    original, changed = (" ".join(text.split()) for text in texts)
    return Mutant(
        file=file,
        operator=operator,
        occurrence=occurrence,
        line=site[0],
        runs_with=tuple(executed_lines(ast.parse(source), site[0])),
        original=original,
        changed=changed,
    )


def executed_lines(tree: ast.Module, line: int) -> list[int]:
    """Lines that are executed when ``line`` has an effect: in a function those of its statement;
    for a default of a parameter the function's; for what is executed at import those of all
    functions of the module."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    around = [f for f in functions if f.lineno <= line <= (f.end_lineno or 0)]
    if not around:
        return [i for function in functions for i in _lines(function.body)]
    inner = max(around, key=lambda function: function.lineno)
    if line < inner.body[0].lineno:
        return _lines(inner.body)
    statements = [
        node for node in ast.walk(inner) if isinstance(node, ast.stmt) and node is not inner
    ]
    innermost = min(
        (node for node in statements if node.lineno <= line <= (node.end_lineno or 0)),
        key=lambda node: (node.end_lineno or 0) - node.lineno,
    )
    body = getattr(innermost, "body", None)
    return list(range(innermost.lineno, body[0].lineno)) or [line] if body else _lines([innermost])


def _lines(body: list[ast.stmt]) -> list[int]:
    return list(range(body[0].lineno, (body[-1].end_lineno or 0) + 1))
