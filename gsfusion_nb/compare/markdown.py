"""Tables and results of the lab as Markdown."""

import math
import re

from .tables import ResultTable


def as_markdown(table: ResultTable) -> str:
    """A heading, the table and its notes; the best of a column bold."""
    heads = ["rule", *(column.name for column in table.columns)]
    lines = [
        f"### {markdown_sentence(table.title)}",
        "",
        f"| {' | '.join(map(plain_markdown, heads))} |",
        "|---|" + "---:|" * len(table.columns),
    ]
    for row in table.rows:
        cells = (
            f"**{plain_markdown(cell.text)}**" if cell.best else plain_markdown(cell.text)
            for cell in row.cells
        )
        label = f"{plain_markdown(row.label)} {row.mark}".strip()
        lines.append(f"| {' | '.join([label, *cells])} |")
    return "\n".join([*lines, "", *(f"- {plain_markdown(note)}" for note in table.notes)])


def markdown_sentence(text: str) -> str:
    """A sentence with names of others, which Markdown shows without elements or links of theirs."""
    return re.sub(r"<(?=[A-Za-z/!?])|[\[`]", r"\\\g<0>", " ".join(text.split()))


def plain_markdown(text: str) -> str:
    """Text that Markdown shows as it is, on one line."""
    return "".join(f"\\{c}" if c in "\\|*_`<>[]#" else " " if c in "\r\n" else c for c in text)


def number_text(value: float, form: str) -> str:
    """A number of a table in this format; a dash for NaN."""
    return "-" if math.isnan(value) else format(value, form)
