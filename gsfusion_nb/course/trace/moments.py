"""The part of an operation that concerns what is followed: numbers with names, a picture with
marks, and the line of code."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from ...types import Camera
from ..source_lines import source_lines
from .identity import when
from .operations import Box, Operation


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment(Operation):
    """One operation as it concerns one voxel or Gaussian."""

    camera: Camera | None = None
    """Of ``image``."""
    image: Any = None
    """The picture that the operation was about [H, W, 3]; ``None`` if it is no longer held."""

    code: ClassVar[tuple[Callable[..., Any], str]]
    """Where the operation is: a function of the file, and a part of the line."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return when(self.frame_index)

    @property
    def boxes(self) -> dict[str, list[Box]]:
        """What the picture shows: "tile", "cell" or "pixel" -> its places."""
        return {}

    @property
    def ellipse(self) -> tuple[Tensor, Tensor] | None:
        """Centre [2] and conic [3] of the Gaussian in the picture."""
        return None

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        raise NotImplementedError

    def source_line(self) -> tuple[str, str]:
        """File with line number, and the line of code that did it."""
        _, code, path, number = source_lines({"": type(self).code}).rows[0]
        return f"{path}:{number}", code

    def __str__(self) -> str:
        place, code = self.source_line()
        width = max(len(name) for name, _ in self.lines())
        body = "\n".join(f"  {name:<{width}}  {value}" for name, value in self.lines())
        return f"{self.title}\n{body}\n  {place}: {code}"


def numbers(values: Tensor, digits: int = 4) -> str:
    """Values in one line."""
    return " ".join(f"{x:.{digits}g}" for x in values.flatten().tolist())


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Rows of text under their heads, aligned to the right."""
    lines = [list(heads), *(list(row) for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return "\n".join(
        "  ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True)) for line in lines
    )
