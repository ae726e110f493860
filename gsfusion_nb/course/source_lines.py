"""Where an equation is in the code: the line is searched when the cell runs, so it is always up to
date.

A click opens the file in JupyterLab at the line, if the server's root holds the notebook and the
package, as with ``make lab``.
"""

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from markupsafe import Markup

import gsfusion_nb

from ..drawing.page import html_table
from ..errors import ArgumentError

_ROOT = Path(gsfusion_nb.__file__).resolve().parent


class SourceLines:
    """A table: description, line of code, file and line number. Made by ``source_lines``."""

    def __init__(self, rows: list[tuple[str, str, str, int]]):
        self.rows = rows

    def __repr__(self) -> str:
        return "\n".join(
            f"{what}\n    {path}:{number}  {code}" for what, code, path, number in self.rows
        )

    def _repr_html_(self) -> str:
        root_url = _root_url()  # JupyterLab counts lines from 0
        link = Markup('<a href="{}/{}#line={}">{}:{}</a>')
        rows = [
            (
                what,
                Markup("<code>{}</code>").format(code),
                link.format(
                    root_url,
                    path,
                    number - 1,
                    path.split("/", 1)[1],
                    number,
                ),
            )
            for what, code, path, number in self.rows
        ]
        return html_table(
            rows,
            heads=("what", "line", "where"),
            style="font-size:12px",
            cell_style="text-align:left",
        )


def _root_url() -> str:
    """The way from the notebook's folder to the package's."""
    try:
        return Path(os.path.relpath(_ROOT.parent)).as_posix()
    except (
        ValueError,
        OSError,
    ):  # another drive of Windows, or a folder that is gone: no link can lead there
        return _ROOT.parent.as_uri()


def source_lines(lines: dict[str, tuple[Callable[..., Any], str]]) -> SourceLines:
    """Find lines of the library.

    Args:
        lines: What the line does -> (any function of the file, a part of the line that no other
            line there has).

    Raises:
        ValueError: no line, or more than one, contains the part.
    """
    rows = []
    for what, (function, piece) in lines.items():
        path = Path(inspect.getsourcefile(inspect.unwrap(function)) or "").resolve()
        text = path.read_text(encoding="utf-8").splitlines()
        matches = [i for i, line in enumerate(text) if piece in line]
        if len(matches) != 1:
            raise ArgumentError(
                f"{what}: {piece!r} must be on one line of {path.name}, it is on {len(matches)}"
            )
        name = f"{_ROOT.name}/{path.relative_to(_ROOT).as_posix()}"
        rows.append((what, text[matches[0]].strip(), name, matches[0] + 1))
    return SourceLines(rows)
