"""Changes of a Gaussian map between two optimisation steps, as a seeding rule asks for them.

An ``Edit`` changes parameters, moments, birth, tag and states of a map together.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ..checks import check_finite, check_shape, shown
from ..errors import ArgumentError
from ..geometry.operands import MASK, check_operand
from ..types import Seeds

STORED = {"xyz_W": (3,), "log_scale": (3,), "quat": (4,), "opacity_logit": (), "sh": ("K", 3)}
"""Columns of parameters as they are stored, and the shape of a row."""

ACTIVATED = {"scale_m": (3,), "opacity": (), "rgb": (3,)}
"""Columns that are given as they look, and stored as the logarithm, the logit and SH coefficient
0."""

_SAME = {"scale_m": "log_scale", "opacity": "opacity_logit", "rgb": "sh"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Edit:
    """Changes of the rows of a Gaussian map. Every field is optional; they are applied in the order
    of the fields.

    Rows are row numbers [M], or a mask [N] over all rows. They always mean the map before the edit,
    also where an earlier field has added or changed rows. New rows come after the old ones: copies
    of ``clone``, the two halves of ``split`` (all first ones, then all second ones), ``add``.

    When an edit is applied, a value of the wrong kind or shape, a NaN, an opacity or colour outside
    its range, a row that does not exist or is in two fields that contradict each other is a
    ``ValueError``, before anything is changed.

    Source: the operations of gsplat's strategies (Kerbl et al. 2023, section 5; Kheradmand et al.
    2024, section 4; Rota Bulò et al. 2024, section 3.3); ``docs/strategies.md`` compares them one
    by one.
    """

    rates: Mapping[str, Tensor] = field(default_factory=dict)
    """Parameter (``xyz_W``, ``log_scale``, ``quat``, ``opacity_logit``, ``sh``) -> factor of its
    learning rate, one for each row of the map [N], 0: frozen. It stays until it is set again; seeds
    have 1, copies that of their row."""
    set: Mapping[str, tuple[Tensor, Tensor]] = field(default_factory=dict)
    """Column -> (rows, their new values [M, ...]): a parameter as it is stored (names as in
    ``rates``), or as it looks (``scale_m``, ``opacity``, ``rgb``), or ``tag``; in a map of surfels
    also ``state``. Adam's moments stay."""
    reset_opacity: float | None = None
    """No opacity stays above this; Adam's moments of all opacities become zero."""
    relocate: tuple[Tensor, Tensor] | None = None
    """(rows to move [M], rows to move them to [M], which may repeat): the moved rows become copies
    of the others, and opacity and scale of all copies of a row are such that together they look as
    the row did. Adam's moments of the rows that were moved to become zero; the moved rows keep
    theirs."""
    clone: Tensor | None = None
    """Rows to copy; row numbers may repeat. The moments of the copies are zero."""
    clone_shares: bool = False
    """Give a row and its copies such opacities and scales that together they look as the row did
    (as ``relocate``)."""
    split: Tensor | None = None
    """Rows to replace by two each: centres drawn from the Gaussian itself, scales divided by 1.6,
    moments zero."""
    split_shares: bool = False
    """Opacity 1 - sqrt(1 - o) of the two, which together hide as much as the row did, instead of o
    each."""
    add: Seeds | None = None
    """New Gaussians."""
    keep: Tensor | None = None
    """Mask [N]: rows where it is false are removed, with the copies and halves that ``clone`` and
    ``split`` make of them. So a rule may ask for both of one row, as gsplat does, which first
    duplicates and splits and then prunes."""
    min_opacity: float = 0.005
    """Lowest opacity that ``relocate`` and ``clone_shares`` give."""

    def __bool__(self) -> bool:
        """Whether it asks for anything."""
        changes = (self.reset_opacity, self.relocate, self.clone, self.split, self.add, self.keep)
        return bool(self.rates) or bool(self.set) or any(value is not None for value in changes)

    def resolved(self, sh: Tensor, has_states: bool) -> "Edit":
        """The same edit with row numbers for all masks but ``keep``.

        Args:
            sh: SH coefficients of the map. [N, K, 3]
            has_states: Whether its rows have a state (``SurfelModel``).

        Raises:
            ValueError: what cannot be applied to this map; the message names the field.
        """
        for name, factors in self.rates.items():
            check_rate(name, factors, len(sh))
        for activation, parameter in _SAME.items():
            if activation in self.set and parameter in self.set:
                raise ArgumentError(
                    f"set: {activation} and {parameter} are the same numbers; give one of them"
                )
        new_set = {
            name: _checked_set(name, pair, sh, has_states) for name, pair in self.set.items()
        }
        for name in ("reset_opacity", "min_opacity"):
            value = getattr(self, name)
            if value is not None and not 0 < value < 1:
                raise ArgumentError(f"{name} must lie strictly between 0 and 1, got {value}")
        relocation = None if self.relocate is None else _checked_relocate(self.relocate, sh)
        clone = None if self.clone is None else _numbers("clone", self.clone, sh)
        split_rows = None if self.split is None else _numbers("split", self.split, sh)
        keep = self.keep
        if keep is not None:
            check_operand("keep", keep, (len(sh),), dtypes=MASK)
            keep = keep.to(sh.device)
        if self.add is not None:
            _check_add(self.add)
        if clone is not None and split_rows is not None:
            _refuse_both(clone[torch.isin(clone, split_rows)], "cloned and split")
        if keep is not None:
            clone = None if clone is None else clone[keep[clone]]
            split_rows = None if split_rows is None else split_rows[keep[split_rows]]
        if keep is not None and relocation is not None:
            source, target = relocation
            _refuse_both(source[~keep[source]], "relocated and removed")
            _refuse_both(target[~keep[target]], "moved to and removed")
        return dataclasses.replace(
            self, set=new_set, relocate=relocation, clone=clone, split=split_rows, keep=keep
        )


def check_rate(name: str, factors: Any, n: int | None = None) -> None:
    """Raise ``ValueError`` unless these can be factors of the learning rate of a parameter, of
    ``n`` rows if given."""
    if name not in STORED:
        raise ArgumentError(f"rates: no parameter {shown(name)}; known: {', '.join(STORED)}")
    check_shape(f"rates: {name}", factors, ("N" if n is None else n,))
    if not factors.is_floating_point() or not ((factors >= 0) & factors.isfinite()).all():
        raise ArgumentError(
            f"rates: {name} must be finite floats of at least 0, got {shown(factors)}"
        )


def _refuse_both(rows: Tensor, what: str) -> None:
    """Raise ``ValueError`` if there is any row of which two things are asked, ``what``."""
    if len(rows):
        raise ArgumentError(f"row {int(rows[0])} is both {what}; do one of them")


_RANGES = {"scale_m": (0.0, math.inf), "opacity": (0.0, 1.0), "rgb": (0.0, 1.0), "state": (0, 1)}


def _checked_set(
    name: str,
    pair: Any,
    sh: Tensor,
    has_states: bool,
) -> tuple[Tensor, Tensor]:
    """Row numbers and values of ``Edit.set``."""
    columns = (*STORED, *ACTIVATED, "tag", *(["state"] if has_states else []))
    if name not in columns:
        raise ArgumentError(
            f"set: no column {shown(name)} in this map; known: {', '.join(columns)}"
        )
    if (
        not isinstance(pair, tuple)
        or len(pair) != 2
        or not all(isinstance(x, Tensor) for x in pair)
    ):
        raise ArgumentError(
            f"set: {name} must be a pair (rows, values) of tensors, got {type(pair).__name__}"
        )
    rows = _numbers(f"set: rows of {name}", pair[0], sh)
    values = pair[1]
    width = sh.shape[1:] if name == "sh" else STORED.get(name, ACTIVATED.get(name, ()))
    check_shape(f"set: {name}", values, (len(rows), *width))
    if values.is_floating_point() == (name in ("tag", "state")) or values.dtype == torch.bool:
        raise ArgumentError(
            f"set: {name} must not be {values.dtype}; tag and state are whole numbers, the others "
            "floats"
        )
    check_finite(f"set: {name}", values)
    low, high = _RANGES.get(name, (-math.inf, math.inf))
    in_range = (
        (values > low) & (values < high)
        if name in ("scale_m", "opacity")
        else (values >= low) & (values <= high)
    )
    if not in_range.all():
        raise ArgumentError(
            f"set: {name} must be between {low} and {high}, got {float(values[~in_range][0]):g}"
        )
    return rows, values


def _check_add(seeds: Seeds) -> None:
    for name, tail in (
        ("xyz_W", (3,)),
        ("rgb", (3,)),
        ("scale_m", (3,)),
        ("quat", (4,)),
        ("opacity", ()),
    ):
        value = getattr(seeds, name)
        check_shape(f"add: {name}", value, (len(seeds), *tail))
        check_finite(f"add: {name}", value)
    if not (seeds.scale_m > 0).all():
        raise ArgumentError(f"add: scale_m must be above 0, got {float(seeds.scale_m.min()):g}")
    if not ((seeds.opacity > 0) & (seeds.opacity < 1)).all():
        raise ArgumentError(
            f"add: opacity must lie strictly between 0 and 1, got {shown(seeds.opacity)}"
        )


def _checked_relocate(pair: Any, sh: Tensor) -> tuple[Tensor, Tensor]:
    if (
        not isinstance(pair, tuple)
        or len(pair) != 2
        or any(getattr(r, "dtype", None) is torch.bool for r in pair)
    ):
        raise ArgumentError(
            "relocate must be a pair of row numbers: rows to move, and rows to move them to"
        )
    source, target = (_numbers("relocate", rows, sh) for rows in pair)
    if len(source) != len(target):
        raise ArgumentError(
            f"relocate must have one row to move to for each row to move, got {len(target)} for "
            f"{len(source)}"
        )
    if len(source.unique()) != len(source):
        raise ArgumentError("relocate: a row can be moved only once")
    if (both := source[torch.isin(source, target)]).numel():
        raise ArgumentError(f"relocate: row {int(both[0])} is both moved and moved to")
    return source, target


def _numbers(name: str, rows: Any, like: Tensor) -> Tensor:
    """Row numbers of a mask over the rows of ``like``, or those given, on its device."""
    if not isinstance(rows, Tensor) or rows.is_floating_point() or rows.ndim != 1:
        raise ArgumentError(f"{name} must be row numbers [M] or a mask [N], got {shown(rows)}")
    n = len(like)
    rows = rows.to(like.device)
    if rows.dtype == torch.bool:
        check_shape(f"{name}, as a mask", rows, (n,))
        return rows.nonzero()[:, 0]
    if len(rows) and (int(rows.min()) < 0 or int(rows.max()) >= n):
        raise ArgumentError(
            f"{name}: rows must be between 0 and {n - 1}, got {int(rows.min())} to "
            f"{int(rows.max())}"
        )
    return rows.long()
