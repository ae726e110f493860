"""The statements of a notebook that one function needs: its definition, and what that uses, directly or not.

Nothing else of the notebook runs, so panels, long fits and a cell that raises do not matter.
"""

import ast
import re
import symtable
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

_FRESH = (
    ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign, ast.Import, ast.ImportFrom,
)  # fmt: skip
_COMPREHENSIONS = ("listcomp", "setcomp", "dictcomp", "genexpr")
_MAGIC = re.compile(r"^(\s*)(%|!|\?)|^(\s*)[^#'\"]*\?\s*$")


class NoFunction(ValueError):
    """The function is not defined; the message says why."""


@dataclass(frozen=True)
class Cell:
    """A code cell, or a file."""

    label: str
    """``cell 7``: 7 counts all cells of the notebook from 1; or the name of the file."""
    source: str


@dataclass(frozen=True, eq=False)
class Statement:
    """One statement at the top level of a cell."""

    node: ast.stmt
    cell: Cell
    position: int
    binds: frozenset[str]
    now: frozenset[str]
    """Names that it reads when it runs."""
    later: frozenset[str]
    """Names that functions in it read when they are called."""


def needed(cells: Sequence[Cell], name: str) -> list[Statement]:
    """The statements to run, in order, so that ``name`` is the submission's function; its last definition counts.

    Raises:
        NoFunction: it is not defined, or the cell that defines it has a syntax error.
    """
    statements, broken = _statements(cells)
    if not any(name in s.binds for s in statements):
        for cell, error in broken:
            if re.search(rf"\b{re.escape(name)}\b", cell.source):
                raise NoFunction(
                    f"{cell.label} has a syntax error in line {error.lineno}, so nothing in it can run: {error.msg}"
                )
        raise NoFunction(f"there is no function {name}")
    kept: dict[int, Statement] = {}
    names = [(name, len(statements))]
    seen = set(names)
    while names:
        wanted, before = names.pop()
        for statement in _binding(statements[:before], wanted):
            kept[statement.position] = statement
            more = [(n, statement.position) for n in statement.now] + [(n, len(statements)) for n in statement.later]
            names += [item for item in more if item not in seen]
            seen.update(more)
    return [kept[position] for position in sorted(kept)]


def _binding(statements: Sequence[Statement], name: str) -> Iterator[Statement]:
    """The last statements that give ``name`` its value, back to one that does not read it."""
    for statement in reversed(statements):
        if name in statement.binds:
            yield statement
            if name not in statement.now and isinstance(statement.node, _FRESH):
                return


def _statements(cells: Sequence[Cell]) -> tuple[list[Statement], list[tuple[Cell, SyntaxError]]]:
    found: list[Statement] = []
    broken = []
    for cell in cells:
        try:
            body = ast.parse(plain_python(cell.source)).body
        except SyntaxError as e:
            broken.append((cell, e))
            continue
        except (ValueError, RecursionError, MemoryError) as e:
            broken.append((cell, SyntaxError(str(e) or type(e).__name__)))
            continue
        for node in body:
            try:
                binds, now, later = _names(node)
            except (SyntaxError, ValueError, RecursionError) as e:  # such as `return` outside a function
                broken.append((cell, e if isinstance(e, SyntaxError) else SyntaxError(str(e))))
                continue
            found.append(Statement(node, cell, len(found), binds, now, later))
    return found, broken


def plain_python(source: str) -> str:
    """A cell without IPython's own syntax; every line keeps its number."""
    lines = source.splitlines()
    if lines and lines[0].startswith("%%"):
        if not lines[0].startswith(("%%time", "%%capture")):
            return ""
        lines[0] = ""
    return "\n".join(re.sub(r"\S.*", "pass", line) if _MAGIC.match(line) else line for line in lines) + "\n"


def _names(node: ast.stmt) -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
    """Names that a statement binds, reads when it runs, and reads later; those inside functions are not global."""
    table = symtable.symtable(ast.unparse(node), "cell", "exec")
    binds = {s.get_name() for s in table.get_symbols() if s.is_assigned() or s.is_imported() or s.is_namespace()}
    now = {s.get_name() for s in table.get_symbols() if s.is_referenced()}
    later: set[str] = set()

    def visit(scope: symtable.SymbolTable, deferred: bool) -> None:
        runs_now = scope.get_type() != "function" or scope.get_name() in _COMPREHENSIONS
        deferred = deferred or not runs_now
        used = {s.get_name() for s in scope.get_symbols() if s.is_referenced() and s.is_global()}
        (later if deferred else now).update(used)
        for inner in scope.get_children():
            visit(inner, deferred)

    for inner in table.get_children():
        visit(inner, False)
    return frozenset(binds), frozenset(now), frozenset(later)
