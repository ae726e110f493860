"""The lab's tables as Markdown and as LaTeX."""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence

from .columns import Column
from .result_table import Cell, ResultTable

_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "±": r"$\pm$", "–": "--", "∞": r"$\infty$", "°": r"$^\circ$", "\u00a0": "~",
}  # fmt: skip
_PREAMBLE = r"""% Written by gsfusion-nb lab. In the document: \usepackage{booktabs,graphicx}, then \input{table}
% Best of a column: bold; second: underlined.
"""


def as_markdown(table: ResultTable) -> str:
    """A heading, the table and its notes; the best of a column bold, the second underlined."""
    heads = ["rule", *(column.name for column in table.columns)]
    lines = [
        f"### {table.title}",
        "",
        f"| {' | '.join(map(_markdown, heads))} |",
        "|---|" + "---:|" * len(table.columns),
    ]
    for row in table.rows:
        lines.append(f"| {' | '.join([_markdown(row.label), *map(_markdown_cell, row.cells)])} |")
    return "\n".join([*lines, "", *(f"- {_markdown(note)}" for note in table.notes)])


def as_latex(table: ResultTable, *, label: str = "") -> str:
    """A ``table`` environment with booktabs, made smaller if it is wider than the line; ± in small print.

    Args:
        table: The table.
        label: For ``\\ref``; none if empty.
    """
    lines = [r"\begin{table}[htbp]", r"\centering\small\setlength{\tabcolsep}{4pt}"]
    lines += [rf"\caption{{{_tex(table.title)}. {_tex(_sentences(table.notes))}}}"]
    lines += [rf"\label{{{label}}}"] if label else []
    lines += [
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
        r"\toprule",
    ]
    lines += _tex_heads(table.columns)
    for row in table.rows:
        lines.append(" & ".join([_tex(row.label), *map(_tex_cell, row.cells)]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}}", r"\end{table}"])


def latex_file(tables: Iterable[ResultTable]) -> str:
    """Several tables as one file for ``\\input``, each split into quality and cost if it is wide."""
    parts = [part for table in tables for part in _parts(table)]
    return _PREAMBLE + "\n\n".join(as_latex(part, label=f"tab:lab-{i}") for i, part in enumerate(parts, 1)) + "\n"


def _parts(table: ResultTable) -> list[ResultTable]:
    """Quality and cost as separate tables: a page of LaTeX has no room for both."""
    groups = {c.group: [i for i, d in enumerate(table.columns) if d.group == c.group] for c in table.columns}
    if len(groups) == 1:
        return [table]
    return [
        dataclasses.replace(
            table,
            title=f"{table.title}: {group}",
            columns=tuple(table.columns[i] for i in chosen),
            rows=tuple(dataclasses.replace(row, cells=tuple(row.cells[i] for i in chosen)) for row in table.rows),
        )
        for group, chosen in groups.items()
    ]


def _markdown(text: str) -> str:
    return "".join(f"\\{c}" if c in "\\|*_`<>[]#" else " " if c in "\r\n" else c for c in text)


def _markdown_cell(cell: Cell) -> str:
    return {0: "{}", 1: "**{}**", 2: "<u>{}</u>"}[cell.place].format(cell.text)


def _tex_heads(columns: Sequence[Column]) -> list[str]:
    """A row of headings; neighbours that differ only in the views share a heading in a row above."""
    above, rules, below = [""], [], ["rule"]
    for heading, found in itertools.groupby(columns, key=lambda c: (c.heading, c.unit)):
        run = list(found)
        words = _tex(heading[0]) + (f" [{_tex(heading[1])}]" if heading[1] else "")
        first = len(below) + 1
        if len(run) > 1:
            above.append(rf"\multicolumn{{{len(run)}}}{{c}}{{{words}}}")
            rules.append(rf"\cmidrule(lr){{{first}-{first + len(run) - 1}}}")
            below += [_tex(c.views) for c in run]
        else:
            above.append("")
            below.append(f"{words} {run[0].views}".strip())
    top = [" & ".join(above) + r" \\", " ".join(rules)] if rules else []
    return [*top, " & ".join(below) + r" \\", r"\midrule"]


def _tex_cell(cell: Cell) -> str:
    spread = rf" {{\scriptsize$\pm$ {_tex(cell.sd)}}}" if cell.sd else ""
    return {0: "{}", 1: r"\textbf{{{}}}", 2: r"\underline{{{}}}"}[cell.place].format(_tex(cell.mean)) + spread


def _sentences(notes: Sequence[str]) -> str:
    return " ".join(f"{note[:1].upper()}{note[1:]}." for note in notes)


def _tex(text: str) -> str:
    return "".join(_TEX.get(c, c) for c in text)
