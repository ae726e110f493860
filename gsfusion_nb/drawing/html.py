"""HTML from the Jinja2 templates in ``templates/``. Values are escaped unless they are ``Markup``."""

import functools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment


def fill(template: str, **values: Any) -> str:
    """The text of a template, without line breaks at its ends.

    Args:
        template: File name in ``templates/``.
        values: The template's variables.

    Raises:
        jinja2.UndefinedError: the template asks for a variable that was not given.
    """
    return str(_environment().get_template(template).render(**values)).strip()


def html_table(
    rows: Iterable[Sequence[str]],
    *,
    heads: Sequence[str] = (),
    name: str = "",
    style: str = "",
    cell_style: str = "",
) -> str:
    """A table for a notebook's output.

    Args:
        rows: Cells of each row; plain text, or ``Markup`` for cells that are HTML.
        heads: Headings of the columns, or none.
        name: CSS class of the table.
        style: CSS of the table.
        cell_style: CSS of every cell and heading.
    """
    return fill("table.html", rows=rows, heads=heads, name=name, style=style, cell_style=cell_style)


@functools.cache
def _environment() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("gsfusion_nb.drawing"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
