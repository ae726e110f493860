"""Numbers per Gaussian besides its parameters (birth frame, state, ...), used by the splat viewer as colours."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from ...types import GaussianParams

Kind = Literal["frame", "level", "state", "number"]

KNOWN: dict[str, tuple[Kind, str]] = {
    "birth_frame": ("frame", "birth frame"),
    "tag": ("level", "seed level"),
    "state": ("state", "state"),
    "confidence": ("number", "confidence"),
    "contribution": ("number", "contribution"),
}
"""Attributes of a map that become columns: name -> (kind, label). Extras of these names replace them."""
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
        """Values of the first and last colour: the extremes of labels, 1st and 99th percentile of numbers."""
        known = self.values[np.isfinite(self.values)]
        if self.kind == "state":
            return 0.0, float(len(STATE_NAMES) - 1)
        if not len(known):
            return 0.0, 1.0
        if self.kind != "number":
            return float(known.min()), float(known.max())
        low, high = np.percentile(known[:: max(1, len(known) // 100_000)], (1, 99))
        return float(low), float(high)

    @property
    def palette(self) -> str:
        """Which of ``viewer_picture.PALETTES`` shows it."""
        return "state" if self.kind == "state" else "viridis"

    def described(self) -> dict[str, Any]:
        """The message to the front end."""
        low, high = self.limits
        names = list(STATE_NAMES) if self.kind == "state" else None
        return {
            "name": self.name, "label": self.label, "kind": self.kind, "palette": self.palette, "low": low,
            "high": high, "names": names,
        }  # fmt: skip


def columns_of(source: Any, n: int, extras: Mapping[str, Any]) -> list[Column]:
    """The columns of a map: its own ``KNOWN`` attributes, then the extras.

    Args:
        source: A model; bare parameters have none of their own.
        n: Rows of the map.
        extras: Name -> one number or truth value per Gaussian, a tensor or an array. [N] each

    Raises:
        ValueError: an extra has another length or more than one axis, or a name that is taken.
    """
    own = {} if isinstance(source, GaussianParams) else {k: getattr(source, k, None) for k in KNOWN}
    given = {k: v for k, v in own.items() if v is not None} | dict(extras)
    columns = [_column(name, values, n) for name, values in given.items()]
    if own.get("state") is None or "tag" in extras:
        return columns
    return [dataclasses.replace(c, label=SURFEL_TAG) if c.name == "tag" else c for c in columns]


def with_surface(columns: list[Column], n: int, total: int) -> list[Column]:
    """The columns of ``n`` Gaussians continued with zeros to ``total`` rows, and one that is 1 in the rows behind."""
    longer = [dataclasses.replace(c, values=np.pad(c.values, (0, total - n))) for c in columns]
    behind = (np.arange(total) >= n).astype(np.float32)
    return [*longer, Column(name="surface", label="surface or Gaussian", kind="number", values=behind)]


def stacked(columns: list[Column], n: int) -> Float[np.ndarray, "N C"]:
    """The values side by side."""
    return np.stack([c.values for c in columns], axis=1) if columns else np.zeros((n, 0), np.float32)


def _column(name: str, values: Any, n: int) -> Column:
    if name in _NAMES_TAKEN:
        raise ValueError(f"an extra cannot be named {name!r}, which the viewer shows already; choose another name")
    array = values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
    if array.shape != (n,):
        raise ValueError(f"extras[{name!r}] must hold one number per Gaussian, [{n}], got {list(array.shape)}")
    kind, label = KNOWN.get(name, ("number", name))
    return Column(name=name, label=label, kind=kind, values=array.astype(np.float32))
