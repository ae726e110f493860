"""A sortable table of results in a notebook, whose rows can be chosen."""

import functools
import math
from collections.abc import Mapping
from typing import Any

import anywidget
import traitlets as t

from ..drawing.html import fill
from .result_table import Cell, ResultTable


@functools.cache
def _front_end() -> str:
    return fill("table_widget.js")


class TableWidget(anywidget.AnyWidget):
    """Shows a ``ResultTable``; a click on a heading sorts, a click on a row sets ``selected`` to its label
    or, the second time, to ""."""

    _esm = _front_end()

    content: Any = t.Dict({"title": "", "heads": [], "rows": []}).tag(sync=True)
    selected: Any = t.Unicode("").tag(sync=True)

    def show(self, table: ResultTable, states: Mapping[str, str]) -> None:
        """Show another table.

        Args:
            table: The table; its order is that of the rows until a heading is clicked.
            states: Label -> short text beside it, such as "2 of 3 runs".
        """
        heads = [{"name": "rule", "better": "neither"}]
        heads += [{"name": column.name, "better": column.better} for column in table.columns]
        rows = [
            {"label": row.label, "state": states.get(row.label, ""), "cells": [_plain(cell) for cell in row.cells]}
            for row in table.rows
        ]
        content = {"title": table.title, "heads": heads, "rows": rows}
        if content != self.content:
            self.content = content


def _plain(cell: Cell) -> dict[str, Any]:
    value = None if not math.isfinite(cell.value) else cell.value
    return {"mean": cell.mean, "sd": cell.sd, "place": cell.place, "value": value}
