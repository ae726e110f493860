"""The rows of a map as the splat viewer's front end reads them, and the numbers of each
Gaussian."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..drawing.page import fill
from ..errors import ArgumentError
from ..geometry.spherical_harmonics import SH_C0
from ..types import GaussianParams

Kind = Literal["frame", "level", "state", "number"]

KNOWN: dict[str, tuple[Kind, str]] = {
    "birth_frame": ("frame", "birth frame"),
    "tag": ("level", "seed level"),
    "state": ("state", "state"),
    "confidence": ("number", "confidence"),
    "contribution": ("number", "contribution"),
}
"""Attributes of a map that become columns: name -> (kind, label). Extras of these names replace
them."""
STATE_NAMES = ("unstable", "stable")
SURFEL_TAG = "cause: area, depth, colour"
"""Name of the tag column of a map with states (``surfel_pictures.CAUSES``)."""

_NAMES_TAKEN = ("rgb", "depth", "opacity")


@dataclass(frozen=True, kw_only=True, eq=False)
class Column:
    """One number per Gaussian."""

    name: str
    label: str
    """Name in the menu and the legend."""
    kind: Kind
    values: Float[np.ndarray, " N"]

    @property
    def limits(self) -> tuple[float, float]:
        """Values of the first and last colour: the extremes of labels, 1st and 99th percentile of
        numbers."""
        numbers = self.values[np.isfinite(self.values)]
        if self.kind == "state":
            return 0.0, float(len(STATE_NAMES) - 1)
        if not len(numbers):
            return 0.0, 1.0
        if self.kind != "number":
            return float(numbers.min()), float(numbers.max())
        low, high = np.percentile(
            numbers[:: max(1, len(numbers) // 100_000)],
            (1, 99),
        )
        return float(low), float(high)

    @property
    def palette(self) -> str:
        """Which of ``viewer_picture.PALETTES`` shows it."""
        return "state" if self.kind == "state" else "viridis"

    def as_dict(self) -> dict[str, Any]:
        """The message to the front end."""
        low, high = self.limits
        names = list(STATE_NAMES) if self.kind == "state" else None
        return {
            "name": self.name,
            "label": self.label,
            "kind": self.kind,
            "palette": self.palette,
            "low": low,
            "high": high,
            "names": names,
        }


def columns_of(
    source: Any,
    n: int,
    extras: Mapping[str, Any],
) -> list[Column]:
    """The columns of a map: its own ``KNOWN`` attributes, then the extras.

    Args:
        source: A model; bare parameters have none of their own.
        n: Rows of the map.
        extras: Name -> one number or truth value per Gaussian, a tensor or an array. [N] each

    Raises:
        ValueError: an extra has another length or more than one axis, or a name that is taken.
    """
    own = {} if isinstance(source, GaussianParams) else {k: getattr(source, k, None) for k in KNOWN}
    values_by_name = {k: v for k, v in own.items() if v is not None} | dict(extras)
    columns = [_column(name, values, n) for name, values in values_by_name.items()]
    if own.get("state") is None or "tag" in extras:
        return columns
    return [dataclasses.replace(c, label=SURFEL_TAG) if c.name == "tag" else c for c in columns]


def with_surface(columns: list[Column], n: int, total: int) -> list[Column]:
    """The columns of ``n`` Gaussians continued with zeros to ``total`` rows, and one that is 1 in
    the rows behind."""
    longer = [dataclasses.replace(c, values=np.pad(c.values, (0, total - n))) for c in columns]
    is_surface = (np.arange(total) >= n).astype(np.float32)
    return [
        *longer,
        Column(name="surface", label="surface or Gaussian", kind="number", values=is_surface),
    ]


def value_table(columns: list[Column], n: int) -> Float[np.ndarray, "N C"]:
    """The values side by side."""
    return (
        np.stack([c.values for c in columns], axis=1) if columns else np.zeros((n, 0), np.float32)
    )


def _column(name: str, values: Any, n: int) -> Column:
    if name in _NAMES_TAKEN:
        raise ArgumentError(
            f"an extra cannot be named {name!r}, which the viewer shows already; choose another "
            "name"
        )
    array = (
        values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
    )
    if array.shape != (n,):
        raise ArgumentError(
            f"extras[{name!r}] must hold one number per Gaussian, [{n}], got {list(array.shape)}"
        )
    kind, label = KNOWN.get(name, ("number", name))
    return Column(
        name=name,
        label=label,
        kind=kind,
        values=array.astype(np.float32),
    )


PACKET_BYTES = 48_000_000
"""The records of a map stay below this size; if necessary its higher harmonics are left out (96 of
124 bytes)."""
MAX_CHANGED_SHARE = 0.6
"""If a larger share of the rows has changed, all rows are sent: simpler, and hardly more bytes."""


@dataclass(frozen=True, kw_only=True)
class RowLayout:
    """What one record holds."""

    columns: int
    """Labels and numbers of the Gaussian apart from its parameters."""
    harmonics: int
    """Coefficients of the colour: 1, 4, 9 or 16."""

    @property
    def stride(self) -> int:
        """Bytes of one record, a multiple of 4."""
        return self.dtype.itemsize

    @property
    def dtype(self) -> np.dtype:
        """The record as a numpy type: ``packed.view(layout.dtype)`` reads the fields back."""
        padding = 2 * (3 * self.harmonics % 2)
        return np.dtype(
            [
                ("xyz_W", "<f4", (3,)),
                ("quat", "<f2", (4,)),
                ("log_scale", "<f2", (3,)),
                ("opacity", "<f2"),
                ("columns", "<f4", (self.columns,)),
                ("sh", "<f2", (self.harmonics, 3)),
                ("padding", "V", padding),
            ]
        )


Packet = tuple[Int[np.ndarray, " M"] | None, UInt8[np.ndarray, "M S"]]
"""One message to the front end: which rows these are, ``None`` if all, and their records."""


def layout_for(params: GaussianParams, columns: int) -> RowLayout:
    """The layout with as many harmonics as the map has and ``PACKET_BYTES`` allows."""
    fitting = [
        K
        for K in (16, 9, 4)
        if params.sh.shape[1] >= K and len(params) * (28 + 4 * columns + 6 * K) < PACKET_BYTES
    ]
    return RowLayout(columns=columns, harmonics=fitting[0] if fitting else 1)


def finite_rows(params: GaussianParams) -> Bool[Tensor, " N"]:
    """Rows without a NaN or an infinity."""
    columns = (
        params.xyz_W,
        params.log_scale,
        params.quat,
        params.opacity_logit[:, None],
        params.sh.flatten(1),
    )
    return torch.stack([c.isfinite().all(dim=1) for c in columns]).all(dim=0)


def pack_rows(
    params: GaussianParams, columns: Float[np.ndarray, "N C"], layout: RowLayout
) -> UInt8[np.ndarray, "N S"]:
    """All rows as records. A row with a NaN or an infinity gets opacity 0, which hides it and keeps
    the numbering.

    Args:
        params: The map, N rows.
        columns: Labels and numbers of each Gaussian. [N, C]
        layout: What a record holds; a map of higher degree is cut to its harmonics.
    """
    records = np.zeros(len(params), layout.dtype)
    good = finite_rows(params)[:, None]
    values = {
        "xyz_W": params.xyz_W,
        "quat": params.quat,
        "log_scale": params.log_scale.clamp(-60.0, 60.0),
        "sh": params.sh[:, : layout.harmonics].flatten(1).clamp(-6e4, 6e4),
        "opacity": params.opacity_logit.sigmoid()[:, None],
    }
    for name, value in values.items():
        plain = torch.where(good, value.detach(), 0.0)
        field = records[name]
        field[...] = plain.cpu().numpy().reshape(field.shape)
    records["columns"] = np.nan_to_num(columns)
    return records.view(np.uint8).reshape(len(params), layout.stride)


def packet_between(
    old: UInt8[np.ndarray, "_ _"] | None, new: UInt8[np.ndarray, "_ _"]
) -> Packet | None:
    """What to send to a front end that holds ``old`` so that it holds ``new``; ``None`` if nothing
    changed.

    If the map only grew, the new rows are sent; if rows changed, those; if rows were removed, all
    rows are sent, since every row after a removed one has another number.
    """
    if old is None or old.shape[1] != new.shape[1] or len(old) > len(new):
        return None, new
    words = [a[: len(old)].view(np.uint32) for a in (old, new)]
    changed_rows = np.flatnonzero((words[0] != words[1]).any(axis=1))
    index = np.concatenate([changed_rows, np.arange(len(old), len(new))]).astype(np.int32)
    if not len(index):
        return None
    if len(index) > MAX_CHANGED_SHARE * len(new):
        return None, new
    return index, new[index]


@dataclass(frozen=True, kw_only=True)
class GaussianRecord:
    """One row of a map, activated values. ``str(row)`` and the notebook show it as a small
    table."""

    row: int
    """Its number in the map."""
    xyz_W: tuple[float, ...]
    """Centre, metres."""
    scale_m: tuple[float, ...]
    """Standard deviations along its own axes, metres."""
    quat: tuple[float, ...]
    """Orientation, wxyz, unit length."""
    opacity: float
    """Peak opacity."""
    rgb: tuple[float, ...]
    """View-independent part of the colour, 0..1 unless it left that range."""
    sh_degree: int
    """Degree of the view-dependent part."""
    extras: dict[str, float]
    """Birth frame, seed level, and the other columns of the viewer."""

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        triples = {
            "xyz_W [m]": self.xyz_W,
            "scale_m [m]": self.scale_m,
            "quat (wxyz)": self.quat,
            "rgb": self.rgb,
        }
        rows = [("row", f"{self.row:,}")]
        rows += [(name, "  ".join(f"{v:.4g}" for v in values)) for name, values in triples.items()]
        rows += [("opacity", f"{self.opacity:.4g}"), ("sh degree", str(self.sh_degree))]
        return rows + [(name, f"{value:.4g}") for name, value in self.extras.items()]

    def __str__(self) -> str:
        return "\n".join(f"{name:<12} {value}" for name, value in self.lines())

    def _repr_html_(self) -> str:
        return fill("splat_record.html", lines=self.lines())


def gaussian_record(params: GaussianParams, columns: list[Column], row: int) -> GaussianRecord:
    """The record of one row."""
    one = params[row : row + 1]
    values = {
        "xyz_W": one.xyz_W[0],
        "scale_m": one.log_scale[0].exp(),
        "quat": torch.nn.functional.normalize(one.quat[0].double(), dim=0),
        "rgb": one.sh[0, 0] * SH_C0 + 0.5,
    }
    return GaussianRecord(
        row=row,
        opacity=float(one.opacity_logit[0].sigmoid()),
        sh_degree=params.sh_degree,
        extras={c.name: float(c.values[row]) for c in columns},
        **{k: tuple(v.tolist()) for k, v in values.items()},
    )
