"""The rows of a map as the splat viewer's front end reads them: fixed-size binary records, and which of them changed.

``static/rows.js`` is the other side. Little endian; half floats where the difference is invisible.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ...types import GaussianParams

PACKET_BYTES = 48_000_000
"""The records of a map stay below this size; if necessary its higher harmonics are left out (96 of 124 bytes)."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class RowPacket:
    """One message to the front end."""

    n: int
    """Rows of the map after it."""
    index: Int[np.ndarray, " M"] | None
    """Which rows these are; ``None`` if all."""
    records: UInt8[np.ndarray, "M S"]


def layout_for(params: GaussianParams, columns: int) -> RowLayout:
    """The layout with as many harmonics as the map has and ``PACKET_BYTES`` allows."""
    fitting = [
        K for K in (16, 9, 4) if params.sh.shape[1] >= K and len(params) * (28 + 4 * columns + 6 * K) < PACKET_BYTES
    ]
    return RowLayout(columns=columns, harmonics=fitting[0] if fitting else 1)


def finite_rows(params: GaussianParams) -> Bool[Tensor, " N"]:
    """Rows without a NaN or an infinity."""
    columns = (params.xyz_W, params.log_scale, params.quat, params.opacity_logit[:, None], params.sh.flatten(1))
    return torch.stack([c.isfinite().all(dim=1) for c in columns]).all(dim=0)


def pack_rows(params: GaussianParams, columns: Float[np.ndarray, "N C"], layout: RowLayout) -> UInt8[np.ndarray, "N S"]:
    """All rows as records. A row with a NaN or an infinity gets opacity 0, which hides it and keeps the numbering.

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
        shown = torch.where(good, value.detach(), 0.0)
        field = records[name]
        field[...] = shown.cpu().numpy().reshape(field.shape)
    records["columns"] = np.nan_to_num(columns)
    return records.view(np.uint8).reshape(len(params), layout.stride)


def packet_between(old: UInt8[np.ndarray, "_ _"] | None, new: UInt8[np.ndarray, "_ _"]) -> RowPacket | None:
    """What to send to a front end that holds ``old`` so that it holds ``new``; ``None`` if nothing changed.

    If the map only grew, the new rows are sent; if rows changed, those; if rows were removed, all rows are sent,
    since every row after a removed one has another number.
    """
    everything = RowPacket(n=len(new), index=None, records=new)
    if old is None or old.shape[1] != new.shape[1] or len(old) > len(new):
        return everything
    words = [a[: len(old)].view(np.uint32) for a in (old, new)]
    changed = np.flatnonzero((words[0] != words[1]).any(axis=1))
    index = np.concatenate([changed, np.arange(len(old), len(new))]).astype(np.int32)
    if not len(index):
        return None
    if len(index) > MAX_CHANGED_SHARE * len(new):
        return everything
    return RowPacket(n=len(new), index=index, records=new[index])
