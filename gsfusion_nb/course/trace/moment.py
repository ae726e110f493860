"""One operation as it concerns what is followed: numbers with names, a picture with marks, and the line of code."""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from ...types import Camera
from ..source_lines import source_lines
from .records import Record


@dataclass(frozen=True, kw_only=True)
class Marks:
    """What a picture of a moment shows, pixels of the image."""

    pixel: tuple[int, int] | None = None
    """(column, row)"""
    cell: tuple[int, int, int, int] | None = None
    """First column, first row, width, height."""
    tiles: tuple[tuple[int, int, int, int], ...] = ()
    """First column, first row, width, height of each."""
    ellipse: tuple[float, float, float, float, float] | None = None
    """u, v and the conic A, B, C."""
    dots: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """One operation as it concerns one pixel, voxel or Gaussian."""

    serial: int
    """Number of the operation, rising."""
    frame_index: int | None
    """The frame that was being mapped; ``None`` in the passes after the scan."""
    camera: Camera | None = None
    """Of ``image``."""
    image: Any = None
    """The picture that the operation was about [H, W, 3]; ``None`` if it is no longer held."""
    marks: Marks = Marks()

    code: ClassVar[tuple[Callable[..., Any], str]]
    """Where the operation is: a function of the file, and a part of the line."""

    @property
    def title(self) -> str:
        """What happened, in a few words."""
        return "after the scan" if self.frame_index is None else f"frame {self.frame_index}"

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        raise NotImplementedError

    def source_line(self) -> tuple[str, str]:
        """File with line number, and the line of code that did it."""
        _, code, path, number = source_lines({"": type(self).code}).rows[0]
        return f"{path}:{number}", code

    def without_image(self) -> "Moment":
        """The same without the picture, which takes most of the memory."""
        return dataclasses.replace(self, image=None)

    def __str__(self) -> str:
        place, code = self.source_line()
        width = max(len(name) for name, _ in self.lines())
        body = "\n".join(f"  {name:<{width}}  {value}" for name, value in self.lines())
        return f"{self.title}\n{body}\n  {place}: {code}"


def numbers(values: Any, digits: int = 4) -> str:
    """Values in one line."""
    if isinstance(values, Tensor):
        values = values.detach().flatten().tolist()
    if not isinstance(values, Iterable):
        return f"{values:.{digits}g}"
    return " ".join(f"{float(v):.{digits}g}" for v in values)


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Rows of text under their heads, aligned to the right."""
    lines = [list(heads), *(list(row) for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return "\n".join("  ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True)) for line in lines)


def common(record: Record) -> dict[str, Any]:
    """The fields of a moment that come from its record."""
    return {"serial": record.serial, "frame_index": record.frame_index}


def where(ids: Tensor, i: int) -> int | None:
    """Place of number ``i``, or ``None``."""
    at = (ids == i).nonzero()[:, 0]
    return int(at[0]) if len(at) else None


def box(tile: int, tile_px: int, tiles_x: int, camera: Camera) -> tuple[int, int, int, int]:
    """First column, first row, width, height of a tile."""
    y, x = tile // tiles_x * tile_px, tile % tiles_x * tile_px
    return x, y, min(tile_px, camera.width - x), min(tile_px, camera.height - y)


def copied(values: dict[str, Tensor], r: int) -> dict[str, Tensor]:
    """Row ``r`` of each column, as a copy on the CPU."""
    return {name: value[r].detach().cpu().clone() for name, value in values.items()}


def pixel_index(u: int, v: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Column and row as tensors of one number."""
    return torch.tensor([u], device=device), torch.tensor([v], device=device)
