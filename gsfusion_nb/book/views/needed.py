"""Which cells of a notebook must run before one of them: those that bind the names that it needs, and theirs."""

import ast
from collections.abc import Mapping, Sequence
from typing import Any


def needed_cells(cells: Sequence[Mapping[str, Any]], target: str, also: Sequence[str] = ()) -> list[str]:
    """Ids of the code cells to run, in their order, the target last.

    A name is taken from the last cell above that binds it. A cell that only changes a value (``live.run_sync()``) binds
    nothing: name it in ``also``.

    Args:
        cells: Of the notebook.
        target: Id of the cell.
        also: Ids of other cells that must run.

    Raises:
        ValueError: there is no such cell.
    """
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    place = {cell["id"]: k for k, cell in enumerate(code)}
    if missing := [name for name in (target, *also) if name not in place]:
        raise ValueError(f"there is no code cell {', '.join(missing)}")
    names = [_names("".join(cell["source"])) for cell in code]
    wanted: set[int] = set()

    def want(k: int) -> None:
        if k in wanted:
            return
        wanted.add(k)
        for name in names[k][1]:
            binding = next((j for j in range(k - 1, -1, -1) if name in names[j][0]), None)
            if binding is not None:
                want(binding)

    for name in (target, *also):
        want(place[name])
    return [code[k]["id"] for k in sorted(wanted) if k <= place[target]]


def _names(source: str) -> tuple[set[str], set[str]]:
    """Names that a cell binds at its top level, and all that it reads."""
    tree = ast.parse(source)
    bound: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            bound.add(node.name)
            continue
        for part in ast.walk(node):
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                bound.add(part.id)
            elif isinstance(part, ast.alias):
                bound.add(part.asname or part.name.partition(".")[0])
    read = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}
    return bound, read
