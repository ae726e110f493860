"""HTML from the Jinja2 templates in ``templates/``. Values are escaped unless they are ``Markup``."""

import functools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment


def fill(template: str, **values: Any) -> str:
    """The text of a filled-in template, without line breaks at its ends.

    Args:
        template: File name in ``templates/``.
        values: The template's variables.

    Raises:
        jinja2.UndefinedError: a variable of the template was not given.
    """
    return str(_environment().get_template(template).render(**values)).strip()


def html_table(
    rows: Iterable[Sequence[str]],
    *,
    heads: Sequence[str] = (),
    foot: str = "",
    name: str = "",
    style: str = "",
    cell_style: str = "",
    head_style: str | None = None,
) -> str:
    """A table for a notebook's output. Texts are escaped; a cell that is HTML is ``Markup``.

    Args:
        rows: Cells of each row.
        heads: Headings of the columns, or none.
        foot: One line under the rows, across all columns.
        name: CSS class of the table.
        style: CSS of the table.
        cell_style: CSS of every cell.
        head_style: CSS of every heading; that of the cells by default.
    """
    values = {"name": name, "style": style, "cell_style": cell_style}
    values["head_style"] = cell_style if head_style is None else head_style
    return fill("table.html", rows=rows, heads=heads, foot=foot, **values)


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
