"""A notebook without what stands between the markers of solutions."""

import copy
from typing import Any

_BEGIN = ("### BEGIN SOLUTION", "<!-- BEGIN SOLUTION -->")
_END = ("### END SOLUTION", "<!-- END SOLUTION -->")


def without_solutions(notebook: dict[str, Any], *, outputs: bool = False) -> dict[str, Any]:
    """A copy of the notebook (as read from JSON) without solutions and, unless they are wanted, ``outputs``.

    Raises:
        ValueError: a marker without its partner; the message names the cell.
    """
    student = copy.deepcopy(notebook)
    kept = []
    for number, cell in enumerate(student["cells"]):
        lines = _lines(cell["source"])
        left = _outside(lines, number)
        if cell["cell_type"] == "code":
            cell |= {"outputs": cell["outputs"] if outputs else [], "execution_count": None}
        if len(left) < len(lines) and not "".join(left).strip():
            continue
        cell["source"] = [*left[:-1], left[-1].rstrip("\n")] if left else []
        kept.append(cell)
    student["cells"] = kept
    return student


def _lines(source: str | list[str]) -> list[str]:
    return (source if isinstance(source, str) else "".join(source)).splitlines(keepends=True)


def _outside(lines: list[str], number: int) -> list[str]:
    """Lines that belong to no solution."""
    left, inside = [], False
    for line in lines:
        if line.strip() in _BEGIN:
            if inside:
                raise ValueError(f"cell {number} has BEGIN SOLUTION inside a solution")
            inside = True
        elif line.strip() in _END:
            if not inside:
                raise ValueError(f"cell {number} has END SOLUTION without BEGIN SOLUTION")
            inside = False
        elif not inside:
            left.append(line)
    if inside:
        raise ValueError(f"cell {number} has BEGIN SOLUTION without END SOLUTION")
    return left
